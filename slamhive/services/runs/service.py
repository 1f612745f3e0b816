"""Runs: submitted, retried, cancelled and watched."""

from __future__ import annotations

import hashlib
import logging
import uuid
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, SlamHiveError
from slamhive.base.files import temporary_folder
from slamhive.base.settings import Settings
from slamhive.documents.submission import Submission
from slamhive.domain.accounts import Visibility
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.placement import run_affinity
from slamhive.domain.protocol import Protocol, exactly
from slamhive.domain.run import NotesChange, RunNotes, RunState
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.outcome import read_tail
from slamhive.services.configurations import Checked, Configurations, put_configuration
from slamhive.services.datasets import check_writable
from slamhive.services.evaluations import fitting_protocol, protocol_for
from slamhive.services.executors import Executors
from slamhive.services.runs.files import RunProgress, run_progress
from slamhive.services.runs.record import handle_from_json
from slamhive.services.runs.scene import Moment, RunScene, SceneFrame, SceneFrames, moment_at, run_scene
from slamhive.services.runs.series import RunSeries, Samples, TrackFiles, error_over_time, gap_of, run_series
from slamhive.services.runs.specification import check_disk, check_executor, check_recorded, recorded_topics
from slamhive.services.runs.stored import StoredRuns
from slamhive.services.versions import check_version
from slamhive.services.weights import WeightsStore
from slamhive.store import RunRecord, RunRequest, Store, Transaction
from slamhive.store.records import ExperimentState

# Retry runs: a new run takes over the request of an old one.


def check_retriable(old: RunRecord) -> None:
    """Raise Conflict for a run that has not ended or was imported."""
    if old.executor == IMPORTED:
        raise Conflict(f"run {old.id} was imported: it cannot be run again here", "import its next trial")
    if not old.state.ended:
        raise Conflict(f"run {old.id} is {old.state}", "only a run that has ended can be retried")


def retry_request(t: Transaction, old: RunRecord, uid: str) -> RunRequest:
    """The request for a new run with the options of ``old``; held if its experiment is paused."""
    experiment = None if old.experiment is None else t.experiments.locked(old.experiment)
    return RunRequest(
        uid=uid,
        configuration_id=old.configuration_id,
        executor=old.executor,
        seed=old.seed,
        **old.options,
        retry_of=old.id,
        protocol=old.protocol_override,
        experiment_id=old.experiment_id,
        cell=old.cell,
        held=experiment is not None and experiment.state is ExperimentState.PAUSED,
        affinity=old.affinity,
    )


def repeat_if_disturbed(t: Transaction, run: RunRecord, now: datetime) -> None:
    """Queue a repetition of ``run`` if it ended disturbed and may be repeated; a second call adds nothing.

    The repetition may be repeated one time less. It is stored in the transaction that ends the run, so that a worker
    that dies leaves both changes or none.
    """
    wanted = run.disturbance is not None and run.disturbance.disturbed and run.repeat_disturbed > 0
    if not wanted or run.state not in (RunState.SUCCEEDED, RunState.FAILED):
        return
    if run.experiment is not None and t.experiments.locked(run.experiment).state is ExperimentState.CANCELLED:
        return
    request = retry_request(t, run, run_uid(run.uid, "undisturbed"))
    t.runs.add_runs([replace(request, repeat_disturbed=run.repeat_disturbed - 1)], now, deleted_too=False)


def run_uid(origin: str, *parts: object) -> str:
    """The uid of a run, from its place in an experiment or the run that it repeats: no run is stored twice."""
    text = "/".join(map(str, (origin, *parts)))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


logger = logging.getLogger(__name__)

LOG_TAIL_BYTES = 200_000


class RunService(StoredRuns):
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
        check_executor(self._executors.get(executor), algorithm.package, submission)
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
        """The same as :meth:`retry`, of several runs: queues a new run for each, or none."""
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
        """The same as :meth:`log`, of a run that was just read."""
        folder = self.folder(run.id)
        if run.state is not RunState.RUNNING or run.handle is None:
            return read_tail(folder.log, max_bytes)
        # Fetched into another folder: the worker may store the complete log in the run's folder at the same time.
        with temporary_folder() as aside:
            path = aside / folder.log.name
            try:
                self._executors.get(run.executor).save_log(handle_from_json(run.handle), path)
            except SlamHiveError as error:
                logger.info("log of run %d: %s", run.id, error)
            return read_tail(path, max_bytes) or read_tail(folder.log, max_bytes)

    def progress(self, run_id: int) -> RunProgress | None:
        """The progress of an active run; None for one that is queued or has ended."""
        run = self.get(run_id)
        record = self.record(run_id) if run.state.active else {}
        return run_progress(run, self.folder(run_id), utc_now(), record.get("dataset", {}).get("duration_s"))

    def series(self, run_id: int, fingerprint: str | None = None) -> RunSeries:
        """Trajectory, errors, resources and latencies of a run over time.

        Under its current protocol, or the one with this fingerprint.
        """
        return run_series(self.get(run_id), self.folder(run_id), fingerprint)

    def error_over_time(self, run_id: int) -> Samples | None:
        """The position error of a run under its current protocol; None if there is none. Reads nothing else."""
        run = self.get(run_id)
        if run.protocol is None:
            return None
        evaluation = self.folder(run_id).evaluation(run.protocol.fingerprint)
        return error_over_time(evaluation, gap_of(evaluation))

    def scene(self, run: RunRecord, fingerprint: str | None = None, tracks: TrackFiles | None = None) -> RunScene:
        """The trajectories of a run in one frame, under its current protocol or the one with this fingerprint."""
        current = None if run.protocol is None else run.protocol.fingerprint
        return run_scene(run, self.folder(run.id), fingerprint or current, tracks)

    def map_frame(self, run: RunRecord) -> SceneFrame:
        """Where the map of a run lies in :meth:`scene`, without reading what else is shown there."""
        return self._frames.get(run, self.folder(run.id), None if run.protocol is None else run.protocol.fingerprint)

    def moment(self, run_id: int, timestamp_s: float, fingerprint: str | None = None) -> Moment:
        """The error, under the current protocol or the one with this fingerprint, and the frame at a timestamp."""
        return moment_at(self.get(run_id), self.folder(run_id), timestamp_s, fingerprint)


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
            **submission.options,
            protocol=protocol,
            affinity=affinity,
            visibility=None if submission.visibility is None else Visibility(submission.visibility),
        )
        for index in range(submission.repeat)
    ]


# Notes and tags of runs: written to their folders, which are the truth, and filed in the database.


class Notes:
    """Changes notes and tags.

    Args:
        settings: Mode, and where the folders of runs are.
        store: The database.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store

    def change(self, run_ids: Sequence[int], change: NotesChange) -> dict[int, RunNotes]:
        """Apply a change to these runs; their notes afterwards.

        Raises NotFound for an unknown run, InvalidInput for what cannot be kept, Conflict for a run without a folder;
        nothing is changed then.
        """
        check_writable(self._settings)
        runs = self._store.read(lambda t: t.runs.get_many(run_ids))
        changed = {run.id: change.applied(run.notes) for run in runs}
        folders = {run_id: RunFolder(self._settings.runs_folder / str(run_id)) for run_id in changed}
        for run_id, folder in folders.items():
            if not folder.record.exists():
                raise Conflict(f"run {run_id} has no folder yet", "wait until a worker has prepared it")
        for run_id, notes in changed.items():
            folders[run_id].write_notes(notes)
        self._store.write(lambda t: t.notes.put(changed))
        return changed

    def replace(self, run_id: int, note: str | None, tags: Sequence[str] | None) -> RunNotes:
        """Replace the note and the tags of a run; None keeps them. Raises as :meth:`change`."""
        before = self._store.read(lambda t: t.runs.get(run_id)).notes.tags
        kept = before if tags is None else tuple(tags)
        removed = tuple(tag for tag in before if tag not in kept)
        return self.change([run_id], NotesChange(note, kept, removed))[run_id]

    def tags(self) -> list[str]:
        """Every tag that some run has."""
        return self._store.read(lambda t: t.notes.tags())
