"""Algorithms and datasets for pages and web forms."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from slamhive.bags.variants.rules import OptionInfo, RegisteredSteps, describe_options, describe_step
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.domain.sensors import IDENTITY4, Sensor
from slamhive.errors import InvalidInput
from slamhive.web.formatting import DASH, value_text


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
    """The description of a pre-processing step."""

    kind: str
    help: str
    options: tuple[OptionInfo, ...]


def step_kinds() -> list[StepKind]:
    """All pre-processing steps."""
    return [StepKind(kind, describe_step(kind), describe_options(kind)) for kind in RegisteredSteps().kinds()]


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
