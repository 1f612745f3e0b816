"""Ground truths on trial: the runs of independent systems on a dataset against its ground truth."""

from __future__ import annotations

import json
import logging
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.bounds import read_record
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.base.settings import Mode, Settings
from slamhive.documents.catalogue import ConstantOffsetDocument, ContradictionDocument, TruthTrialDocument
from slamhive.domain.accounts import ANYBODY, WITHOUT_ACCOUNTS
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.dataset import Blame, Dataset
from slamhive.domain.run import RunState
from slamhive.domain.sensors import IDENTITY4, SensorSetup
from slamhive.domain.verdict import ERROR, VerdictKind
from slamhive.evaluation.trial import FEWEST_SYSTEMS, TruthTrial, judge_truth
from slamhive.filters.words import matching
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets.catalogue import Catalogue, algorithm_here_or_elsewhere, trajectory_frame
from slamhive.services.datasets.variants import dataset_files
from slamhive.store import RunRecord, Store
from slamhive.trajectory.layout import parse_ground_truth, parse_tum
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import move_sensor, rigid_transform

logger = logging.getLogger(__name__)

TRIAL_FILE = "trial.json"
VERSION = 1
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
        return document if (document.files, document.version) == (dataset_files(dataset), VERSION) else None

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
        version=VERSION,
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
