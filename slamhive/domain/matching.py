"""Fit of an algorithm and a dataset: which sensor serves which role, and what parameters take from them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from slamhive.base.errors import InvalidInput
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter, ParameterType, Value
from slamhive.domain.roles import BY_RULE, Chosen, Remap, remaps_of
from slamhive.domain.sensors import CalibrationValue, Sensor


class Origin(StrEnum):
    """Where the value of a parameter with ``from`` comes from."""

    SENSOR = "sensor"
    """The dataset, as the variant leaves it."""
    DEFAULT = "default"
    """The package's default, because the dataset lacks the property."""
    USER = "user"
    """The user, in place of the dataset."""


@dataclass(frozen=True, slots=True)
class BoundValue:
    """The value of a parameter that is taken from a sensor unless the user sets it.

    ``source`` is the property (``left.fx``), ``sensors`` the names of the sensors that it belongs to, ``found`` what
    the dataset has, None if nothing.
    """

    key: str
    source: str
    sensors: tuple[str, ...]
    value: Value
    origin: Origin
    found: Value | None

    @property
    def words(self) -> str:
        """``from cam0 (left.fx)``, or why the value is another one."""
        owners = " and ".join(self.sensors)
        if self.origin is Origin.SENSOR:
            return f"from {owners} ({self.source})"
        if self.origin is Origin.DEFAULT:
            return f"default of the package: {owners} has no {self.source.partition('.')[2]}"
        return f"overridden: {owners} has {'nothing' if self.found is None else shown(self.found)}"


@dataclass(frozen=True, slots=True)
class Match:
    """Fit of an algorithm to a dataset.

    ``sensors``: the sensor in each role, as a variant leaves it. ``fitting``: all that could serve it. ``bound``: the
    parameters that are taken from them. ``remaps``: the topic on which the algorithm gets each role.
    """

    sensors: Mapping[str, Sensor]
    fitting: Mapping[str, tuple[Sensor, ...]]
    bound: tuple[BoundValue, ...]
    remaps: tuple[Remap, ...] = ()

    def values(self, given: Mapping[str, Value]) -> dict[str, Value]:
        """The value of every parameter, those that the user gave included."""
        return {**given, **{entry.key: entry.value for entry in self.bound}}


def match_of(algorithm: Algorithm, dataset: Dataset, given: Mapping[str, Value], chosen: Chosen = BY_RULE) -> Match:
    """Match ``algorithm`` with ``dataset``, which is what the run sees: the variant, if there is one.

    Args:
        algorithm: What runs.
        dataset: Has the sensors.
        given: Parameters that the user set.
        chosen: Sensors that the user chose.

    Raises InvalidInput if the dataset lacks a sensor, or a property that the algorithm takes a value from, and if a
    parameter without a default is not given.
    """
    assigned = algorithm.assign(dataset, chosen)
    _check_given(algorithm, given)
    bound = tuple(_bound(parameter, algorithm, dataset, assigned, given) for parameter in _taken(algorithm))
    topics = {entry.role: entry for entry in algorithm.topics}
    recorded = {role: sensor.topic for role, sensor in assigned.items()}
    remaps = remaps_of(topics, recorded, given, algorithm.name)
    return Match(assigned, algorithm.fitting(dataset), bound, remaps)


def check_known(algorithm: Algorithm, dataset: Dataset, assigned: Mapping[str, Sensor], given: Collection[str]) -> None:
    """Raise InvalidInput if a parameter that is not ``given`` has no value; variants change nothing about that."""
    _check_given(algorithm, given)
    for parameter in _taken(algorithm):
        if parameter.key not in given:
            _bound(parameter, algorithm, dataset, assigned, {})


def shown(value: Value) -> str:
    """A value in a line of text."""
    if isinstance(value, tuple):
        return ", ".join(f"{number:g}" for number in value)
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _check_given(algorithm: Algorithm, given: Collection[str]) -> None:
    """Raise InvalidInput for a parameter whose default nobody knows."""
    missing = [entry.key for entry in algorithm.parameters if entry.must_be_given and entry.key not in given]
    if missing:
        raise InvalidInput(
            f"{algorithm.name} needs {', '.join(missing)}: no default is known",
            f"--set {missing[0]}=VALUE, or add `default` to {algorithm.package.folder / 'algorithm.yaml'}",
        )


def _taken(algorithm: Algorithm) -> Iterator[Parameter]:
    return (parameter for parameter in algorithm.parameters if parameter.source is not None)


def _bound(
    parameter: Parameter,
    algorithm: Algorithm,
    dataset: Dataset,
    assigned: Mapping[str, Sensor],
    given: Mapping[str, Value],
) -> BoundValue:
    source = parameter.source
    assert source is not None
    sensors = tuple(assigned[role].name for role in source.roles)
    raw = source.value(assigned)
    found = None if raw is None else _typed(parameter, raw, f"{' and '.join(sensors)} of dataset {dataset.name}")
    if parameter.key in given:
        return BoundValue(parameter.key, str(source), sensors, given[parameter.key], Origin.USER, found)
    if found is not None:
        return BoundValue(parameter.key, str(source), sensors, found, Origin.SENSOR, found)
    if parameter.default is None:
        raise InvalidInput(
            f"{algorithm.name} takes {parameter.key} from {source}, but {sensors[0]} of dataset {dataset.name} "
            f"has no {source.name}",
            f"add {source.name} to the calibration of {sensors[0]} in dataset.yaml, or set {parameter.key}",
        )
    return BoundValue(parameter.key, str(source), sensors, parameter.default, Origin.DEFAULT, None)


def _typed(parameter: Parameter, raw: CalibrationValue, owner: str) -> Value:
    """``raw`` with the type of the parameter; a whole number is the nearest."""
    if parameter.type is ParameterType.INT and isinstance(raw, float):
        raw = round(raw)
    try:
        return parameter.parse(raw)
    except InvalidInput as error:
        raise InvalidInput(f"{owner}: {error.message}", f"{error.remedy}; set {parameter.key}") from None
