"""One run from state to state. Each step can be done again by another worker if this one dies in the middle of it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from datetime import datetime
from functools import cached_property
from typing import Any

from slamhive.catalogue.algorithm_file import package_hash
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import FailureReason, RunEvent, RunState
from slamhive.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.executors.base import (
    EngineUnavailable,
    Executor,
    Exited,
    Gone,
    ImageMissing,
    RunHandle,
    Running,
    StartFailed,
)
from slamhive.executors.sampler import Sampler
from slamhive.runs.folder import RunFolder
from slamhive.runs.outcome import Evidence, Outcome, decide, is_finished
from slamhive.runs.profiling import measure_run, write_plots
from slamhive.services import record as run_record
from slamhive.services.driver_context import DriverContext, WorkerStopping
from slamhive.services.evidence import gather_evidence, read_about
from slamhive.services.host import describe_host
from slamhive.services.preparation import (
    Job,
    RunLimits,
    build_spec,
    check_dataset_files,
    check_disk,
    provenance,
    write_config,
)
from slamhive.services.record_keeper import RecordKeeper
from slamhive.services.run_json import timestamp
from slamhive.services.variants import variant_key
from slamhive.store.records import AlgorithmVersion, LeaseLost, RunRecord
from slamhive.store.store import Transaction

logger = logging.getLogger(__name__)

MOST_OF_A_LINE = 200
CANCELLED_BY_USER = "cancelled by the user"
STOPPED_BECAUSE = "stopped_because"
ENGINE_AWAY = "engine_away_at"
_ENDINGS = {"timeout": "time limit reached", "linger": "finished"}
LINGER_S = 10.0
"""An algorithm that has said ``finished`` may take this long to end before it is stopped; its result stands."""


class PreparationCancelled(SlamHiveError):
    """The user has cancelled the run while its variant was being made."""


class RunDriver:
    """Takes one claimed run to its end.

    Args:
        context: What the worker's drivers share.
        run: The run, in whatever active state its last worker left it.
        cores: Core numbers of the slot, None for all.
    """

    def __init__(self, context: DriverContext, run: RunRecord, cores: tuple[int, ...] | None) -> None:
        self._context = context
        self._cores = cores
        self.run = run
        self.folder = RunFolder(context.settings.runs_folder / str(run.id))
        self._keeper = RecordKeeper(self.folder, context.store, run.id)
        self._held = ExitStack()
        self._steps: dict[RunState, Callable[[], None]] = {
            RunState.PREPARING: self._prepare,
            RunState.STARTING: self._start,
            RunState.RUNNING: self._watch,
            RunState.COLLECTING: self._collect,
            RunState.CANCELLING: self._cancel,
        }

    @cached_property
    def _executor(self) -> Executor:
        return self._context.executors(self.run.executor)

    def drive(self) -> RunRecord:
        """Step until the run has ended (or went back to the queue); the run as it is then.

        Raises LeaseLost, WorkerStopping, EngineUnavailable or Unavailable: the run stays in its state, another call
        of a fresh driver goes on from there.
        """
        with ExitStack() as self._held:
            self._keep_variant()
            while self.run.state.active:
                try:
                    self._steps[self.run.state]()
                except EngineUnavailable:
                    if self.run.state in (RunState.RUNNING, RunState.COLLECTING):
                        self._save({ENGINE_AWAY: timestamp(self._context.now())})
                    raise
        return self.run

    def give_up(self, why: str) -> None:
        """End the run as failed because the controller cannot go on with it; its record may be unreadable."""
        try:
            self._end_what_runs()
        except (SlamHiveError, OSError) as error:
            logger.warning("run %d is given up, but may go on in its engine: %s", self.run.id, str(error))
        if self.run.state is RunState.CANCELLING:
            self._move(RunState.CANCELLED, why)
            return
        if not self._keeper.readable():
            self._keeper.begin(self.run)
        reasons = {
            RunState.PREPARING: FailureReason.PREPROCESS_ERROR,
            RunState.STARTING: FailureReason.START_ERROR,
        }
        self._fail(reasons.get(self.run.state, FailureReason.LOST), why)

    def _prepare(self) -> None:
        if self._context.cancel_requested(self.run.id):
            self._move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        check_disk(self._context.settings)
        try:
            job = self._job()
            check_dataset_files(job.dataset)
            self.folder.create()
            self._keeper.begin(self.run)
            job = self._with_variant(job)
            identity = self._executor.build(job.algorithm.package, self._show_build_line)
            write_config(job, self.folder)
            spec = build_spec(job, self.folder, self._context.settings, identity, self._cores)
        except PreparationCancelled:
            self._move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        except (InvalidInput, NotFound) as error:
            self._fail(FailureReason.PREPROCESS_ERROR, str(error))
            return
        except ImageMissing as error:
            self._fail(FailureReason.IMAGE_MISSING, str(error))
            return
        self._save({**provenance(job, identity), "spec": run_record.spec_to_json(spec)})
        self._register_version(job, identity)
        self._move(RunState.STARTING, f"prepared with {identity[:19]}", timeout_s=spec.timeout_s)

    def _start(self) -> None:
        if self._context.cancel_requested(self.run.id):
            self._move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        spec = run_record.spec_from_json(self._saved()["spec"])
        try:
            handle = self._executor.start(spec)
        except ImageMissing as error:
            self._fail(FailureReason.IMAGE_MISSING, str(error))
            return
        except StartFailed as error:
            self._executor.discard(spec)
            self._fail(FailureReason.START_ERROR, str(error))
            return
        stored = run_record.handle_to_json(handle)
        started_at = _start_time(handle, self._context.now())
        self._save({"handle": stored, "started_at": timestamp(started_at)})
        self._move(RunState.RUNNING, "started", started_at=started_at, handle=stored)

    def _watch(self) -> None:
        """Sample and poll until the run ends by itself, by its time limit, or by the user."""
        handle = self._handle()
        source = self._executor.usage_source(handle)
        sampler = None
        if source is not None:
            already_s = (self._context.now() - self._started_at()).total_seconds()
            sampler = Sampler(
                source, self.folder.profiling, self._context.settings.sample_interval_s, offset_s=max(0.0, already_s)
            )
            sampler.start()
        try:
            cause = self._wait_for_end()
        finally:
            if sampler is not None:
                peak_bytes = sampler.stop()
                if peak_bytes is not None:
                    self._save({"peak_memory_bytes": peak_bytes})
        if cause == "cancelled":
            self._move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        stopped_because = self._saved().get(STOPPED_BECAUSE, cause)
        self._move(RunState.COLLECTING, _ENDINGS.get(stopped_because, stopped_because))

    def _wait_for_end(self) -> str:
        """Why the run has ended: ``exited``, ``gone``, ``timeout``, ``linger`` or ``cancelled``."""
        handle = self._handle()
        saved = self._saved()
        timeout_s = float(saved["spec"]["timeout_s"])
        engine_was_away = ENGINE_AWAY in saved
        finished_at: datetime | None = None
        while True:
            status = self._executor.poll(handle)
            if not isinstance(status, Running):
                return "gone" if isinstance(status, Gone) else "exited"
            if engine_was_away:
                # The run has outlived it: what it ends with from now on is its own doing.
                self._save({}, without=ENGINE_AWAY)
                engine_was_away = False
            now = self._context.now()
            if self._context.cancel_requested(self.run.id):
                return "cancelled"
            if (now - self._started_at()).total_seconds() > timeout_s:
                return self._stop_because("timeout")
            if finished_at is None and is_finished(self.folder.finished):
                finished_at = now
            if finished_at is not None and (now - finished_at).total_seconds() > LINGER_S:
                return self._stop_because("linger")
            self._check_still_ours()
            self._context.stopping.wait(self._context.settings.poll_interval_s)

    def _stop_because(self, cause: str) -> str:
        """Stop the run; why is written down first, so that the exit code is not taken for the algorithm's."""
        self._check_owner()
        self._save({STOPPED_BECAUSE: cause})
        self._executor.stop(self._handle(), self._context.settings.stop_grace_s)
        return cause

    def _collect(self) -> None:
        self._check_owner()
        handle = self._handle()
        status = self._executor.poll(handle)
        self._executor.save_log(handle, self.folder.log)
        saved = self._saved()
        evidence = gather_evidence(self.folder, status, saved)
        outcome = decide(evidence)
        ended_at = (status.ended_at if isinstance(status, Exited) else None) or self._context.now()
        metrics = measure_run(self.folder, self._started_at(), ended_at, saved.get("peak_memory_bytes"), evidence)
        self._seal(outcome, evidence, ended_at, metrics)
        self._tidy_up(handle)

    def _tidy_up(self, handle: RunHandle) -> None:
        """What is left to do once the outcome is safe; none of it can change the outcome."""
        try:
            self._executor.remove(handle)
            write_plots(self.folder)
        except (SlamHiveError, OSError) as error:
            logger.warning("run %d has ended, but: %s", self.run.id, str(error))

    def _seal(self, outcome: Outcome, evidence: Evidence, ended_at: datetime, metrics: dict[str, float]) -> None:
        """The folder first, since it is the truth; then its index."""
        poses = evidence.trajectory.poses
        ending = {
            "state": outcome.state.value,
            "reason": None if outcome.reason is None else outcome.reason.value,
            "detail": outcome.detail or None,
            "ended_at": timestamp(ended_at),
            "exit_code": evidence.exit_code,
            "poses": poses,
            "metrics": metrics,
            "about": read_about(self.folder),
        }
        now = self._context.now()
        why = outcome.detail or outcome.state.value
        self._save(ending, self._ending(now, outcome.state, why))

        protocol = self._evaluation_protocol() if outcome.succeeded and self.run.evaluate else None

        def work(transaction: Transaction) -> None:
            transaction.runs.move(
                self.run.id,
                outcome.state,
                why=why,
                now=now,
                owner=self._context.owner,
                reason=outcome.reason,
                detail=outcome.detail or None,
                ended_at=ended_at,
                exit_code=evidence.exit_code,
                poses=poses,
            )
            transaction.metrics.put(self.run.id, None, metrics)
            if protocol is not None:
                transaction.evaluations.queue([self.run.id], protocol, now)

        self._context.store.write(work)
        self._reload()

    def _evaluation_protocol(self) -> Protocol | None:
        try:
            return self._context.protocol_of(self.run)
        except SlamHiveError as error:
            logger.warning("run %d will not be evaluated: %s", self.run.id, error)
            return None

    def _cancel(self) -> None:
        self._end_what_runs()
        now = self._context.now()
        if self.folder.record.exists():
            ending = {"state": RunState.CANCELLED.value, "ended_at": timestamp(now)}
            self._save(ending, self._ending(now, RunState.CANCELLED, CANCELLED_BY_USER))
        self._move(RunState.CANCELLED, CANCELLED_BY_USER, now=now)

    def _end_what_runs(self) -> None:
        """Stop and remove what was started for the run, known or not."""
        if self.run.handle is not None:
            handle = self._handle()
            self._executor.stop(handle, self._context.settings.stop_grace_s)
            self._executor.save_log(handle, self.folder.log)
            self._executor.remove(handle)
        elif self._keeper.readable() and "spec" in self._saved():
            # A start whose answer was lost may have started something all the same.
            self._executor.discard(run_record.spec_from_json(self._saved()["spec"]))

    def _fail(self, reason: FailureReason, detail: str) -> None:
        logger.warning("run %d failed: %s: %s", self.run.id, reason, detail)
        now = self._context.now()
        self.folder.create()
        if not self.folder.record.exists():
            self._keeper.begin(self.run)
        ending = {
            "state": RunState.FAILED.value,
            "reason": reason.value,
            "detail": detail,
            "ended_at": timestamp(now),
        }
        self._save(ending, self._ending(now, RunState.FAILED, detail))
        self._move(RunState.FAILED, detail, now=now, reason=reason, detail=detail)

    def _job(self) -> Job:
        run = self.run
        algorithm = self._context.catalogue.algorithm(run.algorithm)
        dataset = self._context.catalogue.dataset(run.dataset)
        algorithm.assign(dataset)
        configuration = self._context.store.read(lambda t: t.configurations.get(run.configuration_id))
        limits = RunLimits(run.cpu_cores, run.memory_mb, run.timeout_s)
        return Job(run.id, run.uid, algorithm, dataset, configuration, run.seed, limits)

    def _with_variant(self, job: Job) -> Job:
        """The variant that the run uses, made if need be; it is held until this driver lets go of the run."""

        def progress(fraction: float, text: str) -> None:
            if self._context.cancel_requested(self.run.id):
                raise PreparationCancelled(CANCELLED_BY_USER)
            self._check_still_ours()
            logger.debug("run %d: %s (%.0f %%)", self.run.id, text, 100 * fraction)

        holding = self._context.variants.hold(job.dataset, job.configuration.variant, progress)
        return replace(job, used=self._held.enter_context(holding))

    def _keep_variant(self) -> None:
        """Hold the variant of a run that another worker has prepared."""
        if self.run.variant and self.run.state is not RunState.PREPARING and self._keeper.readable():
            key = variant_key(self._saved())
            if key is not None:
                self._held.enter_context(self._context.variants.hold_made(key))

    def _register_version(self, job: Job, identity: str) -> None:
        package = job.algorithm.package
        version = AlgorithmVersion(identity, package_hash(package.folder), package.version)
        host = describe_host()
        now = self._context.now()

        def work(transaction: Transaction) -> None:
            algorithm_id = transaction.catalogue.put_algorithm(job.algorithm)
            transaction.runs.update(
                self.run.id,
                self._context.owner,
                algorithm_version_id=transaction.catalogue.put_version(algorithm_id, version, now),
                host_id=transaction.catalogue.put_host(host),
                dataset_checksum=job.dataset.checksum,
            )

        self._context.store.write(work)
        self._save({"host": {name: getattr(host, name) for name in host.__slots__}})

    def _move(self, target: RunState, why: str, *, now: datetime | None = None, **fields: Any) -> None:
        moment = now or self._context.now()
        self._context.store.write(
            lambda t: t.runs.move(self.run.id, target, why=why, now=moment, owner=self._context.owner, **fields)
        )
        self._reload()
        if self.folder.record.exists():
            self._save({"state": target.value})

    def _reload(self) -> None:
        self.run = self._context.store.read(lambda t: t.runs.get(self.run.id))

    def _saved(self) -> dict[str, Any]:
        return self._keeper.read()

    def _save(self, changes: dict[str, Any], final: RunEvent | None = None, *, without: str | None = None) -> None:
        self._keeper.save(changes, final, without=without)

    def _ending(self, now: datetime, state: RunState, why: str) -> RunEvent:
        return RunEvent(now, self.run.state, state, why)

    def _handle(self) -> RunHandle:
        if self.run.handle is None:
            raise InvalidInput(f"run {self.run.id} is {self.run.state} without a handle")
        return run_record.handle_from_json(self.run.handle)

    def _started_at(self) -> datetime:
        return self.run.started_at or self.run.created_at

    def _check_owner(self) -> None:
        """Ask the database, before the folder is written: after a long sleep another worker may have the run."""
        now = self._context.now()
        owner, lease_s = self._context.owner, self._context.settings.lease_s
        if not self._context.store.write(lambda t: t.queue.heartbeat([self.run.id], owner, now, lease_s)):
            raise LeaseLost(f"run {self.run.id} is held by another worker now")

    def _check_still_ours(self) -> None:
        if not self._context.still_held(self.run.id):
            raise WorkerStopping(f"run {self.run.id} is held by another worker now")
        if self._context.stopping.is_set():
            raise WorkerStopping(f"run {self.run.id} goes on without this worker")

    def _show_build_line(self, line: str) -> None:
        logger.info("run %d: %s", self.run.id, line)
        with contextlib.suppress(OSError):
            self.folder.preparation.write_text(line[:MOST_OF_A_LINE], encoding="utf-8")


def _start_time(handle: RunHandle, now: datetime) -> datetime:
    """When the engine started the run, if it says so: a worker that adopts it comes later. Never after ``now``."""
    known = handle.data.get("started_at")
    return now if known is None else min(now, datetime.fromisoformat(known))
