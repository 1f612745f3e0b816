"""Algorithms and datasets for pages and web forms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

from slamhive.analysis.chart import OKABE_ITO
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.catalogue import MatchDocument, StepOptionDocument, TruthTrialDocument
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.domain.sensors import IDENTITY4, Sensor, SensorKind
from slamhive.recordings.variants.steps import (
    RegisteredSteps,
    describe_options,
    describe_step,
    treated_kinds,
)
from slamhive.services.datasets import ground_truth_motion
from slamhive.services.hive import Hive
from slamhive.services.runs import read_dataset_path
from slamhive.trajectory.transforms import WINDOW_S
from slamhive.web.figures import best_plane, motion_figures, plane_figures, residuals_figure, space_figures
from slamhive.web.formatting import DASH, plural, value_text


@dataclass(frozen=True, slots=True)
class DatasetChoice:
    """A dataset for one algorithm; ``lacks`` says what is missing, None if nothing is."""

    dataset: Dataset
    lacks: str | None


def dataset_choices(algorithm: Algorithm | None, datasets: tuple[Dataset, ...]) -> list[DatasetChoice]:
    """All datasets, compatible ones first."""
    choices = [DatasetChoice(dataset, lacking(algorithm, dataset)) for dataset in datasets]
    return sorted(choices, key=lambda choice: choice.lacks is not None)


def lacking(algorithm: Algorithm | None, dataset: Dataset) -> str | None:
    """Why the algorithm cannot run on the dataset, None if it can."""
    if algorithm is None:
        return None
    try:
        algorithm.assign(dataset)
    except InvalidInput as error:
        return error.message
    return None


def needs_in_words(algorithm: Algorithm) -> str:
    """``2 cameras, 1 imu``."""
    counted = Counter(entry.kind for entry in algorithm.inputs)
    return ", ".join(f"{count} {kind.value}{'s' if count > 1 else ''}" for kind, count in counted.items())


def sensors_in_words(dataset: Dataset) -> str:
    """``2 cameras (10 Hz), 1 lidar (10 Hz)``."""
    counted = Counter((sensor.kind, f"{sensor.rate_hz:g}") for sensor in dataset.sensors)
    return (
        ", ".join(
            f"{count} {kind.value}{'s' if count > 1 else ''} ({rate} Hz)" for (kind, rate), count in counted.items()
        )
        or "no sensors"
    )


@dataclass(frozen=True, slots=True)
class StepKind:
    """The description of a pre-processing step, and the kinds of sensors that it treats."""

    kind: str
    help: str
    options: tuple[StepOptionDocument, ...]
    sensors: tuple[SensorKind, ...]

    @property
    def group(self) -> str:
        """The sensors that it treats, in words."""
        if len(self.sensors) == len(SensorKind):
            return ANY_SENSOR
        return " and ".join(entry.value for entry in self.sensors)


ANY_SENSOR = "any sensor"


@cache
def step_kinds() -> tuple[StepKind, ...]:
    """All pre-processing steps."""
    return tuple(
        StepKind(kind, describe_step(kind), describe_options(kind), treated_kinds(kind))
        for kind in RegisteredSteps().kinds()
    )


def step_groups(kinds: Iterable[StepKind]) -> dict[str, list[StepKind]]:
    """{sensors: the steps that treat them}, those for any sensor first."""
    found: dict[str, list[StepKind]] = {ANY_SENSOR: []}
    for step in kinds:
        found.setdefault(step.group, []).append(step)
    return found


def range_in_words(parameter: Parameter) -> str:
    """``100 … 10000``, ``≥ 0``, the choices, or a dash."""
    if parameter.type is ParameterType.ENUM:
        return ", ".join(parameter.choices)
    if parameter.minimum is not None and parameter.maximum is not None:
        return f"{parameter.minimum:g} … {parameter.maximum:g}"
    if parameter.minimum is not None:
        return f"≥ {parameter.minimum:g}"
    if parameter.maximum is not None:
        return f"≤ {parameter.maximum:g}"
    return DASH


def calibration_rows(sensor: Sensor) -> list[tuple[str, str]]:
    """The calibration of a sensor as names and texts, including a pose other than the identity."""
    found = [(key, value_text(value)) for key, value in sensor.calibration.items()]
    if sensor.T_body_sensor != IDENTITY4:
        matrix = sensor.T_body_sensor
        lines = [" ".join(f"{value: .6g}" for value in matrix[row : row + 4]) for row in range(0, 16, 4)]
        found.append(("T_body_sensor", "\n".join(lines)))
    return found


# -- the match of an algorithm and a dataset, for pages ----------------------------------------------------------------


def match_of_run(services: Hive, record: dict[str, Any], configuration_id: int) -> MatchDocument | None:
    """The match in the record of a run, or that of its configuration now if the run has not started."""
    if "match" not in record:
        return match_of_configuration(services, configuration_id)
    try:
        return MatchDocument.read(record["match"])
    except InvalidInput:
        return None


def match_of_configuration(services: Hive, configuration_id: int) -> MatchDocument | None:
    """The match of algorithm and dataset now; None if one of them is gone, or if they do not fit any more."""
    try:
        return MatchDocument.of_match(services.configurations.match(configuration_id))
    except SlamHiveError:
        return None


# -- the ground truth of a dataset as plots ----------------------------------------------------------------------------

_COLOUR = OKABE_ITO[0]


def ground_truth_figures(
    dataset: Dataset,
    most_points: int | None = None,
    trial: TruthTrialDocument | None = None,
    *,
    in_space: bool = False,
) -> dict[str, Any] | None:
    """The path in all planes, or once ``in_space``, speed and angular rate, with captions and why plots are missing.

    ``most_points`` thins the path; ``trial`` adds the residuals of all systems. None for a dataset without a ground
    truth that can be read.
    """
    track, motion = read_dataset_path(dataset), ground_truth_motion(dataset)
    if track is None or motion is None or dataset.groundtruth is None:
        return None
    positions_only = dataset.groundtruth.positions_only
    unknown = "The ground truth has no orientations." if positions_only else "The poses are too far apart in time."
    path = track if most_points is None else track.thinned(most_points)
    return {
        "figures": (space_figures if in_space else plane_figures)(path, None)
        | motion_figures(motion, _COLOUR, positions_only=positions_only)
        | ({} if trial is None or trial.why_not else {"residuals": residuals_figure(trial)}),
        "captions": {
            "path": f"Ground truth, {plural(track.poses, 'pose')}.",
            "speed": f"Mean over {WINDOW_S:g} s.",
            "angular_rate": "" if positions_only else f"Mean over {WINDOW_S:g} s.",
            "residuals": "Each system aligned to the ground truth over 6 s. Shaded: they agree and contradict it.",
        },
        "reasons": {"speed": "The poses are too far apart in time.", "angular_rate": unknown},
        "best_plane": best_plane(track),
    }
