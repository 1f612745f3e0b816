"""The first step of a run: make and record everything that its start needs."""

from __future__ import annotations

import contextlib
import logging
from contextlib import ExitStack
from dataclasses import asdict, replace

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.documents.limits import RunOptions
from slamhive.domain.algorithm import GpuNeed
from slamhive.domain.parameters import check_stored
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import EngineUnavailable, GpuGiver, ImageMissing
from slamhive.executors.host import describe_host
from slamhive.packages.algorithm_file import package_hash
from slamhive.run_folder.outcome import skipped
from slamhive.services.configurations import find_map
from slamhive.services.runs import (
    Job,
    build_spec,
    check_dataset_files,
    check_disk,
    check_gpu,
    provenance,
    spec_to_json,
    write_config,
)
from slamhive.services.versions import identity_of_version, keep_version
from slamhive.services.weights import WeightsStore
from slamhive.services.worker.evidence import STARTED_BY
from slamhive.services.worker.run_in_hand import CANCELLED_BY_USER, RunInHand, hold_gpu
from slamhive.store import Transaction
from slamhive.store.records import AlgorithmVersion

logger = logging.getLogger(__name__)

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
