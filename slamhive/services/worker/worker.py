"""The worker: claims queued runs, drives each to its end in a slot, and evaluates those that succeeded.

The database is the queue. If this process is killed, the runs continue in their containers. The next worker claims
them when the lease has expired, or at once if it sees that the process of the old worker is gone.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Self

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.base.settings import ENVIRONMENT_PREFIX, Settings
from slamhive.executors.base import EngineUnavailable, Executor
from slamhive.executors.host import owner_is_dead, worker_identity
from slamhive.executors.node_store.server import serving_nodes
from slamhive.executors.registry import AUTO
from slamhive.services.challenges import ChallengeJudge, ImageWork
from slamhive.services.datasets import Catalogue, VariantService
from slamhive.services.deciding import Questions
from slamhive.services.evaluations import Evaluations
from slamhive.services.notices import Notices, notices_of
from slamhive.services.stored_analyses import AnalysisJobs
from slamhive.services.worker.collecting import make_missing
from slamhive.services.worker.driver import RunDriver
from slamhive.services.worker.holding import Heartbeat, WorkerLock
from slamhive.services.worker.leftovers import LATEST, EngineSweep, sweep_leftovers
from slamhive.services.worker.run_in_hand import DriverContext, HeldRuns, RunInHand, WorkerStopping
from slamhive.services.worker.turns import AbsentExecutors, CpuType, OneAtATime, Turns
from slamhive.store import Store, Transaction
from slamhive.store.records import LeaseLost, RunRecord

logger = logging.getLogger(__name__)

IDLE_PAUSE_S = 0.25
"""Between two looks for work in a database server."""
LONGEST_IDLE_PAUSE_S = 5.0
"""The same in an SQLite file, if nobody writes to it: a look takes 4 ms of CPU time, and a commit ends the pause."""
TROUBLE_PAUSE_S = 5.0
CANCEL_CHECK_S = 0.5
EVALUATION_INTERVAL_S = 30.0
NOTICES_EVERY_S = 15.0


class Worker:
    """Runs its slots until it is stopped, or until there is nothing left to do.

    Args:
        settings: Slots, intervals, lease.
        store: The queue.
        catalogue: Algorithms and datasets.
        executors: The executor for a name.
        evaluations: Evaluates successful runs.
        work: The only runs to work on, or what to do between all runs.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        catalogue: Catalogue,
        executors: Callable[[str], Executor],
        evaluations: Evaluations,
        work: Iterable[int] | Chores,
    ) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._evaluations = evaluations
        self._chores = work if isinstance(work, Chores) else None
        self._only = None if isinstance(work, Chores) else frozenset(work)
        self._held = HeldRuns()
        self._stopping = threading.Event()
        self._next_evaluation_s = 0.0
        self.owner = worker_identity()
        self._absent = AbsentExecutors(executors, TROUBLE_PAUSE_S)
        self._one_at_a_time = OneAtATime(executors)
        self._cpu_type = CpuType(settings, store, executors)
        self._engine_sweep = EngineSweep(
            settings.executor, store, executors, elsewhere=settings.mode.has_other_machines
        )
        self._context = DriverContext(
            settings=settings,
            store=store,
            catalogue=catalogue,
            executors=executors,
            owner=self.owner,
            stopping=self._stopping,
            still_held=lambda run_id: run_id in self._held.runs,
            cancel_requested=lambda run_id: run_id in self._held.cancel,
            protocol_of=evaluations.protocol_of,
            variants=VariantService(settings, store),
        )

    def stop(self) -> None:
        """Stop the worker; active runs continue without it."""
        self._stopping.set()

    def run(self, *, until_idle: bool = False, cores: tuple[int, ...] | None = None) -> None:
        """Work until :meth:`stop`, or, with ``until_idle``, until there is nothing left to do.

        ``cores`` are those of its slot, where another worker has given them away; None for what the settings say.

        Raises Conflict if a worker of this data root is already running on this machine.
        """
        slots = self._settings.worker_slots
        shared = [cores] * slots
        if cores is None:
            name = self._settings.executor
            if name == AUTO or self._context.executors(name).capabilities.takes_cores_here:
                shared = share_cores(slots)
        notices = notices_of(self._settings, self._store)
        with WorkerLock(self._settings.data), noticing(notices), serving_nodes(self._settings):
            self._take_over_from_the_dead()
            self._store.recheck()  # the ledger gets the lines that a kill or a full disk has left out
            self._sweep()
            threads = [
                threading.Thread(target=self._slot, args=(shared[slot], until_idle), name=f"slot-{slot}")
                for slot in range(slots)
            ]
            heartbeat_ends = threading.Event()
            beating = Heartbeat(self._held, self._store, self.owner, self._settings.lease_s, CANCEL_CHECK_S)
            heartbeat = threading.Thread(target=beating.beat, args=(heartbeat_ends,), name="heartbeat", daemon=True)
            heartbeat.start()
            for thread in threads:
                thread.start()
            try:
                for thread in threads:
                    thread.join()
                ended_by_itself = not self._stopping.is_set()
            finally:
                self._stopping.set()
                for thread in threads:
                    thread.join()
                # The heartbeat ends after the slots: without it, another worker would take over their runs.
                heartbeat_ends.set()
                heartbeat.join()
                try:
                    self._store.write(lambda t: t.queue.release_all(self.owner))
                except SlamHiveError as error:
                    logger.warning("the leases could not be released and will expire: %s", error)
            if ended_by_itself:
                self._engine_sweep.sweep()

    def _slot(self, cores: tuple[int, ...] | None, until_idle: bool) -> None:
        if cores is not None:
            # The slot's own work (variants, evaluations) stays on its cores, so that it disturbs no other slot.
            os.sched_setaffinity(0, cores)
        turns = Turns()
        while not self._stopping.is_set():
            seen = self._store.mark()
            try:
                away = (*self._absent.names(), *self._one_at_a_time.busy())
                busy = self._work_once(cores, turns, away)
            except (SlamHiveError, OSError) as error:
                logger.warning("%s; trying again in %.0f s", error, TROUBLE_PAUSE_S)
                self._stopping.wait(TROUBLE_PAUSE_S)
                continue
            except Exception:
                logger.exception("internal error of the worker; it continues in %.0f s", TROUBLE_PAUSE_S)
                self._stopping.wait(TROUBLE_PAUSE_S)
                continue
            if busy:
                continue
            if until_idle and not self._held.snapshot():
                # Runs of an engine that was away were skipped; it may be back by now.
                skipped = bool(away) and self._store.read(lambda t: t.queue.waits(self._only))
                if not skipped:
                    return
            # Nobody commits anything when an engine comes back, or when another slot lets go of a run that has ended.
            if seen is None or away or until_idle:
                self._stopping.wait(IDLE_PAUSE_S)
            else:
                self._store.wait_for_commit(seen, self._stopping, LONGEST_IDLE_PAUSE_S)

    def _work_once(self, cores: tuple[int, ...] | None, turns: Turns, away: Collection[str]) -> bool:
        """Do one run whose executor is not ``away``, or one batch of evaluations; returns whether there was one."""
        self._engine_sweep.sweep_if_due()
        near, lease_s = turns.near, self._settings.lease_s
        machine = self._cpu_type.machine
        run = self._store.write(lambda t: t.queue.claim(t.lease(self.owner, lease_s), self._only, near, away, machine))
        if run is not None:
            turns.took(run)
            self._drive(run, cores)
            if monotonic_s() < self._next_evaluation_s:
                return True
        else:
            self._cpu_type.tell_what_waits()
        # Evaluate between runs, not beside them, and not after each run: one engine start serves many runs.
        self._next_evaluation_s = monotonic_s() + EVALUATION_INTERVAL_S
        evaluated = self._evaluations.work_once(self.owner, self._stopping, self._only, cores=cores)
        others = self._chores is not None and self._chores.work_once(self.owner, self._stopping, cores)
        return run is not None or evaluated > 0 or others

    def _drive(self, run: RunRecord, cores: tuple[int, ...] | None) -> None:
        self._held.add(run.id)
        logger.info("run %d: %s on %s, %s", run.id, run.algorithm, run.dataset, run.state)
        try:
            with self._one_at_a_time.turn(run.executor):
                ended = self._drive_through_trouble(run, cores)
        except LeaseLost as error:
            logger.info("%s", error)
            return
        except WorkerStopping as error:
            logger.info("%s", error)
            with contextlib.suppress(LeaseLost):
                RunInHand(self._context, run, None).put_back("the worker was stopped while it prepared the run")
            return
        finally:
            self._held.discard(run.id)
        logger.info("run %d: %s%s", ended.id, ended.state, f" ({ended.detail})" if ended.detail else "")

    def _drive_through_trouble(self, run: RunRecord, cores: tuple[int, ...] | None) -> RunRecord:
        """Drive the run, and continue from its stored state after failures of engine, database or disk."""
        said = ""
        while True:
            driver = RunDriver(self._context, run, cores)
            try:
                return driver.drive()
            except (LeaseLost, WorkerStopping):
                raise
            except (Unavailable, OSError) as error:
                if said != str(error):
                    said = str(error)
                    logger.warning("run %d waits: %s", run.id, said)
                # A run that was not started waits in the queue for its engine, without blocking the slot. One that has
                # started keeps the slot: it may still be running, and another would disturb its measurement.
                hand = RunInHand(self._context, run, None)
                if isinstance(error, EngineUnavailable) and hand.put_back(f"waits: {said}"):
                    self._absent.note(run.executor)
                    return hand.run
                self._stopping.wait(TROUBLE_PAUSE_S)
                if self._stopping.is_set():
                    raise WorkerStopping(f"run {run.id} waits for the next worker") from None
            except SlamHiveError as error:
                driver.give_up(str(error))
            except Exception as error:
                logger.exception("run %d fails because of an internal error of the worker", run.id)
                driver.give_up(f"internal error: {type(error).__name__}: {error}")
            run = self._reloaded(run)
            if run.state.ended:
                return run

    def _reloaded(self, run: RunRecord) -> RunRecord:
        """Read the run again and renew its lease; raises LeaseLost if another worker has taken it."""
        lease_s = self._settings.lease_s
        try:
            current = self._store.read(lambda t: t.runs.get(run.id))
            if current.state.active and not self._store.write(
                lambda t: t.queue.heartbeat([run.id], t.lease(self.owner, lease_s))
            ):
                raise LeaseLost(f"run {run.id} was taken over by another worker")
        except Unavailable:
            return run
        return current

    def _take_over_from_the_dead(self) -> None:
        """Release the runs of killed workers on this machine.

        A lease outlives its worker by up to LEASE_S. If the process is known to be gone, its runs need not wait.
        """
        owners = self._store.read(lambda t: t.queue.owners() | t.evaluations.owners() | t.analyses.owners())
        for owner in owners:
            if owner != self.owner and owner_is_dead(owner):
                logger.info("worker %s is dead: its runs are taken over", owner)
                self._store.write(partial(_release, owner=owner))

    def _sweep(self) -> None:
        """Remove leftovers of killed workers, and do what they had left to do."""
        self._engine_sweep.sweep()
        try:
            sweep_leftovers(self._settings, self._store, self._context.variants, self._context.executors)
        except (SlamHiveError, OSError) as error:
            logger.warning("leftovers of killed workers may remain: %s", error)
        try:
            make_missing(self._settings, self._store, LATEST)
        except SlamHiveError as error:
            logger.warning("what killed workers left undone may still be missing: %s", error)


@dataclass(frozen=True, slots=True)
class Chores:
    """Work done between runs, pinned to one slot's cores so that it disturbs no other slot.

    Attributes:
        analyses: Computes analyses.
        images: Runs images that were submitted to challenges.
        judge: Evaluates submissions to challenges.
        questions: Takes experiments that choose their runs a step further.
    """

    analyses: AnalysisJobs
    images: ImageWork
    judge: ChallengeJudge
    questions: Questions

    def work_once(self, owner: str, stopping: threading.Event, cores: tuple[int, ...] | None) -> bool:
        """Do at most one thing of each kind; returns whether there was any."""
        analysed = self.analyses.work_once(owner, stopping)
        ran = self.images.work_once(stopping, cores) > 0
        ran = self.questions.work_once() or ran
        return self.judge.work_once(stopping, cores) > 0 or ran or analysed


def share_cores(slots: int, usable: Collection[int] | None = None) -> list[tuple[int, ...] | None]:
    """Share cores between slots: disjoint sets of nearly equal size; None (all cores) for a single slot.

    Args:
        slots: Number of slots.
        usable: Numbers of the cores to share; None for those that this process may use.

    Raises:
        InvalidInput: There are fewer cores than slots.
    """
    if slots == 1:
        return [None]
    cores = sorted(os.sched_getaffinity(0) if usable is None else usable)
    count = len(cores)
    if slots > count:
        raise InvalidInput(f"WORKER_SLOTS={slots} exceeds the {count} cores that this process may use", "lower it")
    return [tuple(cores[slot * count // slots : (slot + 1) * count // slots]) for slot in range(slots)]


@contextmanager
def noticing(notices: Notices | None) -> Iterator[None]:
    """Send notices during the block, and once more at its end: no run waits for a mail server."""
    if notices is None:
        yield
        return
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(NOTICES_EVERY_S):
            _once(notices)

    thread = threading.Thread(target=work, name="notices", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    _once(notices)


def _once(notices: Notices) -> None:
    try:
        notices.work_once()
    except (SlamHiveError, OSError) as error:
        logger.warning("notices wait: %s", error)
    except Exception:
        logger.exception("notices wait because of an internal error")


def _release(transaction: Transaction, owner: str) -> None:
    """Release everything that the dead ``owner`` holds."""
    transaction.queue.release_all(owner)
    transaction.evaluations.release_all(owner)
    transaction.analyses.release_all(owner)


# -- workers beside other work: in a process beside the web server, or in a thread of a command that waits for runs ----


END_S = 15.0
TAKE_OVER_S = 1.0
WORKED_ON = 500
"""Runs of an experiment that a worker in a thread takes on at a time."""


class WorkerProcess:
    """Starts ``slamhive worker`` on entry and ends it on exit; its runs continue, and the next worker adopts them.

    Args:
        settings: The worker's data root and database.
        wanted: False starts no worker. If another worker is running, this one waits for its end.
    """

    def __init__(self, settings: Settings, *, wanted: bool) -> None:
        self._settings = settings
        self._wanted = wanted
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        if self._wanted:
            environment = {
                **os.environ,
                f"{ENVIRONMENT_PREFIX}DATA": str(self._settings.data),
                f"{ENVIRONMENT_PREFIX}DATABASE_URL": self._settings.database_url,
            }
            # A separate session: Ctrl-C reaches the server only, which then stops the worker.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "slamhive", "worker", "--patient"], env=environment, start_new_session=True
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is None:
            return
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class WorkingMeanwhile:
    """Works in a thread on the given runs whenever no other worker of this machine does, within a ``with`` statement.

    Args:
        make_worker: Makes a worker for some runs.
        run_ids: The runs; asked again each time there may be work.
    """

    def __init__(self, make_worker: Callable[[Sequence[int]], Worker], run_ids: Callable[[], Sequence[int]]) -> None:
        self._make_worker = make_worker
        self._run_ids = run_ids
        self._failure: BaseException | None = None
        self._ends = threading.Event()
        self._worker: Worker | None = None
        self._thread = threading.Thread(target=self._work, name="embedded-worker")

    def check(self) -> None:
        """Raise what ended the worker, if anything did: without one, waiting would take forever."""
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ends.set()
        if self._worker is not None:
            self._worker.stop()
        self._thread.join()
        if kind is None:
            self.check()

    def _work(self) -> None:
        while not self._ends.is_set():
            try:
                self._worker = self._make_worker(self._run_ids())
                self._worker.run(until_idle=True)
            except Conflict:
                pass  # another worker has the machine; it may take these runs, or end without
            except BaseException as error:  # noqa: BLE001 - handed to the waiting thread
                self._failure = error
                return
            self._ends.wait(TAKE_OVER_S)
