"""Runs: submitted, retried, cancelled and watched."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamhive.clock import utc_now
from slamhive.domain.affinity import run_affinity
from slamhive.domain.protocol import Protocol
from slamhive.domain.protocol_request import exactly
from slamhive.domain.run import RunState
from slamhive.domain.visibility import Visibility
from slamhive.errors import SlamHiveError
from slamhive.files import temporary_folder
from slamhive.runs.log_line import read_tail
from slamhive.schema.submission import Submission
from slamhive.services.configurations import Checked, Configurations, put_configuration
from slamhive.services.datasets import check_writable
from slamhive.services.evaluations import fitting_protocol, protocol_for
from slamhive.services.executors import Executors
from slamhive.services.runs.moments import Moment, moment_at
from slamhive.services.runs.progress import RunProgress, run_progress
from slamhive.services.runs.record import handle_from_json
from slamhive.services.runs.retrying import check_retriable, retry_request
from slamhive.services.runs.scene import RunScene, SceneFrame, SceneFrames, run_scene
from slamhive.services.runs.series import RunSeries, Samples, error_over_time, gap_of, run_series
from slamhive.services.runs.specification import RunLimits, check_disk, check_executor, check_recorded, recorded_topics
from slamhive.services.runs.stored import StoredRuns
from slamhive.services.versions import check_version
from slamhive.services.weights import WeightsStore
from slamhive.settings import Settings
from slamhive.store import RunRecord, RunRequest, Store, Transaction

logger = logging.getLogger(__name__)

LOG_TAIL_BYTES = 200_000


class Runs(StoredRuns):
    """The runs of one installation.

    Args:
        settings: Mode, disk limits and default protocol.
        store: The database.
        configurations: Checks what is submitted.
        executors: What runs are executed by.
    """

    def __init__(self, settings: Settings, store: Store, configurations: Configurations, executors: Executors) -> None:
        super().__init__(settings, store)
        self._configurations = configurations
        self._executors = executors
        self._frames = SceneFrames()

    def submit(self, submission: Submission, evaluated_under: Protocol | None = None) -> tuple[RunRecord, ...]:
        """Check everything that can be checked before a run starts, then queue ``repeat`` runs.

        Repeats get the seeds ``seed``, ``seed + 1``, ... and share one configuration. ``evaluated_under`` is the
        protocol of their evaluation; None for what the submission says.
        """
        check_writable(self._settings)
        checked = self._configurations.check(submission)
        algorithm, dataset = checked.algorithm, checked.dataset
        check_recorded(dataset, algorithm, recorded_topics(dataset), checked.configuration.sensors)
        check_disk(self._settings)
        executor = self._executors.choose(submission.executor)
        asked = RunLimits(submission.cpu_cores, submission.memory_mb)
        check_executor(self._executors.get(executor), algorithm.package, asked)
        if not self._executors.get(executor).capabilities.makes_variants:
            self._configurations.check_room(checked)
        WeightsStore(self._settings).check_present(algorithm.package)
        check_version(self._store, self._executors.get(executor), algorithm)
        protocol = None
        if evaluated_under is not None:
            asked_for = exactly(evaluated_under, evaluated_under.fingerprint)
            protocol = fitting_protocol(algorithm, dataset, self._settings, asked_for)
        elif submission.alignment is not None:
            protocol = protocol_for(algorithm, dataset, self._settings, submission.alignment)
        now = utc_now()

        def work(t: Transaction) -> list[int]:
            configuration_id, _ = put_configuration(t, checked, now)
            return t.runs.add_runs(_requests(submission, checked, configuration_id, executor, protocol), now)

        run_ids = self._store.write(work)
        return self._store.read(lambda t: t.runs.get_many(run_ids))

    def submit_configuration(self, configuration_id: int, **fields: Any) -> tuple[RunRecord, ...]:
        """Queue runs of a stored configuration; ``fields`` are those of a :class:`Submission` that say how to run it.

        Raises InvalidInput if the algorithm, as it is defined now, no longer takes the stored values.
        """
        self._configurations.check_runnable(configuration_id)
        submission, _ = self._configurations.submission(configuration_id)
        return self.submit(replace(submission, **fields))

    def retry(self, run_id: int) -> RunRecord:
        """Queue a new run with the configuration of one that has ended; raises as :meth:`submit_configuration`."""
        return self.retry_all([run_id])[0]

    def retry_all(self, run_ids: Sequence[int]) -> tuple[RunRecord, ...]:
        """As :meth:`retry`, of several runs: queues a new run for each, or none."""
        check_writable(self._settings)
        runs = [self.get(run_id) for run_id in run_ids]
        for old in runs:
            check_retriable(old)
        for configuration_id in {old.configuration_id for old in runs}:
            self._configurations.check_runnable(configuration_id)
        uids, now = [uuid.uuid4().hex for _ in runs], utc_now()

        def work(t: Transaction) -> list[int]:
            return t.runs.add_runs([retry_request(t, old, uid) for old, uid in zip(runs, uids, strict=True)], now)

        new_ids = self._store.write(work)
        return self._store.read(lambda t: t.runs.get_many(new_ids))

    def cancel(self, run_id: int) -> RunRecord:
        """Cancel a queued run at once; ask the worker to end an active one."""
        check_writable(self._settings)
        now = utc_now()
        self._store.write(lambda t: t.runs.request_cancel(run_id, now))
        return self.get(run_id)

    def log(self, run_id: int, max_bytes: int = LOG_TAIL_BYTES) -> str:
        """The last ``max_bytes`` of the run's output so far."""
        return self.log_of(self.get(run_id), max_bytes)

    def log_of(self, run: RunRecord, max_bytes: int = LOG_TAIL_BYTES) -> str:
        """As :meth:`log`, of a run that was just read."""
        folder = self.folder(run.id)
        if run.state is not RunState.RUNNING or run.handle is None:
            return read_tail(folder.log, max_bytes)
        # Fetched into another folder: the worker may store the complete log in the run's folder at the same time.
        with temporary_folder() as aside:
            path = aside / folder.log.name
            self._fetch_log(run, path)
            return read_tail(path, max_bytes) or read_tail(folder.log, max_bytes)

    def progress(self, run_id: int) -> RunProgress | None:
        """The progress of an active run; None for one that is queued or has ended."""
        run = self.get(run_id)
        record = self.record(run_id) if run.state.active else {}
        return run_progress(run, self.folder(run_id), utc_now(), record.get("dataset", {}).get("duration_s"))

    def series(self, run_id: int) -> RunSeries:
        """Trajectory, errors, resources and latencies of a run over time."""
        return run_series(self.get(run_id), self.folder(run_id))

    def error_over_time(self, run_id: int) -> Samples | None:
        """The position error of a run under its current protocol; None if there is none. Reads nothing else."""
        run = self.get(run_id)
        if run.protocol is None:
            return None
        evaluation = self.folder(run_id).evaluation(run.protocol.fingerprint)
        return error_over_time(evaluation, gap_of(evaluation))

    def scene(self, run_id: int, fingerprint: str | None = None) -> RunScene:
        """The trajectories of a run in one frame, under its current protocol or the one with this fingerprint."""
        run = self.get(run_id)
        current = None if run.protocol is None else run.protocol.fingerprint
        return run_scene(run, self.folder(run_id), fingerprint or current)

    def map_frame(self, run: RunRecord) -> SceneFrame:
        """Where the map of a run lies in :meth:`scene`, without reading what else is shown there."""
        return self._frames.get(run, self.folder(run.id), None if run.protocol is None else run.protocol.fingerprint)

    def moment(self, run_id: int, timestamp_s: float) -> Moment:
        """The error and the frame of a run at a header timestamp."""
        return moment_at(self.get(run_id), self.folder(run_id), timestamp_s)

    def _fetch_log(self, run: RunRecord, path: Path) -> None:
        try:
            self._executors.get(run.executor).save_log(handle_from_json(run.handle or {}), path)
        except SlamHiveError as error:
            logger.info("log of run %d: %s", run.id, error)


def _requests(
    submission: Submission, checked: Checked, configuration_id: int, executor: str, protocol: Protocol | None
) -> list[RunRequest]:
    """One request for each repeat."""
    affinity = run_affinity(checked.dataset.name, checked.configuration.variant, checked.algorithm.package.name)
    return [
        RunRequest(
            uid=uuid.uuid4().hex,
            configuration_id=configuration_id,
            executor=executor,
            seed=submission.seed + index,
            priority=submission.priority,
            evaluate=submission.evaluate,
            cpu_cores=submission.cpu_cores,
            memory_mb=submission.memory_mb,
            timeout_s=submission.timeout_s,
            protocol=protocol,
            affinity=affinity,
            stop_when=submission.stop_when,
            repeat_disturbed=submission.repeat_disturbed,
            visibility=None if submission.visibility is None else Visibility(submission.visibility),
        )
        for index in range(submission.repeat)
    ]
