"""A run that a driver holds: its row, folder and record, changed together."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any, Unpack

from slamhive.base.clock import exact, utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError
from slamhive.base.files import relative_paths
from slamhive.base.settings import Settings
from slamhive.domain.accounts import NO_SHARING, Sharing
from slamhive.domain.algorithm import Gpu
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import FailureReason, RunEvent, RunState
from slamhive.executors.base import Executor
from slamhive.executors.gpu import lease_gpu
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import Catalogue, VariantService
from slamhive.services.runs import RecordKeeper, handle_from_json, spec_from_json
from slamhive.store import Store, Transaction
from slamhive.store.records import LeaseLost, RunFields, RunRecord

logger = logging.getLogger(__name__)


@dataclass
class HeldRuns:
    """Runs that the slots of a worker drive now, shared with its heartbeat; ``cancel`` has those to be cancelled."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    runs: set[int] = field(default_factory=set)
    cancel: set[int] = field(default_factory=set)

    def add(self, run_id: int) -> None:
        """Add a run that a slot has claimed."""
        with self.lock:
            self.runs.add(run_id)

    def discard(self, run_id: int) -> None:
        """Remove a run that has ended, or that belongs to another worker now."""
        with self.lock:
            self.runs.discard(run_id)
            self.cancel.discard(run_id)

    def snapshot(self) -> set[int]:
        """Return the runs held now."""
        with self.lock:
            return set(self.runs)


class OtherCpus:
    """CPU models of the nodes that runs came to but did not stay on. Thread-safe.

    They are not stored: a run that leaves a node leaves no trace there. After a restart the worker learns them again.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._models: dict[tuple[str, str], str] = {}

    def note(self, executor: str, node: str, cpu_model: str) -> None:
        """Note the CPU model of a node."""
        with self._lock:
            self._models[executor, node] = cpu_model

    def of(self, executor: str) -> dict[str, str]:
        """Return {node: CPU model} of an executor's nodes."""
        with self._lock:
            return {node: model for (name, node), model in self._models.items() if name == executor}


class WorkerStopping(SlamHiveError):
    """The worker is stopping; the run continues, and the next worker adopts it."""


@dataclass(frozen=True)
class DriverContext:
    """Objects that all run drivers of a worker share."""

    settings: Settings
    store: Store
    catalogue: Catalogue
    executors: Callable[[str], Executor]
    owner: str
    stopping: threading.Event
    still_held: Callable[[int], bool]
    cancel_requested: Callable[[int], bool]
    protocol_of: Callable[[RunRecord], Protocol]
    variants: VariantService
    other_cpus: OtherCpus = field(default_factory=OtherCpus)
    now: Callable[[], datetime] = utc_now


CANCELLED_BY_USER = "cancelled by the user"
INTERRUPTION_S = 0.5
"""A failure of a preparation may precede the signal that explains it by so long."""
_GPU_PAUSE_S = 0.5


class RunInHand:
    """One claimed run.

    Args:
        context: Shared by all drivers of the worker.
        run: The current row.
        cores: Core numbers of the slot, None for all.
    """

    def __init__(self, context: DriverContext, run: RunRecord, cores: tuple[int, ...] | None) -> None:
        self.context = context
        self.cores = cores
        self.run = run
        self.folder = RunFolder(context.settings.runs_folder / str(run.id))
        self.keeper = RecordKeeper(self.folder)

    @cached_property
    def executor(self) -> Executor:
        """The executor of the run."""
        return self.context.executors(self.run.executor)

    @property
    def handle(self) -> RunHandle:
        """The handle of the started run; raises InvalidInput if there is none."""
        if self.run.handle is None:
            raise InvalidInput(f"run {self.run.id} is {self.run.state} without a handle")
        return handle_from_json(self.run.handle)

    @cached_property
    def spec(self) -> RunSpec:
        """Return the specification of the run, as the record has it."""
        return spec_from_json(self.keeper.read()["spec"])

    @property
    def started_at(self) -> datetime:
        """Return the time when the algorithm was started."""
        return self.run.started_at or self.run.created_at

    def elapsed_s(self) -> float:
        """Return the wall-clock time since the start."""
        return (self.context.now() - self.started_at).total_seconds()

    def begin(self) -> None:
        """Write the record of a run that is about to be prepared; raises LeaseLost."""
        self._write_held(self._begin_record)

    def _begin_record(self, transaction: Transaction, changes: dict[str, Any] | None = None) -> None:
        """Write ``sharing.json`` and then the record of a run that has none yet.

        The order matters. Until the record exists, users change owner and visibility in the row, which this transaction
        has locked, and in the ledger. Afterwards they change the folder, so a later attempt leaves that alone.
        """
        if not (self.folder.record.exists() and self.folder.sharing.exists()):
            run = transaction.runs.get(self.run.id)
            sharing = Sharing(run.owner if run.experiment_id is None else None, run.visibility)
            if sharing == NO_SHARING:
                self.folder.sharing.unlink(missing_ok=True)  # of an attempt that was killed before it wrote a record
            else:
                self.folder.write_sharing(sharing)
        self.keeper.begin(self.run, transaction.runs.events(self.run.id), changes)

    def save(self, changes: dict[str, Any], *, without: str | None = None) -> None:
        """Add ``changes`` to the record and drop the key ``without``; raises LeaseLost."""
        self._write_held(lambda t: self._save(t.runs.events(self.run.id), changes, without=without))

    def move(
        self,
        target: RunState,
        why: str,
        *,
        record: dict[str, Any] | None = None,
        beside: Callable[[Transaction], None] | None = None,
        **fields: Unpack[RunFields],
    ) -> None:
        """Move the run, with one write of ``run.json``.

        ``run.json`` is written inside the transaction that moves the row, as its last step. A worker that takes over
        after a crash then finds everything that the state needs. The row is locked until then, so that a worker whose
        lease has expired cannot write over what the new holder wrote. Raises LeaseLost.

        Args:
            target: The new state.
            why: For the event.
            record: What the move adds to ``run.json``; None adds nothing, and a missing ``run.json`` stays missing.
            beside: Further database work of the same transaction.
            fields: Columns of the row.
        """
        now, context = self.context.now(), self.context
        changes = {"state": target.value, **({"ended_at": exact(now)} if target.ended else {}), **(record or {})}

        def work(transaction: Transaction) -> None:
            transaction.runs.move(self.run.id, target, why=why, now=now, owner=context.owner, **fields)
            if target.active:
                self._lock(transaction)
            if beside is not None:
                beside(transaction)
            if record is None and not self.folder.record.exists():
                return
            events = transaction.runs.events(self.run.id)
            try:
                self._save(events, changes)
            except (InvalidInput, NotFound):
                if target.active:
                    raise
                self._begin_record(transaction, changes)

        context.store.write(work)
        self.reload()

    def put_back(self, why: str) -> bool:
        """Queue the run again; False, and nothing changes, if it is started or cancelled by now."""
        self.reload()
        if self.run.state is not RunState.PREPARING:
            return False

        def check_cancelled(transaction: Transaction) -> None:
            if transaction.runs.get(self.run.id).cancel_requested:
                raise Conflict(f"run {self.run.id} is to be cancelled")

        try:
            self.move(RunState.QUEUED, why, beside=check_cancelled)
        except LeaseLost:
            raise
        except Conflict:
            return False
        return True

    def _save(self, events: Sequence[RunEvent], changes: dict[str, Any], *, without: str | None = None) -> None:
        self.keeper.save(events, {"attempt": self.run.attempt, **changes}, without=without)

    def _write_held(self, write: Callable[[Transaction], None]) -> None:
        def work(transaction: Transaction) -> None:
            self._lock(transaction)
            write(transaction)

        self.context.store.write(work)

    def _lock(self, transaction: Transaction) -> None:
        """Keep other workers from taking the run until the transaction ends; raises LeaseLost if one has."""
        owner, lease_s = self.context.owner, self.context.settings.lease_s
        if not transaction.queue.heartbeat([self.run.id], transaction.lease(owner, lease_s)):
            raise LeaseLost(f"run {self.run.id} is held by another worker now")

    def fail(self, reason: FailureReason, detail: str) -> None:
        """End the run as failed. Whoever sees the run reads ``detail``, so it does not say where the data root lies."""
        logger.warning("run %d failed: %s: %s", self.run.id, reason, detail)
        detail = relative_paths(self.context.settings.data)(detail)
        self.folder.create()
        ending = {"reason": reason.value, "detail": detail}
        self.move(RunState.FAILED, detail, record=ending, reason=reason, detail=detail)

    def check_not_interrupted(self, error: Exception) -> None:
        """Raise WorkerStopping if the worker is asked to stop: the same signal may have caused ``error``.

        A signal to all processes of a terminal or of a systemd unit reaches them in any order, hence the moment.
        """
        if self.context.stopping.wait(INTERRUPTION_S):
            raise WorkerStopping(f"run {self.run.id} waits for the next worker: {error}")

    def reload(self) -> None:
        """Read the row again."""
        self.run = self.context.store.read(lambda t: t.runs.get(self.run.id))

    def cancel_requested(self) -> bool:
        """Return whether a user asked to cancel the run.

        The row says it of a run that was taken over; the heartbeat may look only after a short run has ended.
        """
        return self.run.cancel_requested or self.context.cancel_requested(self.run.id)

    def check_owner(self) -> None:
        """Ask the database before the folder is written: after a long suspend, another worker may hold the run."""
        self.context.store.write(self._lock)

    def check_still_ours(self) -> None:
        """Raise WorkerStopping if this worker is stopping or no longer holds the run."""
        if not self.context.still_held(self.run.id):
            raise WorkerStopping(f"run {self.run.id} is held by another worker now")
        if self.context.stopping.is_set():
            raise WorkerStopping(f"run {self.run.id} continues without this worker")


def hold_gpu(
    hand: RunInHand, gpus: Sequence[Gpu], check: Callable[[], None] = lambda: None
) -> AbstractContextManager[Gpu]:
    """Lease one of ``gpus`` for as long as a driver has the run in hand; waits while other runs have them all.

    ``check`` is called meanwhile and may raise. Raises WorkerStopping if this worker is stopping or lost the run.
    """
    said = False

    def wait() -> None:
        nonlocal said
        if not said:
            said = True
            logger.info("run %d waits for a GPU", hand.run.id)
        check()
        hand.check_still_ours()
        hand.context.stopping.wait(_GPU_PAUSE_S)

    return lease_gpu(gpus, lambda: hand.executor.gpus_in_use(hand.run.uid), wait)
