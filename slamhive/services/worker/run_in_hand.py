"""A run that a driver holds: its row, folder and record, changed together."""

from __future__ import annotations

import logging
from datetime import datetime
from functools import cached_property
from typing import Any

from slamhive.domain.run import FailureReason, RunEvent, RunState
from slamhive.errors import InvalidInput
from slamhive.executors.base import Executor
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from slamhive.runs.folder import RunFolder
from slamhive.services.json_values import exact
from slamhive.services.runs import RecordKeeper, handle_from_json, spec_from_json
from slamhive.services.worker.context import DriverContext, WorkerStopping
from slamhive.store.records import LeaseLost, RunRecord

logger = logging.getLogger(__name__)

CANCELLED_BY_USER = "cancelled by the user"


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
        self.keeper = RecordKeeper(self.folder, context.store, run.id)

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
        """What was prepared, as the record has it."""
        return spec_from_json(self.saved()["spec"])

    @property
    def started_at(self) -> datetime:
        """When the algorithm was started."""
        return self.run.started_at or self.run.created_at

    def elapsed_s(self) -> float:
        """Wall-clock time since then."""
        return (self.context.now() - self.started_at).total_seconds()

    def saved(self) -> dict[str, Any]:
        """The record as it was last written."""
        return self.keeper.read()

    def save(self, changes: dict[str, Any], coming: RunEvent | None = None, *, without: str | None = None) -> None:
        """Add to the record; see :meth:`RecordKeeper.save`."""
        self.keeper.save({"attempt": self.run.attempt, **changes}, coming, without=without)

    def move(self, target: RunState, why: str, *, record: dict[str, Any] | None = None, **fields: Any) -> None:
        """Move the run, with one write of ``run.json``.

        Args:
            target: The new state.
            why: For the event.
            record: What the move adds to ``run.json``. It is written with the new state, before the row moves. A worker
                that takes over after a crash then finds everything that the state needs. None adds nothing, and
                ``run.json`` follows the row.
            fields: Columns of the row.
        """
        now, owner = self.context.now(), self.context.owner
        changes = {"state": target.value, **({"ended_at": exact(now)} if target.ended else {})}
        if record is not None:
            self._write_ahead({**changes, **record}, RunEvent(now, self.run.state, target, why))
        self.context.store.write(lambda t: t.runs.move(self.run.id, target, why=why, now=now, owner=owner, **fields))
        self.reload()
        if record is None and self.folder.record.exists():
            self.save(changes)

    def _write_ahead(self, changes: dict[str, Any], coming: RunEvent) -> None:
        self.check_owner()
        if coming.to_state is RunState.FAILED and not self.keeper.readable():
            self.keeper.begin(self.run, changes, coming)
        else:
            self.save(changes, coming)

    def fail(self, reason: FailureReason, detail: str) -> None:
        """End the run as failed. Writes the folder first, because it is the truth; then the database, its index."""
        logger.warning("run %d failed: %s: %s", self.run.id, reason, detail)
        self.folder.create()
        ending = {"reason": reason.value, "detail": detail}
        self.move(RunState.FAILED, detail, record=ending, reason=reason, detail=detail)

    def reload(self) -> None:
        """Read the row again."""
        self.run = self.context.store.read(lambda t: t.runs.get(self.run.id))

    def cancel_requested(self) -> bool:
        """Whether a user asked to cancel the run."""
        return self.context.cancel_requested(self.run.id)

    def check_owner(self) -> None:
        """Ask the database before the folder is written: after a long suspend, another worker may hold the run."""
        owner, lease_s = self.context.owner, self.context.settings.lease_s
        if not self.context.store.write(lambda t: t.queue.heartbeat([self.run.id], t.lease(owner, lease_s))):
            raise LeaseLost(f"run {self.run.id} is held by another worker now")

    def check_still_ours(self) -> None:
        """Raise WorkerStopping if this worker is stopping or no longer holds the run."""
        if not self.context.still_held(self.run.id):
            raise WorkerStopping(f"run {self.run.id} is held by another worker now")
        if self.context.stopping.is_set():
            raise WorkerStopping(f"run {self.run.id} continues without this worker")
