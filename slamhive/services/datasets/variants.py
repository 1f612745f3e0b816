"""Variants of datasets: plan, make, hold, list and remove them. Ground truths on trial."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import statistics
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.bounds import read_record
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.base.settings import Mode, Settings
from slamhive.documents.catalogue import ConstantOffsetDocument, ContradictionDocument, DatasetCheck, TruthTrialDocument
from slamhive.domain.accounts import ANYBODY, WITHOUT_ACCOUNTS
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import VERSION, Blame, Dataset
from slamhive.domain.run import RunState
from slamhive.domain.sensors import IDENTITY4, SensorSetup
from slamhive.domain.verdict import ERROR, VerdictKind
from slamhive.evaluation.trial import FEWEST_SYSTEMS, TruthTrial, judge_truth
from slamhive.executors.spec import VariantOrder
from slamhive.experiments.binding import resolve_variant, seen_dataset
from slamhive.filters.words import matching
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.staging import Progress
from slamhive.recordings.variants.build import plan_variant
from slamhive.recordings.variants.cache import CacheLimits, VariantCache, VariantEntry, VariantPlan
from slamhive.recordings.variants.steps import RegisteredSteps, on_all_sensors
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets.catalogue import Catalogue, algorithm_here_or_elsewhere, trajectory_frame
from slamhive.store import RunRecord, Store
from slamhive.trajectory.layout import parse_ground_truth, parse_tum
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import move_sensor, rigid_transform

logger = logging.getLogger(__name__)

IDENTITY = "identity"
"""The key of the unmodified dataset."""

_MOST_ACTIVE = 1000


@dataclass(frozen=True, slots=True)
class UsedVariant:
    """The variant that a run uses.

    Attributes:
        key: Its key, or :data:`IDENTITY`.
        dataset: As the run sees it, ready to be mounted. With an ``order``, as it will be; its files are the source's.
        order: What the node of the run has to make; None if there is nothing to make.
    """

    key: str
    dataset: Dataset
    order: VariantOrder | None = None


class VariantService:
    """The variants of one installation.

    Args:
        settings: The folder and the size of the cache.
        store: Knows which runs are active.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store
        limits = CacheLimits(settings.variant_cache_bytes, settings.min_free_disk_mb * 1_000_000)
        self.cache = VariantCache(settings.variants_folder, limits, self._used_by_runs)

    def resolve(self, dataset: Dataset, variant: Variant) -> Variant:
        """``variant`` with default options added and steps without effect removed; a step may leave sensors out.

        Raises NotFound or InvalidInput naming the step and what it cannot do.
        """
        named = [on_all_sensors(dataset, step) for step in variant]
        return resolve_variant(RegisteredSteps(), dataset, named)

    def check(self, dataset: Dataset, variant: Variant) -> None:
        """Raise whatever would keep ``variant`` from being made, disk space included; reads no recorded data."""
        plan = plan_variant(dataset, variant)
        if plan is not None:
            self.cache.check_room(plan)

    def plan(self, dataset: Dataset, variant: Variant) -> VariantPlan | None:
        """Key and estimated size of ``variant``; None for the unmodified dataset; raises as :meth:`check`."""
        return plan_variant(dataset, variant)

    def planned(self, dataset: Dataset, variant: Variant) -> Dataset:
        """``dataset`` with its sensors as ``variant`` will leave them; raises as :meth:`check`."""
        return seen_dataset(RegisteredSteps(), dataset, variant)

    def ordered(self, dataset: Dataset, variant: Variant) -> UsedVariant:
        """The variant as an order for the node of the run; raises NotFound or InvalidInput as :meth:`hold`."""
        plan = plan_variant(dataset, variant)
        if plan is None:
            return UsedVariant(IDENTITY, dataset)
        steps = tuple(dict(step) for step in plan.steps)
        order = VariantOrder(plan.key, dataset.name, dataset_to_yaml(dataset), steps, plan.needed_bytes)
        return UsedVariant(plan.key, self.planned(dataset, variant), order)

    @contextlib.contextmanager
    def hold(self, dataset: Dataset, variant: Variant, progress: Progress) -> Iterator[UsedVariant]:
        """Make the variant if necessary, and keep it in the cache until the block ends.

        Raises:
            NotFound: a step or sensor does not exist.
            InvalidInput: the steps cannot be applied, the recording is damaged, or the variant exceeds the cache.
            Unavailable: no disk space now, or a disk error.
        """
        plan = plan_variant(dataset, variant)
        if plan is None:
            yield UsedVariant(IDENTITY, dataset)
            return

        def build(folder: Path, on_progress: Progress) -> Dataset:
            from slamhive.recordings.variants.build import build_variant  # noqa: PLC0415 - loads OpenCV

            return build_variant(dataset, variant, folder, on_progress)

        with self.cache.hold(plan, build, progress) as made:
            yield UsedVariant(plan.key, made)

    @contextlib.contextmanager
    def hold_made(self, key: str) -> Iterator[None]:
        """Keep the variant of an active run in the cache until the block ends."""
        if key == IDENTITY:
            yield
            return
        with self.cache.hold_made(key):
            yield

    def entries(self, dataset: str | None = None) -> tuple[VariantEntry, ...]:
        """The variants in the cache, of one dataset or of all, most recently used first."""
        return tuple(entry for entry in self.cache.entries() if dataset is None or entry.dataset == dataset)

    def drop(self, key: str) -> None:
        """Remove a variant; raises Conflict while a run uses it."""
        self.cache.drop(key)
        self._store.note_act()

    def drop_unused(self, dataset: str) -> tuple[VariantEntry, ...]:
        """Remove all unused variants of a dataset; returns those removed."""
        dropped: list[VariantEntry] = []
        for entry in self.entries(dataset):
            try:
                self.cache.drop(entry.key)
            except Conflict:
                logger.info("variant %s of %s is in use and stays", entry.key, dataset)
            else:
                dropped.append(entry)
        return tuple(dropped)

    def _used_by_runs(self) -> set[str]:
        """The variants of active runs: their containers outlive a killed worker and its locks."""
        active = matching(states=tuple(state for state in RunState if state.active))
        records = self._store.read(lambda t: t.runs.page(active, limit=_MOST_ACTIVE)).records
        keys: set[str | None] = set()
        for record in records:
            if record.variant:
                with contextlib.suppress(SlamHiveError):  # a record that cannot be read names no variant
                    keys.add(variant_key(RunFolder(self._settings.runs_folder / str(record.id)).read_record()))
        return {key for key in keys if key is not None}


def variant_key(record: dict[str, object]) -> str | None:
    """The variant key in a run's record; None if there is none yet."""
    dataset = record.get("dataset")
    key = dataset.get("variant") if isinstance(dataset, dict) else None
    return key if isinstance(key, str) else None


# Reports of checks, the last of which lies beside each dataset.

REPORT_FILE = "check.json"


class DatasetChecks:
    """The checks of the datasets of one installation.

    Args:
        settings: Whether reports may be stored.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def check(self, dataset: Dataset, progress: Progress) -> DatasetCheck:
        """Check ``dataset``, and store the report unless this installation is view-only.

        Raises:
            InvalidInput: it has no recording, or the recording is damaged.
            Unavailable: the report cannot be written.
        """
        # OpenCV and rosbags take half a second to import, which other commands should not pay.
        from slamhive.recordings.checks.registry import check_dataset  # noqa: PLC0415

        files = dataset_files(dataset)
        report = DatasetCheck.of(check_dataset(dataset, progress), files=files)
        if self._settings.mode is not Mode.VIEW_ONLY:
            write_aside(_path(dataset), json.dumps(report.content, indent=1) + "\n")
        return report

    def stored(self, dataset: Dataset) -> DatasetCheck | None:
        """The last report; None if there is none, or if the data or the checks have changed since."""
        try:
            report = DatasetCheck.read(read_record(_path(dataset)))
        except (NotFound, InvalidInput):
            return None
        current = (dataset.checksum, dataset_files(dataset), VERSION)
        return report if (report.checksum, report.files, report.version) == current else None


def _path(dataset: Dataset) -> Path:
    return dataset.folder / REPORT_FILE


def dataset_files(dataset: Dataset) -> str:
    """Digest of ``dataset.yaml`` and the ground truth, which the checksum of the recording does not cover."""
    digest = hashlib.sha256()
    try:
        digest.update((dataset.folder / DATASET_FILE).read_bytes())
        if dataset.groundtruth_path is not None:
            status = dataset.groundtruth_path.stat()
            digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
    except OSError:
        digest.update(b"absent")
    return f"sha256:{digest.hexdigest()}"


# -- ground truths on trial: the runs of independent systems on a dataset against its ground truth ---------------------

TRIAL_FILE = "trial.json"
TRIAL_VERSION = 1
"""Raised when the rules change, so that stored trials are known to be outdated."""
_MOST_RUNS = 1000
_MOST_SYSTEMS = 12
_CURVE_POINTS = 1500


@dataclass(frozen=True, slots=True)
class Witness:
    """The run that stands for a system: the one with the median error among its good runs.

    Attributes:
        system: Name of the package, or of the imported algorithm: modes of one package share its mistakes.
        run: The run.
    """

    system: str
    run: RunRecord


class TruthTrials:
    """Trials of the ground truths of one installation, the last of which lies beside each dataset.

    Args:
        settings: The run folders, and whether a trial may be stored.
        store: The runs.
        catalogue: Knows the sensors of algorithms.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue

    def judge(self, dataset: Dataset) -> TruthTrialDocument:
        """Hold all systems with good runs on ``dataset`` against its ground truth, and store what is found.

        Raises:
            InvalidInput: the dataset has no ground-truth trajectory, or it cannot be read.
            Unavailable: the trial cannot be stored.
        """
        path = dataset.groundtruth_path
        if path is None or dataset.groundtruth is None:
            raise InvalidInput(f"dataset {dataset.name} has no ground-truth trajectory to judge")
        truth, without = parse_ground_truth(read_bounded(path), path.name)
        witnesses = self.witnesses(dataset)
        read: dict[str, Trajectory] = {}
        sensors: dict[str, frozenset[str]] = {}
        unread: dict[str, str] = {}
        for witness in witnesses:
            try:
                sensors[witness.system] = self._sensors(witness.run, dataset)
                read[witness.system] = self._estimate(witness.run)
            except Unavailable:
                raise
            except SlamHiveError as error:
                unread[witness.system] = str(error)
        trial = judge_truth(
            truth,
            read,
            sensors,
            rotations_known=not (dataset.groundtruth.positions_only or without),
        )
        document = _document(dataset, trial, witnesses, unread, float(truth.stamps_s[0]))
        if self._settings.mode is not Mode.VIEW_ONLY:
            write_aside(dataset.folder / TRIAL_FILE, json.dumps(document.content, indent=1) + "\n")
        return document

    def stored(self, dataset: Dataset) -> TruthTrialDocument | None:
        """The last trial; None if there is none, or if the ground truth or the rules have changed since.

        Visitors who see only what is public see none: runs of the team bear witness.
        """
        if self._store.viewer == ANYBODY:
            return None
        try:
            document = TruthTrialDocument.read(read_record(dataset.folder / TRIAL_FILE))
        except (NotFound, InvalidInput):
            return None
        return document if (document.files, document.version) == (dataset_files(dataset), TRIAL_VERSION) else None

    def witnesses(self, dataset: Dataset) -> list[Witness]:
        """One run for each system with a good run on ``dataset``, the most accurate systems first."""
        succeeded = matching(datasets=(dataset.name,), states=(RunState.SUCCEEDED,))
        # The trial lies beside the dataset, where the whole team reads it. So nobody's private runs bear witness.
        with self._store.seen_by(WITHOUT_ACCOUNTS):
            page = self._store.read(lambda t: t.runs.page(succeeded, limit=_MOST_RUNS, with_metrics=True))
        by_system: dict[str, list[RunRecord]] = defaultdict(list)
        for run in page.records:
            known = run.metrics is not None and ERROR in run.metrics
            if known and run.judged is VerdictKind.GOOD and not run.variant:
                by_system[run.algorithm if run.executor == IMPORTED else run.package].append(run)
        found: list[Witness] = []
        for system, runs in by_system.items():
            middle = statistics.median_low(_error_m(run) for run in runs)
            run = next(run for run in runs if _error_m(run) == middle)
            found.append(Witness(system, run))
        return sorted(found, key=lambda witness: _error_m(witness.run))[:_MOST_SYSTEMS]

    def _sensors(self, run: RunRecord, dataset: Dataset) -> frozenset[str]:
        """The sensors that the system uses; of an imported run their kinds, such as ``camera``."""
        algorithm = algorithm_here_or_elsewhere(self._store, self._catalogue, run)
        if run.executor == IMPORTED:
            return _KINDS[algorithm.setup]
        return frozenset(sensor.name for sensor in algorithm.assign(dataset, run.sensors).values())

    def _estimate(self, run: RunRecord) -> Trajectory:
        """The trajectory of the body on the clock of the ground truth."""
        path: Path = RunFolder(self._settings.runs_folder / str(run.id)).trajectory
        if path.is_symlink():
            raise InvalidInput(f"the trajectory of run {run.id} is a link, which is not followed")
        estimate = parse_tum(read_bounded(path), f"run {run.id}")
        offset_s = (run.metrics or {}).get("alignment.time_offset", 0.0)
        if offset_s:
            estimate = Trajectory(estimate.stamps_s + offset_s, estimate.positions_m, estimate.quats_xyzw)
        T_body_sensor = trajectory_frame(self._store, self._catalogue, run)
        if T_body_sensor == IDENTITY4:
            return estimate
        T_sensor_body: FloatArray = np.asarray(np.linalg.inv(rigid_transform(T_body_sensor, "T_body_sensor")))
        return move_sensor(estimate, T_sensor_body)


_CAMERA, _IMU, _LIDAR = (frozenset({name}) for name in ("camera", "imu", "lidar"))
_KINDS: Mapping[SensorSetup, frozenset[str]] = {
    SensorSetup.MONO: _CAMERA,
    SensorSetup.STEREO: _CAMERA,
    SensorSetup.RGBD: _CAMERA,
    SensorSetup.MONO_INERTIAL: _CAMERA | _IMU,
    SensorSetup.STEREO_INERTIAL: _CAMERA | _IMU,
    SensorSetup.LIDAR: _LIDAR,
    SensorSetup.LIDAR_INERTIAL: _LIDAR | _IMU,
    SensorSetup.LASER: frozenset({"laser"}),
}


def _error_m(run: RunRecord) -> float:
    return (run.metrics or {})[ERROR]


def _document(
    dataset: Dataset, trial: TruthTrial, witnesses: Iterable[Witness], unread: Mapping[str, str], start_s: float
) -> TruthTrialDocument:
    step = max(1, -(-len(trial.stamps_s) // _CURVE_POINTS))
    return TruthTrialDocument.of(
        trial,
        dataset=dataset.name,
        files=dataset_files(dataset),
        version=TRIAL_VERSION,
        runs={witness.system: witness.run.id for witness in witnesses},
        left_out={**unread, **trial.left_out},
        start_s=start_s,
        fewest=FEWEST_SYSTEMS,
        judged_share=trial.judged_share,
        leave_out_s=tuple(second for entry in trial.stretches for second in (entry.begin_s, entry.end_s)),
        times_s=_numbers(trial.stamps_s[::step] - start_s),
        residuals_m={name: _numbers(values[::step]) for name, values in trial.residuals_m.items()},
        common_m=_numbers(trial.common_m[::step]),
    )


def _numbers(values: FloatArray) -> tuple[float | None, ...]:
    return tuple(None if np.isnan(value) else round(float(value), 5) for value in values)


# The trial in words and as a plot.

_WRONG = {Blame.TRUTH: "The ground truth is wrong", Blame.UNDECIDED: "Ground truth and systems contradict each other"}


def stretch_in_words(trial: TruthTrialDocument, entry: ContradictionDocument) -> str:
    """One sentence or two: from when to when, by how much, who agrees, and how sure that is."""
    differing = f", {' and '.join(entry.differing)} differ" if entry.differing else ""
    begin_s, end_s = entry.begin_s - trial.start_s, entry.end_s - trial.start_s
    return (
        f"{_WRONG[entry.blame]} from {begin_s:.1f} to {end_s:.1f} s, by up to {entry.max_m:.2g} m (RMS "
        f"{entry.rms_m:.2g} m): {', '.join(entry.agreeing)} agree{differing}. What they have in common is "
        f"{entry.ratio:.1f} times what they have not; {entry.because}. Confidence: {entry.confidence}."
    )


def constant_in_words(entry: ConstantOffsetDocument) -> str:
    """One sentence: the constant, its standard error, and who agrees."""
    numbers, sigmas = (" ".join(f"{value:.3f}" for value in part) for part in (entry.values, entry.sigmas))
    if entry.kind == "time_offset":
        what = f"The ground truth and the sensors differ by a constant {numbers} +- {sigmas} s"
    else:
        what = f"The measured point lies {numbers} +- {sigmas} m from the body frame, as the systems see it"
    return f"{what}: {', '.join(entry.agreeing)} agree. Whether ground truth or calibration is wrong, it does not show."


def draw_trial(trial: TruthTrialDocument, target: Path) -> None:
    """Draw the residuals of all systems over time, with the stretches; the ending of ``target`` names the kind.

    Raises InvalidInput for an ending that is not .png, .svg or .pdf, and for a trial in which nothing was judged.
    """
    if target.suffix not in {".png", ".svg", ".pdf"}:
        raise InvalidInput(f"{target} has the ending {target.suffix!r}", "use .png, .svg or .pdf")
    if trial.why_not:
        raise InvalidInput(f"there is nothing to draw: {trial.why_not}")
    from matplotlib.figure import Figure  # noqa: PLC0415 - the pages import this module and draw nothing

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for name, values in trial.residuals_m.items():
        axes.plot(trial.times_s, [np.nan if value is None else value for value in values], linewidth=0.8, label=name)
    common = [np.nan if value is None else value for value in trial.common_m]
    axes.plot(trial.times_s, common, color="black", linewidth=1.6, label="in common")
    for entry in trial.stretches:
        axes.axvspan(entry.begin_s - trial.start_s, entry.end_s - trial.start_s, color="#D55E00", alpha=0.25)
    axes.set(xlabel="time since the first pose [s]", ylabel="distance from ground truth [m]")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, ncols=4)
    try:
        figure.savefig(target, dpi=150)
    except OSError as error:
        raise Unavailable(f"{target} cannot be written: {error.strerror}", "name another file") from None
