"""A combination of the published SLAM Hive as an experiment file, with notes on what could not be converted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.names import plain, printable
from slamhive.domain.parameters import Parameter, find_parameter
from slamhive.packages.published.combination import (
    RATE,
    RATES,
    RECTIFICATION,
    RESOLUTION,
    WIDTH,
    ChangedValue,
    Combination,
    Factors,
    Range,
    changed,
    value_name,
)
from slamhive.packages.published.knowledge import source_of

_LONGEST_NAME = 64
_ROLES = ("left", "right", "depth", "imu", "points")
_SENSORS = {"image": "camera", "imu": "imu", "lidar": "lidar"}
_OPTION = {RATE: "every", RESOLUTION: "scale"}


@dataclass(frozen=True, slots=True)
class Converted:
    """An experiment file. ``notes`` name, one line each, what was not taken over and why; the text has them too."""

    name: str
    text: str
    notes: tuple[str, ...]


@dataclass(slots=True)
class _Step:
    """A step: ``numbers`` are the templates that it stands for, ``factors`` the values in the order of the file."""

    name: str
    sensors: str
    what: ChangedValue
    numbers: list[str]
    factors: list[float]


@dataclass(slots=True)
class _Content:
    steps: dict[str, _Step] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    linked: list[list[str]] = field(default_factory=list)
    sizes: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    bound: list[str] = field(default_factory=list)


def convert(
    combination: Combination, algorithm: Algorithm, dataset: str, meanings: Mapping[str, str], notes: Sequence[str] = ()
) -> Converted:
    """Convert ``combination`` to an experiment with ``algorithm`` on ``dataset``.

    Args:
        combination: As read.
        algorithm: What its algorithm is here.
        dataset: What its dataset is called here.
        meanings: What users said about numbers of templates.
        notes: What is known already.

    Raises InvalidInput, with the line, where the values contradict the meaning of a number.
    """
    content = _Converter(combination, algorithm, dict(meanings), list(notes)).content()
    name = combination.title.replace("+", "-").replace("..", ".")[:_LONGEST_NAME]
    written: dict[str, Any] = {"name": name, "description": " ".join(combination.description)}
    written |= {"algorithms": algorithm.name, "datasets": [dataset]}
    if content.steps:
        written["steps"] = {step.name: _step(step) for step in content.steps.values()}
    for key, value in (("parameters", content.parameters), ("linked", content.linked)):
        if value:
            written[key] = value
    written["evaluate"] = {"alignment": "sim3"}
    comments = [f"Converted from a combination of the published SLAM Hive: {combination.title}.", *content.notes]
    comments += [f"line {number}: {line.strip()}" for number, line in combination.prose]
    if combination.prose:
        content.notes.append(f"{len(combination.prose)} lines of other text are kept as comments")
    text = "".join(f"# {printable(comment)}\n" for comment in comments) + strict_yaml.dump(written)
    return Converted(name, text, tuple(content.notes))


class _Converter:
    def __init__(
        self, combination: Combination, algorithm: Algorithm, meanings: dict[str, str], notes: list[str]
    ) -> None:
        self._from = combination
        self._algorithm = algorithm
        self._meanings = meanings
        self._into = _Content(notes=notes)
        self._lacks = f"{algorithm.name} has no such parameter"

    def content(self) -> _Content:
        """The steps, parameters and notes."""
        into = self._into
        for number, factors in self._from.changes.items():
            self._add_step(number, factors)
        for entry in self._from.ranges:
            sensor, _, kind = entry.name.lower().partition(" ")
            if sensor in _SENSORS and kind in ("frequency", "rate", "resolution"):
                self._choose(entry, f"{sensor}_{RESOLUTION if kind == RESOLUTION else RATE}")
                continue
            parameter = self._parameter(entry.name)
            if parameter is None:
                self._note(f"line {entry.line}: {entry.name} is not converted, {self._lacks}")
            elif self._allowed(parameter, entry.values, f"line {entry.line}"):
                self._into.parameters[parameter.key] = " | ".join(entry.values)
                self._into.sizes[parameter.key] = len(entry.values)
        for step in into.steps.values():
            into.sizes[step.name] = len(step.factors)
            for number in step.numbers:
                self._add_values(step, number, self._from.changes[number])
        into.steps = {name: step for name, step in into.steps.items() if step.factors != [1.0]}
        # A step on a kind of sensor keeps the ties of its own templates, and no others.
        for numbers in self._from.tied:
            steps = {(what.sensor, what.kind) for number in numbers if (what := changed(number, self._meanings))}
            if len(steps) != 1 or any(changed(number, self._meanings) is None for number in numbers):
                self._note(f"{', '.join(numbers)} are tied in the file, which is not converted")
        for step in self._into.steps.values():
            tied = any(set(step.numbers) <= set(numbers) for numbers in self._from.tied)
            if len(step.numbers) > 1 and not tied:
                words = " and ".join(step.numbers)
                self._note(f"{words} are not tied in the file; here {step.name} treats all sensors alike")
        if into.bound:
            names = ", ".join(dict.fromkeys(into.bound))
            into.notes.append(f"{names}: not copied, {self._algorithm.name} gets them from the dataset and its steps")
        total = math.prod(into.sizes.values())
        if self._from.total not in (None, total):
            into.notes.append(f"the file says {self._from.total} configurations, this experiment has {total}")
        return into

    def _add_step(self, number: str, factors: Factors) -> None:
        what = changed(number, self._meanings)
        if what is None or what.sensor not in _SENSORS:
            place = self._from.places.of(number)
            said = f"{place}: template {number} with the factors {' | '.join(map(plain, factors))} is not converted"
            self._note(said, f"--id {number}=image0_frequency, for instance")
            return
        if not self._uses(what.sensor):
            place = self._from.places.of(number)
            self._note(f"{place}: {what.words} is not converted, {self._algorithm.name} uses no {what.sensor}")
            return
        # The values may show that a number means something else in this file.
        known = {template: value_name(template, self._meanings) for values in factors.values() for template in values}
        scaled = [template for template, name in known.items() if name in RATES or name == WIDTH]
        fits = all(factor == int(factor) if what.kind is RATE else factor <= 1 for factor in factors)
        for template in scaled:
            full = [
                _unscaled(values[template], factor, what) for factor, values in factors.items() if template in values
            ]
            fits = fits and max(full) - min(full) <= 0.02 * max(full)
        if not fits:
            raise InvalidInput(
                f"{self._from.places.of(number)}: the values of template {number} are not those of {what.words}",
                f"say what it means here: --id {number}=imu_frequency, for instance",
            )
        name = f"{what.sensor}_{what.kind}"
        first = self._into.steps.get(name)
        if first is None:
            self._into.steps[name] = _Step(name, _SENSORS[what.sensor], what, [number], list(factors))
            return
        if set(first.factors) != set(factors):
            listed = [" | ".join(map(plain, entry)) for entry in (first.factors, factors)]
            raise InvalidInput(
                f"{self._from.places.of(number)}: {what.words} has the factors {listed[1]}, that of template "
                f"{first.numbers[0]} has {listed[0]}",
                "give both the same, or convert them apart",
            )
        first.numbers.append(number)

    def _choose(self, entry: Range, name: str) -> None:
        """Of the factors that have new values, the description may choose some, as factors or as rates in Hz."""
        step = self._into.steps.get(name)
        try:
            wanted = [float(value) for value in entry.values]
        except ValueError:
            wanted = []
        if step is None and wanted and name.endswith(RESOLUTION) and self._uses("image"):
            what = ChangedValue("image", 0, RESOLUTION)
            self._into.steps[name] = _Step(name, "camera", what, [], wanted)
            return
        for factors in () if step is None else (step.factors, self._rates(step)):
            if wanted and set(wanted) <= set(factors):
                step.factors = [step.factors[factors.index(value)] for value in wanted]  # type: ignore[union-attr]
                return
        said = " | ".join(entry.values)
        self._note(f"line {entry.line}: {entry.name} {said} is not taken over: no new values belong to its numbers")

    def _rates(self, step: _Step) -> list[float]:
        """The rate after each factor of a step, in Hz; empty if the file does not say."""
        for number in step.numbers:
            for template in next(iter(self._from.changes[number].values()), {}):
                if value_name(template, self._meanings) in RATES:
                    entries = self._from.changes[number]
                    return [_unscaled(entries[factor].get(template), 1.0, step.what) for factor in step.factors]
        return []

    def _add_values(self, step: _Step, number: str, factors: Factors) -> None:
        """The parameters with a new value for each factor of a step."""
        for template in dict.fromkeys(key for factor in step.factors for key in factors[factor]):
            place = self._from.places.of(number, plain(step.factors[0]), template)
            name = value_name(template, self._meanings)
            values = ", ".join(str(factors[factor][template]) for factor in step.factors if template in factors[factor])
            if name is None:
                self._note(f"{place}: template {template} ({values}) is not converted", f"--id {template}=PARAMETER")
                continue
            parameter = self._parameter(name)
            known = source_of(name, _ROLES) is not None or name.lower() in RECTIFICATION
            if (parameter is None and known) or (parameter is not None and parameter.source is not None):
                self._into.bound.append(name)
            elif parameter is None:
                self._note(f"{place}: {name} ({values}) is not converted, {self._lacks}")
            else:
                self._link(step, parameter, [factors[factor].get(template) for factor in step.factors], str(place))

    def _link(self, step: _Step, parameter: Parameter, values: Sequence[Any], place: str) -> None:
        if None in values:
            self._note(f"{place}: {parameter.key} is not converted, some factors have no value for it")
        elif self._allowed(parameter, values, place):
            same = all(value == values[0] for value in values)
            self._into.parameters[parameter.key] = [values[0]] if same else list(values)
            if not same:
                self._into.linked.append([step.name, parameter.key])

    def _allowed(self, parameter: Parameter, values: Sequence[Any], place: str) -> bool:
        try:
            for value in values:
                parameter.parse(value)
        except InvalidInput as error:
            self._note(f"{place}: not converted, {error.message}")
            return False
        return True

    def _uses(self, sensor: str) -> bool:
        return any(entry.kind.value == _SENSORS[sensor] for entry in self._algorithm.inputs)

    def _parameter(self, name: str) -> Parameter | None:
        """The parameter with this name; upper and lower case differ between published folders."""
        found = find_parameter(self._algorithm.parameters, name)
        return found or next((p for p in self._algorithm.parameters if p.key.lower() == name.lower()), None)

    def _note(self, text: str, remedy: str = "") -> None:
        self._into.notes.append(f"{text}; {remedy}" if remedy else text)


def _step(step: _Step) -> dict[str, Any]:
    values = " | ".join(map(plain, step.factors)) if len(step.factors) > 1 else step.factors[0]
    if step.what.kind is RATE and not isinstance(values, str):
        values = int(values)
    return {"step": step.what.kind, "sensors": step.sensors, _OPTION[step.what.kind]: values}


def _unscaled(value: Any, factor: float, what: ChangedValue) -> float:
    """A rate or a width as it was before a step; NaN if it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return value * factor if what.kind is RATE else value / factor


def other_text(lines: Sequence[tuple[int, str]]) -> Iterator[str]:
    """A note on lines before the first combination, if there are any."""
    if lines:
        yield f"lines {lines[0][0]} to {lines[-1][0]} stand before the first combination and are not converted"
