"""Evaluate runs: queue evaluations in the database, and execute them in batches of many runs."""

from __future__ import annotations

import contextlib
import json
import logging
import stat
import threading
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import sweep_folder, temporary_folder, write_aside
from slamhive.base.settings import Settings
from slamhive.documents.protocol import ProtocolMatchDocument, ProtocolSearchDocument
from slamhive.domain.claim import MetricFamily, PrintedUnit, read_printed
from slamhive.domain.configuration import clipped_span_s
from slamhive.domain.dataset import Dataset
from slamhive.domain.protocol import Alignment, Duplicates, Protocol, ProtocolRequest, TrajectoryKind
from slamhive.domain.sensors import IDENTITY4, Matrix4
from slamhive.domain.verdict import Hint
from slamhive.evaluation.evaluators.base import (
    COVARIANCES,
    IMAGE_TIMES,
    KITTI_ESTIMATE,
    KITTI_REFERENCE,
    MAP,
    REFERENCE_MAP,
    RELATIONS,
    UNCERTAINTIES,
)
from slamhive.evaluation.job import (
    RESULT_FILE,
    Artefacts,
    EvaluationResult,
    EvaluationTask,
    failed_result,
    result_from_json,
)
from slamhive.evaluation.protocol_search import SearchInput, search_protocols
from slamhive.evaluation.references import References, TruthReference
from slamhive.evaluation.runner import EvaluationRunner
from slamhive.executors.host import owner_is_dead
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import Catalogue, algorithm_here_or_elsewhere, check_writable, trajectory_frame
from slamhive.services.evaluations.protocols import ProtocolService, fitting_protocol, reference_path
from slamhive.store import Store
from slamhive.store.records import EvaluationRecord, LeaseLost, RunRecord
from slamhive.trajectory.layout import parse_tum
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.table import read_bounded

logger = logging.getLogger(__name__)


def evaluation_files(folder: RunFolder, dataset: Dataset) -> dict[str, Path]:
    """The files by the names that evaluators use; missing files and links are left out."""
    truth = dataset.groundtruth
    named = {
        COVARIANCES: folder.covariances,
        MAP: folder.map,
        UNCERTAINTIES: None if truth is None or truth.uncertainties is None else dataset.folder / truth.uncertainties,
        IMAGE_TIMES: None if truth is None or truth.image_times is None else dataset.folder / truth.image_times,
        RELATIONS: None if dataset.relations is None else dataset.folder / dataset.relations,
        REFERENCE_MAP: None if dataset.reference_map is None else dataset.folder / dataset.reference_map,
        KITTI_ESTIMATE: folder.kitti_poses,
        KITTI_REFERENCE: None if truth is None or truth.kitti_poses is None else dataset.folder / truth.kitti_poses,
    }
    found: dict[str, Path] = {}
    for name, path in named.items():
        if path is not None:
            with contextlib.suppress(OSError):
                if stat.S_ISREG(path.lstat().st_mode):  # an algorithm may have replaced it with a link
                    found[name] = path
    return found


def protocols_of_all(run: RunRecord, folder: RunFolder, protocol: Protocol) -> list[Protocol]:
    """``protocol``, and the same for each other trajectory that the run left."""
    if protocol.trajectory is not None:
        return [protocol]
    return [protocol, *(replace(protocol, trajectory=kind) for kind in other_trajectories(run, folder))]


def other_trajectories(run: RunRecord, folder: RunFolder) -> list[TrajectoryKind]:
    """The kinds that the run left besides ``traj.txt``."""
    found: list[TrajectoryKind] = []
    for kind in TrajectoryKind:
        if kind is not run.trajectory:
            with contextlib.suppress(OSError):
                if folder.trajectory_of(kind).stat().st_size > 0:
                    found.append(kind)
    return found


def estimate_of(run: RunRecord, folder: RunFolder, protocol: Protocol) -> Path:
    """The trajectory that ``protocol`` judges; raises InvalidInput if the run has none of that kind."""
    kind = protocol.trajectory
    if kind is None or kind is run.trajectory:
        return folder.trajectory
    others = other_trajectories(run, folder)
    if kind not in others:
        has = ", ".join(filter(None, (run.trajectory or "traj.txt, whose kind is not stated", *others)))
        raise InvalidInput(
            f"run {run.id} has no {kind.adjective} trajectory; it has {has}",
            "evaluate under a protocol without 'trajectory'",
        )
    return folder.trajectory_of(kind)


# Scratch folders of batches, removed even if a batch is killed.

_PREFIX = ".evaluation-"


@contextmanager
def scratch_folder(data: Path) -> Iterator[Path]:
    """A folder below ``data``, removed at the end; leftovers of killed processes are removed first."""
    sweep_scratch(data)
    with temporary_folder(_PREFIX, data) as folder:
        yield folder


def sweep_scratch(data: Path) -> None:
    """Remove the folders of killed batches."""
    for left in data.glob(f"{_PREFIX}*"):
        sweep_folder(left)


PROTOCOL_FILE = "protocol.json"
BATCH_SIZE = 100
NO_ENGINE = "slamhive"

ResultCallback = Callable[[EvaluationRecord, EvaluationResult], None]
ResultStore = Callable[[EvaluationResult], None]


class Evaluations:
    """Queue evaluations and work through them.

    Args:
        settings: Association tolerance and gap threshold of the default protocols; the data root.
        store: Queue and results.
        catalogue: Sensor setups, extrinsics and ground truths.
        protocols: Knows protocols by name.
        runner: Makes what starts the evaluation engine, in a container or a process; called on first use.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        catalogue: Catalogue,
        protocols: ProtocolService,
        runner: Callable[[], EvaluationRunner],
    ) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._protocols = protocols
        self._make_runner = runner
        self._runner: EvaluationRunner | None = None
        self._runner_lock = threading.Lock()

    def queue(
        self,
        run_ids: Iterable[int] | None,
        asked: ProtocolRequest | str | None = None,
        artefacts: Artefacts = Artefacts.FILES,
        *,
        makes_current: bool = False,
    ) -> list[int]:
        """Queue an evaluation of each run, or with None of each that has none; returns the ids of the evaluations.

        ``makes_current``: lists show the metrics of this protocol as soon as it has been evaluated.

        ``asked`` is a protocol or the name of one. None means the one that the run was submitted with, or else the
        default for its sensors, and the same for each other trajectory that the run left. Raises NotFound for an
        unknown run, algorithm or protocol, Conflict for a run that did not succeed; nothing is queued then.
        """
        check_writable(self._settings)
        if isinstance(asked, str):
            asked = self._protocols.named(asked)
        wanted = self.unevaluated() if run_ids is None else run_ids
        runs = self._store.read(lambda t: t.runs.get_many(wanted))
        by_protocol: dict[Protocol, list[int]] = defaultdict(list)
        # The protocol is resolved once for all runs of an algorithm on a dataset.
        alike: dict[tuple[str, str, str | None], list[RunRecord]] = defaultdict(list)
        for run in runs:
            own = None if run.protocol_override is None else run.protocol_override.fingerprint
            alike[run.algorithm, run.dataset, own].append(run)
        for members in alike.values():
            protocol = self.protocol_of(members[0], asked)
            by_protocol[protocol] += [run.id for run in members]
            for run in members if asked is None else ():
                for other in protocols_of_all(run, self._folder(run.id), protocol)[1:]:
                    by_protocol[other].append(run.id)
        now = utc_now()
        return self._store.write(
            lambda t: [
                evaluation_id
                for protocol, members in by_protocol.items()
                for evaluation_id in t.evaluations.queue(members, protocol, now, artefacts, makes_current=makes_current)
            ]
        )

    def of_run(self, run_id: int) -> tuple[EvaluationRecord, ...]:
        """The evaluations of a run, oldest first."""
        return tuple(self._store.read(lambda t: t.evaluations.for_run(run_id)))

    def records(self, evaluation_ids: Iterable[int]) -> list[EvaluationRecord]:
        """The evaluations with these ids."""
        return self._store.read(lambda t: t.evaluations.get_many(evaluation_ids))

    def waiting(self) -> list[EvaluationRecord]:
        """All evaluations that are queued or running."""
        return self._store.read(lambda t: t.evaluations.open())

    def standing(self) -> tuple[int, int]:
        """The number of evaluations that are queued or running, and the highest id of all."""
        return self._store.read(lambda t: t.evaluations.standing())

    def still_open(self, evaluation_ids: Iterable[int]) -> set[int]:
        """Those of these evaluations that have not ended."""
        return self._store.read(lambda t: t.evaluations.still_open(evaluation_ids))

    def unsettled(self, run_ids: Iterable[int]) -> list[int]:
        """Those of these runs that have no successful evaluation."""
        return self._store.read(lambda t: t.evaluations.unsettled_among(run_ids))

    def take_over_from_the_dead(self) -> None:
        """Release the evaluations of killed processes on this machine, before their leases expire."""
        for owner in self._store.read(lambda t: t.evaluations.owners()):
            if owner_is_dead(owner):
                self._store.write(lambda t, owner=owner: t.evaluations.release_all(owner))  # type: ignore[misc]

    def unevaluated(self) -> list[int]:
        """The ids of successful runs without an evaluation."""
        return self._store.read(lambda t: t.evaluations.unevaluated_run_ids())

    def prepare(self, progress: Callable[[str], None]) -> None:
        """Make what evaluations need (in Docker: their image) unless it is there, instead of with the first of them.

        ``progress`` takes one line of what goes on. Raises SlamHiveError if it cannot be made.
        """
        self._engine().prepare(progress)

    def measure(
        self,
        tasks: Sequence[EvaluationTask],
        scratch: Path,
        stopping: threading.Event,
        cores: tuple[int, ...] | None = None,
    ) -> list[EvaluationResult]:
        """Evaluate tasks that belong to no run; nothing is stored. Fewer results if ``stopping`` was set meanwhile.

        Raises SlamHiveError if evaluations cannot be started.
        """
        return self._engine().run(tasks, scratch, lambda _result: None, stopping, cores)

    def work_once(
        self,
        owner: str,
        stopping: threading.Event,
        only: Collection[int] | None = None,
        on_result: ResultCallback | None = None,
        cores: tuple[int, ...] | None = None,
    ) -> int:
        """Claim a batch, evaluate it, store each result; returns the size of the batch.

        ``only`` restricts the choice to evaluations of these runs; ``cores`` are the numbers of those to evaluate on,
        None for all.
        """
        lease_s = self._settings.lease_s
        claimed = self._store.write(lambda t: t.evaluations.claim(t.lease(owner, lease_s), BATCH_SIZE, only))
        if not claimed:
            return 0
        heartbeat_ends, numbers = threading.Event(), [entry.id for entry in claimed]

        def beat() -> None:
            while not heartbeat_ends.wait(lease_s / 3):
                try:
                    self._store.write(lambda t: t.evaluations.heartbeat(numbers, t.lease(owner, lease_s)))
                except SlamHiveError as error:
                    logger.warning("heartbeat of evaluations: %s", error)

        heartbeat = threading.Thread(target=beat, daemon=True)
        heartbeat.start()
        try:
            self._evaluate(claimed, owner, stopping, on_result, cores)
        finally:
            heartbeat_ends.set()
            heartbeat.join()
            # Evaluations without a result (the engine did not start, the worker is stopping) return to the queue.
            self._store.write(lambda t: t.evaluations.release(numbers, owner))
        return len(claimed)

    def _evaluate(
        self,
        claimed: Sequence[EvaluationRecord],
        owner: str,
        stopping: threading.Event,
        on_result: ResultCallback | None,
        cores: tuple[int, ...] | None,
    ) -> None:
        by_id = {str(entry.id): entry for entry in claimed}

        def store(result: EvaluationResult) -> None:
            entry = by_id[result.id]
            now = utc_now()
            try:
                first = self._store.write(lambda t: t.evaluations.finish(entry.id, owner, result, now))
                if first:
                    self._folder(entry.run_id).write_current_protocol(result.fingerprint)
            except LeaseLost as error:
                logger.warning("%s", error)
            if result.reason is not None:
                logger.warning("run %d cannot be evaluated: %s", entry.run_id, result.reason)
            if on_result is not None:
                on_result(entry, result)

        tasks = self._tasks(claimed, store)
        if tasks:
            with scratch_folder(self._settings.data) as scratch:
                self._run(tasks, scratch, store, stopping, cores)

    def _tasks(self, claimed: Sequence[EvaluationRecord], refuse: ResultStore) -> list[EvaluationTask]:
        """The tasks for the engine; an evaluation that cannot start fails with its reason."""
        runs = {run.id: run for run in self._store.read(lambda t: t.runs.get_many({e.run_id for e in claimed}))}
        tasks: list[EvaluationTask] = []
        for entry in claimed:
            try:
                tasks.append(self._task(entry, runs[entry.run_id]))
            except Unavailable:
                raise
            except SlamHiveError as error:
                refuse(_refused(entry, str(error)))
        return tasks

    def _run(
        self,
        tasks: Sequence[EvaluationTask],
        scratch: Path,
        store: ResultStore,
        stopping: threading.Event,
        cores: tuple[int, ...] | None,
    ) -> None:
        try:
            self._engine().run(tasks, scratch, store, stopping, cores)
        except (Unavailable, LeaseLost):
            raise
        except SlamHiveError as error:
            # The engine cannot be made (for example, its image does not build): another attempt would fail as well.
            self._fail_all(tasks, str(error), store)
        except Exception as error:
            logger.exception("internal error while evaluating %d runs", len(tasks))
            self._fail_all(tasks, f"internal error: {type(error).__name__}: {error}", store)

    def _fail_all(self, tasks: Sequence[EvaluationTask], reason: str, store: ResultStore) -> None:
        for task in tasks:
            store(failed_result(task, reason, NO_ENGINE))

    def _engine(self) -> EvaluationRunner:
        with self._runner_lock:
            if self._runner is None:
                self._runner = self._make_runner()
            return self._runner

    def _task(self, entry: EvaluationRecord, run: RunRecord) -> EvaluationTask:
        dataset = self._catalogue.dataset(run.dataset)
        reference = reference_path(dataset, entry.protocol)
        folder = self._folder(run.id)
        output = folder.evaluation(entry.protocol.fingerprint)
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unavailable(f"{output} cannot be made: {error.strerror}", "check space and rights") from None
        write_aside(output / PROTOCOL_FILE, json.dumps(entry.protocol.content, indent=1))
        return EvaluationTask(
            id=str(entry.id),
            estimate=estimate_of(run, folder, entry.protocol),
            reference=reference,
            output=output,
            protocol=entry.protocol,
            T_body_sensor=self.trajectory_frame(run),
            artefacts=entry.artefacts,
            positions_only=dataset.groundtruth is not None and dataset.groundtruth.positions_only,
            files=evaluation_files(folder, dataset),
            lever_arm_m=None if dataset.groundtruth is None else dataset.groundtruth.lever_arm_m,
            uncertainty_m=None if dataset.groundtruth is None else dataset.groundtruth.uncertainty_m,
            span_s=clipped_span_s([sensor.name for sensor in dataset.sensors], run.variant),
        )

    def _folder(self, run_id: int) -> RunFolder:
        return RunFolder(self._settings.runs_folder / str(run_id))

    def trajectory_frame(self, run: RunRecord) -> Matrix4:
        """The pose, in the body frame, of the sensor that the trajectory describes; that of an import is the body's."""
        return trajectory_frame(self._store, self._catalogue, run)

    def protocol_of(self, run: RunRecord, asked: ProtocolRequest | None = None) -> Protocol:
        """The protocol for evaluating ``run``: as requested, as submitted, or the default for its sensors."""
        if asked is None and run.protocol_override is not None:
            return run.protocol_override
        algorithm = algorithm_here_or_elsewhere(self._store, self._catalogue, run)
        return fitting_protocol(algorithm, self._catalogue.dataset(run.dataset), self._settings, asked)


def read_estimate(path: Path) -> Trajectory:
    """The trajectory at ``path``, of equal timestamps all; raises InvalidInput for a link or a damaged file."""
    if path.is_symlink():
        raise InvalidInput(f"the trajectory {path.name} is a link, which is not followed")
    return parse_tum(read_bounded(path), path.name, Duplicates.KEEP)


class ProtocolSearches:
    """Protocols of a run that give a printed number. One search runs at a time: each takes seconds of a core.

    Args:
        settings: The run folders.
        store: The runs.
        catalogue: Ground truths and sensors.
        evaluations: Knows the frame of a run's trajectory.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue, evaluations: Evaluations) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._evaluations = evaluations
        self._turn = threading.Lock()

    def search(
        self, run_id: int, printed: str, metric: str, unit: str | None = None, within: float = 0.0
    ) -> ProtocolSearchDocument:
        """All protocols under which the run gives the number ``printed``, which keeps its digits.

        With ``within``, also those that give a number which differs by no more than that, in the printed unit.
        Raises InvalidInput for a number, metric or unit that is none, and for a dataset without a ground truth.
        """
        family, asked = _member(MetricFamily, metric), None if unit is None else _member(PrintedUnit, unit)
        number = read_printed(printed, asked)
        number = replace(number, within=max(number.within, within))
        run = self._store.read(lambda t: t.runs.get(run_id))
        dataset = self._catalogue.dataset(run.dataset)
        path, truth = dataset.groundtruth_path, dataset.groundtruth
        if path is None or truth is None:
            raise InvalidInput(f"dataset {dataset.name} has no ground-truth trajectory", "choose another run")
        folder = RunFolder(self._settings.runs_folder / str(run.id))
        kinds = [None, *other_trajectories(run, folder)]
        estimates = {
            kind: read_estimate(folder.trajectory if kind is None else folder.trajectory_of(kind)) for kind in kinds
        }
        own, references = self._evaluations.trajectory_frame(run), References()
        task = EvaluationTask(
            id=str(run.id),
            estimate=folder.trajectory,
            reference=path,
            output=folder.root,
            protocol=Protocol(Alignment.NONE, duplicates=Duplicates.KEEP),
            T_body_sensor=own,
            positions_only=truth.positions_only,
            lever_arm_m=truth.lever_arm_m,
        )

        def reference_of(T_body_sensor: Matrix4 | None) -> TruthReference:
            return references.of(task if T_body_sensor is None else replace(task, T_body_sensor=T_body_sensor))

        frames = {"the body": IDENTITY4, **{sensor.name: sensor.T_body_sensor for sensor in dataset.sensors}}
        others: dict[str, Matrix4] = {}
        for name, T_body_sensor in frames.items():
            if T_body_sensor not in (own, *others.values()):
                others[name] = T_body_sensor
        with self._turn:
            files = evaluation_files(folder, dataset)
            found = search_protocols(
                SearchInput(reference_of, estimates, others, truth.gravity_aligned, files), number, family
            )
        return ProtocolSearchDocument(
            run=run.id,
            printed=printed,
            metric=family.value,
            tried=found.tried,
            matches=tuple(
                ProtocolMatchDocument.of(match, fingerprint=match.protocol.fingerprint, unit=match.unit.value)
                for match in found.matches
            ),
            skipped=dict(found.skipped),
        )


_Choice = TypeVar("_Choice", MetricFamily, PrintedUnit)


def _member(kind: type[_Choice], text: str) -> _Choice:
    try:
        return kind(text)
    except ValueError:
        raise InvalidInput(f"{text[:40]!r} is not known", f"use one of {', '.join(kind)}") from None


def _refused(entry: EvaluationRecord, reason: str) -> EvaluationResult:
    """The result of an evaluation that could not start."""
    nowhere = Path()
    return failed_result(EvaluationTask(str(entry.id), nowhere, None, nowhere, entry.protocol), reason, NO_ENGINE)


# Notes in the run folder: why metrics are missing, and hints at mistakes.

_MAX_RESULT_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class EvaluationNotes:
    """``missing``: {metric key: why it has no value}. ``hints``: likely mistakes that the errors point to."""

    missing: Mapping[str, str] = field(default_factory=dict)
    hints: tuple[Hint, ...] = ()


def evaluation_notes(folder: RunFolder, fingerprint: str | None) -> EvaluationNotes:
    """The notes of the evaluation under the protocol with this fingerprint; empty if there are none."""
    if fingerprint is None:
        return EvaluationNotes()
    try:
        with (folder.evaluation(fingerprint) / RESULT_FILE).open(encoding="utf-8") as stream:
            result = result_from_json(stream.read(_MAX_RESULT_BYTES))
    except (OSError, ValueError, InvalidInput):
        return EvaluationNotes()
    return EvaluationNotes(result.missing, result.hints)
