"""Drive one run from state to state: prepare, start, watch, collect.

If the worker dies during a step, another worker repeats that step. It finds in the record what the first one has
stored, and starting the same run twice finds the first start.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from datetime import datetime
from typing import Any

from slamhive.base.clock import exact, timestamp
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.documents.limits import NO_SLOW_DOWN, RunOptions
from slamhive.domain.algorithm import Gpu, GpuNeed
from slamhive.domain.parameters import check_stored
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import EngineUnavailable, GpuGiver, ImageMissing, StartFailed
from slamhive.executors.gpu import GpuLog
from slamhive.executors.host import describe_host
from slamhive.executors.host_counters import POWERCAP, EnergyLog, HostCounters, HostReader
from slamhive.executors.host_log import HostLog, HostReading
from slamhive.executors.sampler import MachineLogs, Sampler
from slamhive.executors.status import Gone, Running
from slamhive.packages.algorithm_file import package_hash
from slamhive.run_folder.outcome import Observation, broken_rule, is_finished, skipped
from slamhive.services.configurations import find_map
from slamhive.services.datasets import variant_key
from slamhive.services.runs import (
    Job,
    build_spec,
    check_dataset_files,
    check_disk,
    check_gpu,
    check_slow_down,
    handle_to_json,
    provenance,
    spec_to_json,
    untracked_s,
    with_made_variant,
    write_config,
)
from slamhive.services.versions import identity_of_version, keep_version
from slamhive.services.weights import WeightsStore
from slamhive.services.worker.collecting import (
    DISK_LIMIT,
    ENGINE_AWAY,
    STARTED_BY,
    STOP_RULE,
    STOPPED_BECAUSE,
    Collecting,
    DiskWatch,
    disk_limits,
    remove_scratch,
    settle_result,
)
from slamhive.services.worker.run_in_hand import CANCELLED_BY_USER, DriverContext, RunInHand, hold_gpu
from slamhive.services.worker.turns import leave_other_cpu, place
from slamhive.store import Transaction
from slamhive.store.records import AlgorithmVersion, LeaseLost, RunRecord

logger = logging.getLogger(__name__)


class RunDriver:
    """Takes one claimed run to its end.

    Args:
        context: Shared by all drivers of the worker.
        run: The run, in any active state.
        cores: Core numbers of the slot, None for all.
    """

    def __init__(self, context: DriverContext, run: RunRecord, cores: tuple[int, ...] | None) -> None:
        self._context = context
        self._hand = RunInHand(context, run, cores)

    def drive(self) -> RunRecord:
        """Step until the run has ended or is queued again; returns it.

        Raises LeaseLost, WorkerStopping, EngineUnavailable or Unavailable: the run keeps its state, and a new driver
        can continue from there.
        """
        hand = self._hand
        with ExitStack() as held:
            if hand.run.state is not RunState.PREPARING and hand.keeper.readable():
                # Another worker prepared the run: its own holds of the variant and the GPU ended with it.
                if hand.run.variant and (key := variant_key(hand.keeper.read())) is not None:
                    held.enter_context(self._context.variants.hold_made(key))
                leased = hand.executor.capabilities.gpu is GpuGiver.WORKER
                if leased and hand.run.state in (RunState.STARTING, RunState.RUNNING):
                    gpu = hand.keeper.read().get("gpu")
                    if gpu is not None:
                        held.enter_context(hold_gpu(hand, [Gpu(**gpu)]))
            steps: dict[RunState, Callable[[], None]] = {
                RunState.PREPARING: Preparing(hand, held).prepare,
                RunState.STARTING: self._start,
                RunState.RUNNING: Watch(hand).watch,
                RunState.COLLECTING: Collecting(hand).collect,
                RunState.CANCELLING: self._cancel,
            }
            while hand.run.state.active:
                try:
                    steps[hand.run.state]()
                except EngineUnavailable:
                    if hand.run.state in (RunState.STARTING, RunState.RUNNING, RunState.COLLECTING):
                        # While starting, too: the answer to a start that succeeded may have been lost.
                        hand.save({ENGINE_AWAY: timestamp(self._context.now())})
                    raise
        return hand.run

    def give_up(self, why: str) -> None:
        """End the run as failed because the controller cannot continue it; its record may be unreadable.

        Raises WorkerStopping if the worker is stopped before the run has started.
        """
        hand = self._hand
        if hand.run.state in (RunState.PREPARING, RunState.STARTING):
            hand.check_not_interrupted(InvalidInput(why))
        try:
            self._end_what_runs()
        except (SlamHiveError, OSError) as error:
            logger.warning("run %d is given up, but may still be running in its engine: %s", hand.run.id, str(error))
        if hand.run.state is RunState.CANCELLING:
            hand.move(RunState.CANCELLED, why)
            return
        reasons = {
            RunState.PREPARING: FailureReason.PREPROCESS_ERROR,
            RunState.STARTING: FailureReason.START_ERROR,
        }
        hand.fail(reasons.get(hand.run.state, FailureReason.LOST), why)

    def _start(self) -> None:
        hand = self._hand
        if hand.cancel_requested():
            hand.move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        spec = place(hand)
        try:
            handle = hand.executor.start(spec)
        except ImageMissing as error:
            hand.check_not_interrupted(error)
            hand.fail(FailureReason.IMAGE_MISSING, str(error))
            return
        except StartFailed as error:
            hand.check_not_interrupted(error)
            hand.executor.discard(spec)
            hand.fail(FailureReason.START_ERROR, str(error))
            return
        leave_other_cpu(hand, spec, handle)
        stored = handle_to_json(handle)
        # The engine knows when it started the run; that precedes an adoption by another worker.
        now, known = self._context.now(), handle.data.get("started_at")
        started_at = now if known is None else min(now, datetime.fromisoformat(known))
        protections = {} if handle.protections is None else {"protections": asdict(handle.protections)}
        started = {"handle": stored, "started_at": exact(started_at), **protections}
        row: dict[str, Any] = {"started_at": started_at, "handle": stored}
        if (host := handle.host) is not None:
            started["host"] = asdict(host)
            row["host_id"] = self._context.store.write(lambda t: t.catalogue.put_host(host))
        if handle.gpu is not None:
            started["gpu"] = asdict(handle.gpu)
        if handle.variant_checksum is not None:
            started["dataset"] = with_made_variant(hand.keeper.read(), handle.variant_checksum)
        hand.move(RunState.RUNNING, "started", record=started, **row)

    def _cancel(self) -> None:
        hand = self._hand
        self._end_what_runs()
        hand.move(RunState.CANCELLED, CANCELLED_BY_USER, record={} if hand.folder.record.exists() else None)

    def _end_what_runs(self) -> None:
        """Stop and remove everything that was started for the run."""
        hand = self._hand
        if hand.run.handle is not None:
            hand.executor.stop(hand.handle, self._context.settings.stop_grace_s)
            hand.executor.save_log(hand.handle, hand.folder.log)
            if hand.keeper.readable():
                hand.executor.collect(hand.spec, hand.handle)
            hand.executor.remove(hand.handle)
            settle_result(hand)
            remove_scratch(hand)
        elif hand.keeper.readable() and "spec" in hand.keeper.read():
            # Even if the answer to the start was lost, something may have been started.
            hand.executor.discard(hand.spec)
            remove_scratch(hand)


# -- the first step of a run: make and record everything that its start needs ------------------------------------------

MOST_OF_A_LINE = 200


class PreparationCancelled(SlamHiveError):
    """The user cancelled the run while its variant was being made."""


class Preparing:
    """Prepares one run.

    Args:
        hand: The run.
        held: Keeps the variant until the driver lets go of the run.
    """

    def __init__(self, hand: RunInHand, held: ExitStack) -> None:
        self._hand = hand
        self._held = held
        self._build_line = ""

    def prepare(self) -> None:
        """Move the run to ``starting``, or to its end if it is skipped, cannot be prepared, or is cancelled.

        Raises WorkerStopping if the worker is stopped meanwhile, whatever fails then.
        """
        hand = self._hand
        if hand.cancel_requested():
            hand.move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        stop_when = hand.run.stop_when
        if stop_when.failures_of_configuration is not None:
            failures = hand.context.store.read(lambda t: t.queue.failures_since_asked(hand.run))
            reason_to_skip = skipped(stop_when, failures)
            if reason_to_skip is not None:
                hand.fail(reason_to_skip.reason, reason_to_skip.detail)
                return
        check_disk(hand.context.settings)
        try:
            self._make()
        except PreparationCancelled:
            hand.move(RunState.CANCELLING, CANCELLED_BY_USER)
        except (InvalidInput, NotFound, ImageMissing) as error:
            hand.check_not_interrupted(error)
            missing = isinstance(error, ImageMissing)
            hand.fail(FailureReason.IMAGE_MISSING if missing else FailureReason.PREPROCESS_ERROR, str(error))

    def _make(self) -> None:
        hand = self._hand
        job = self._job()
        check_dataset_files(job.dataset)
        hand.folder.create()
        hand.begin()
        check_gpu(hand.executor, job.algorithm.package)
        job = replace(job, weights=WeightsStore(hand.context.settings).checked(job.algorithm.package))
        # The variant is made if necessary and held until the driver releases the run, or it is made on its node.
        variants, dataset, variant = hand.context.variants, job.dataset, job.configuration.variant
        if hand.executor.capabilities.makes_variants:
            job = replace(job, used=variants.ordered(dataset, variant))
        else:

            def progress(fraction: float, text: str) -> None:
                self._check_cancelled()
                hand.check_still_ours()
                logger.debug("run %d: %s (%.0f %%)", hand.run.id, text, 100 * fraction)

            job = replace(job, used=self._held.enter_context(variants.hold(dataset, variant, progress)))
        identity = self._identity(job)
        job = self._with_gpu(job)
        write_config(job, hand.folder)
        capabilities = hand.executor.capabilities
        if job.options.slow_down != NO_SLOW_DOWN:
            check_slow_down(hand.executor, job.options)
        spec = build_spec(job, hand.folder, hand.context.settings, identity, hand.cores, capabilities)
        # Record the attempt before the start: a worker that dies during the start may have started the run.
        package, host, now = job.algorithm.package, describe_host(), hand.context.now()
        version = AlgorithmVersion(identity, package_hash(package.folder), package.version)

        def register(transaction: Transaction) -> int:
            transaction.catalogue.put_algorithm(job.algorithm)
            version_id, number = transaction.versions.put(package.name, version, now)
            transaction.runs.update(
                hand.run.id,
                hand.context.owner,
                algorithm_version_id=version_id,
                host_id=transaction.catalogue.put_host(host),
                dataset_checksum=job.dataset.checksum,
                trajectory=job.algorithm.trajectory,
            )
            return number

        number = hand.context.store.write(register)
        keep_version(hand.context.settings.versions_folder, hand.executor, job.algorithm.package, identity, number)
        prepared = {**provenance(job, identity, number), "spec": spec_to_json(spec), STARTED_BY: hand.run.attempt}
        why = f"prepared with {identity[:19]}"
        hand.move(RunState.STARTING, why, record={**prepared, "host": asdict(host)}, timeout_s=spec.timeout_s)

    def _job(self) -> Job:
        context, run = self._hand.context, self._hand.run
        configuration = context.store.read(lambda t: t.configurations.get(run.configuration_id))
        algorithm = context.catalogue.algorithm(configuration.algorithm_label)
        dataset = context.catalogue.dataset(run.dataset)
        algorithm.assign(dataset, configuration.sensors)
        check_stored(algorithm.name, algorithm.parameters, configuration.parameters)
        found = None
        if configuration.map is not None:
            found = find_map(context.store, context.settings.runs_folder, configuration.map.run, algorithm)
            if found.map != configuration.map:
                raise InvalidInput(f"the map {found.path} has changed since the run was queued", "submit the run again")
        return Job(
            run.id, run.uid, algorithm, dataset, configuration, run.seed, RunOptions(**run.options), input_map=found
        )

    def _with_gpu(self, job: Job) -> Job:
        """Add a GPU if the package uses one: leased until the driver releases the run, or requested from the engine."""
        hand = self._hand
        need, giver = job.algorithm.package.gpu, hand.executor.capabilities.gpu
        if need is GpuNeed.NONE or (need is GpuNeed.OPTIONAL and giver is GpuGiver.NOBODY):
            return job
        try:
            if giver is GpuGiver.ENGINE:
                hand.executor.check_gpu()
                return replace(job, asks_gpu=True)
            gpus = hand.executor.gpus()
        except EngineUnavailable:
            raise
        except Unavailable:
            if need is GpuNeed.REQUIRED:
                raise
            return job
        return replace(job, gpu=self._held.enter_context(hold_gpu(hand, gpus, self._check_cancelled)))

    def _check_cancelled(self) -> None:
        if self._hand.cancel_requested():
            raise PreparationCancelled(CANCELLED_BY_USER)

    def _identity(self, job: Job) -> str:
        """Return the image or environment: of the requested version, else of the package as it is now."""
        hand, package = self._hand, job.algorithm.package
        if job.algorithm.version is None:
            return hand.executor.build(package, self._show_build_line)
        return identity_of_version(hand.context.store, hand.executor, job.algorithm)

    def _show_build_line(self, line: str) -> None:
        self._hand.check_still_ours()  # the next worker builds again, from the layers made so far
        if line == self._build_line:
            return
        self._build_line = line
        logger.info("run %d: %s", self._hand.run.id, line)
        with contextlib.suppress(OSError):
            self._hand.folder.preparation.write_text(line[:MOST_OF_A_LINE], encoding="utf-8")


# -- watch a running run: sample it, and end it at its limits, by its stop rules, or when the user cancels it ----------


LINGER_S = 10.0
"""How long an algorithm may take to exit after ``finished`` before it is stopped; its result counts."""

_ENDINGS = {
    "timeout": "time limit reached",
    "disk_limit": "disk limit reached",
    "process_limit": "limit of processes reached",
    "linger": "finished",
    "stop_when": "ended early",
}

_AT_ONCE = frozenset({"disk_limit", "process_limit"})
"""Endings after which the run is killed at once."""


class Watch:
    """Watches one run until it has ended or the user cancels it."""

    def __init__(self, hand: RunInHand) -> None:
        self._hand = hand
        self._sampler: Sampler | None = None
        self._finished_at: datetime | None = None

    def watch(self) -> None:
        """Move the run to ``collecting`` or ``cancelling``."""
        with self._sampled() as sampled:
            cause = self._wait_for_end()
        if cause == "cancelled":
            self._hand.move(RunState.CANCELLING, CANCELLED_BY_USER, record=sampled)
            return
        stopped_because = self._hand.keeper.read().get(STOPPED_BECAUSE, cause)
        self._hand.move(RunState.COLLECTING, _ENDINGS.get(stopped_because, stopped_because), record=sampled)

    @contextmanager
    def _sampled(self) -> Iterator[dict[str, Any]]:
        """Sample during the block; yields what the record is to hold of it, filled in once the block has ended."""
        hand = self._hand
        found: dict[str, Any] = {}
        source = hand.executor.usage_source(hand.handle)
        if source is None:
            yield found
            return
        interval_s = hand.context.settings.sample_interval_s
        offset_s, here = max(0.0, hand.elapsed_s()), source.on_this_machine
        energy = EnergyLog(hand.folder.energy, POWERCAP if here else None)

        def ask_executor(_time_s: float, _run_cpu_s: float) -> HostReading | None:
            return hand.executor.host_reading(hand.handle)

        reader = HostReader(HostCounters(hand.spec.limits.cpuset)).read if here else ask_executor
        gpu = hand.keeper.read().get("gpu")
        use = None if gpu is None else GpuLog(hand.folder.gpu, lambda: hand.executor.gpu_use(hand.handle, gpu["uuid"]))
        machine = MachineLogs(energy, HostLog(hand.folder.host, reader), use)
        self._sampler = Sampler(source, hand.folder.profiling, interval_s, offset_s=offset_s, machine=machine)
        self._sampler.start()
        moves = False
        try:
            yield found
            moves = True
        finally:
            if totals := self._sampler.stop():
                found["kernel_totals"] = totals
            if found and not moves:
                with suppress(LeaseLost):  # then the totals that the new holder of the run sees count
                    hand.save(found)

    def _wait_for_end(self) -> str:
        """Return ``exited``, ``gone``, ``cancelled``, or the value to store under :data:`STOPPED_BECAUSE`."""
        hand = self._hand
        saved = hand.keeper.read()
        disk = DiskWatch(hand, disk_limits(saved))
        engine_was_away = ENGINE_AWAY in saved
        while True:
            status = hand.executor.poll(hand.handle)
            if not isinstance(status, Running):
                return "gone" if isinstance(status, Gone) else "exited"
            if engine_was_away:
                # The run has outlived the absence of its engine: from now on, its exit code is its own.
                hand.save({}, without=ENGINE_AWAY)
                engine_was_away = False
            if hand.cancel_requested():
                return "cancelled"
            if STOPPED_BECAUSE in saved:
                # A worker recorded why and died before it stopped the run; the cause may have passed by now.
                return self._stop(saved[STOPPED_BECAUSE])
            hand.executor.refresh(hand.spec, hand.handle)
            cause = {STOPPED_BECAUSE: "process_limit"} if status.process_limit else self._cause_to_stop(status, disk)
            if cause is not None:
                # Record the reason before the stop, so that the exit code is not blamed on the algorithm.
                hand.save(cause)
                return self._stop(cause[STOPPED_BECAUSE])
            hand.check_still_ours()
            hand.context.stopping.wait(hand.context.settings.poll_interval_s)

    def _cause_to_stop(self, status: Running, disk: DiskWatch) -> dict[str, Any] | None:
        """Return the record entries that say why the run must stop now; None if it may continue."""
        hand = self._hand
        if status.delivering:
            return None
        # A node that cannot be asked may have ended the run since: count the time up to the last sign of it.
        seen_s = hand.elapsed_s() if status.as_of is None else (status.as_of - hand.started_at).total_seconds()
        if seen_s > hand.spec.timeout_s:
            return {STOPPED_BECAUSE: "timeout"}
        exceeded = disk.exceeded()
        if exceeded is not None:
            return {STOPPED_BECAUSE: "disk_limit", DISK_LIMIT: exceeded}
        if self._finished_at is None and is_finished(hand.folder.finished):
            self._finished_at = hand.context.now()
        if self._finished_at is not None:
            # The result is complete: there is nothing to end early.
            lingered_s = (hand.context.now() - self._finished_at).total_seconds()
            return {STOPPED_BECAUSE: "linger"} if lingered_s > LINGER_S else None
        rules = hand.run.stop_when
        observation = Observation(
            elapsed_s=hand.elapsed_s(),
            memory_bytes=None if self._sampler is None else self._sampler.most_bytes,
            untracked_s=untracked_s(hand.folder) if rules.lost_tracking_s is not None else None,
        )
        broken = broken_rule(rules, observation)
        if broken is None:
            return None
        return {STOPPED_BECAUSE: "stop_when", STOP_RULE: {"reason": broken.reason.value, "detail": broken.detail}}

    def _stop(self, cause: str) -> str:
        # A run that fills the disk or forks would continue during a grace period.
        grace_s = 0.0 if cause in _AT_ONCE else self._hand.context.settings.stop_grace_s
        self._hand.executor.stop(self._hand.handle, grace_s)
        return cause
