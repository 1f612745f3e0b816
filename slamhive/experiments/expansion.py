"""Checks an experiment as a whole, and expands it into its runs, in a fixed order and under fixed names."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from pydantic import ValidationError
from ruamel.yaml import YAML

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, SlamHiveError, unknown
from slamhive.documents.limits import Limits
from slamhive.documents.model import first_problem
from slamhive.domain.configuration import Configuration, Variant
from slamhive.domain.parameters import Value, find_parameter
from slamhive.experiments.binding import (
    PLAYBACK_MODE,
    PLAYBACK_RATE,
    WHOLE,
    CatalogueView,
    Filter,
    PairConfigurations,
    ParameterPair,
    Resolved,
    at,
    bind,
)
from slamhive.experiments.experiment import FIRST_LOOK, Experiment, ExperimentAxis
from slamhive.experiments.file import DatasetsWhere

RESERVED = ("algorithm", "dataset", "seed", "repeat", PLAYBACK_MODE, PLAYBACK_RATE, FIRST_LOOK)


def bind_all(experiment: Experiment, view: CatalogueView) -> tuple[list[ParameterPair], Filter]:
    """The conditions, and all pairs of algorithm and dataset that they leave.

    Raises NotFound and InvalidInput that name the place.
    """
    for axis, kind, known in (
        (experiment.algorithms, "algorithm", list(view.algorithms)),
        (experiment.datasets, "dataset", list(view.datasets)),
    ):
        for name in axis.values:
            if name not in known:
                raise at(axis.place, unknown(kind, str(name), known))
    if not experiment.datasets.values:
        raise InvalidInput(f"{experiment.datasets.place}: the filter has not been replaced by names of datasets")
    axes = _axes_by_name(experiment)
    _check_parameters(experiment, view)
    linked: set[str] = set()
    for link in experiment.links:
        word = "tied" if link.equal else "linked"
        for name in link.axes:
            if name not in axes:
                raise at(link.place, unknown("axis", name, sorted(axes)))
            if name in linked:
                raise InvalidInput(f"{link.place}: {name} is linked or tied more than once")
            linked.add(name)
        lengths = {name: len(axes[name].values) for name in link.axes}
        if len(set(lengths.values())) > 1:
            text = ", ".join(f"{name} has {length}" for name, length in lengths.items())
            raise InvalidInput(f"{link.place}: {word} axes need equally many values; {text}")
        if link.equal and len({axes[name].values for name in link.axes}) > 1:
            raise InvalidInput(
                f"{link.place}: tied axes need the same values; those of {' and '.join(link.axes)} differ",
                "use linked for values that differ and move together",
            )
    conditions = Filter(experiment, _condition_names(experiment, view, axes))
    shared: Resolved = {}
    pairs = [
        bind(experiment, view, view.algorithms[str(algorithm)], view.datasets[str(dataset)], shared)
        for algorithm in experiment.algorithms.values
        for dataset in experiment.datasets.values
        if not conditions.excludes({"algorithm": algorithm, "dataset": dataset})
    ]
    _check_steps(experiment, view, pairs)
    names = [str(name) for name in experiment.algorithms.values]
    roles = sorted({entry.role for name in names for entry in view.algorithms[name].inputs})
    for choice in experiment.sensors:
        if choice.role not in roles:
            raise at(choice.place, unknown(f"role of {', '.join(names)}", choice.role, roles))
    return pairs, conditions


def _axes_by_name(experiment: Experiment) -> dict[str, ExperimentAxis]:
    """Every axis by name; raises InvalidInput for an ambiguous name."""
    axes: dict[str, ExperimentAxis] = {}
    options = [axis for step in experiment.steps for axis in step.options]
    for axis in (*options, *experiment.parameters, *experiment.limit_axes):
        if axis.name in RESERVED:
            raise InvalidInput(f"{axis.place}: the name {axis.name!r} is taken", "choose another")
        if axis.name in axes:
            raise InvalidInput(
                f"{axis.place}: the name {axis.name!r} is already that of {axes[axis.name].place}", "choose another"
            )
        axes[axis.name] = axis
    return axes


def _check_parameters(experiment: Experiment, view: CatalogueView) -> None:
    names = [str(name) for name in experiment.algorithms.values]
    for axis in experiment.parameters:
        owners = [name for name in names if axis.algorithm in (None, name, view.algorithms[name].name)]
        if not owners:
            raise at(axis.place, unknown("algorithm of this experiment", str(axis.algorithm), names))
        definitions = [parameter for name in owners for parameter in view.algorithms[name].parameters]
        if find_parameter(definitions, axis.key) is None:
            known = {parameter.key for parameter in definitions}
            known |= {parameter.general for parameter in definitions if parameter.general is not None}
            raise at(axis.place, unknown(f"parameter of {', '.join(owners)}", axis.key, sorted(known)))


def _condition_names(experiment: Experiment, view: CatalogueView, axes: Mapping[str, ExperimentAxis]) -> frozenset[str]:
    names = {"algorithm", "dataset", PLAYBACK_MODE, PLAYBACK_RATE, *axes}
    names |= {f"{step.name}.{axis.option}" for step in experiment.steps for axis in step.options}
    for algorithm in experiment.algorithms.values:
        for parameter in view.algorithms[str(algorithm)].parameters:
            # A parameter that the experiment does not set gets its value from a sensor: conditions cannot know it.
            own = (axis for axis in experiment.parameters if axis.algorithm in (None, str(algorithm)))
            varied = any(axis.key in (parameter.key, parameter.general) for axis in own)
            if parameter.source is not None and not varied:
                continue
            names.add(parameter.key)
            if parameter.general is not None:
                names.add(parameter.general)
    return frozenset(names)


def _check_steps(experiment: Experiment, view: CatalogueView, pairs: list[ParameterPair]) -> None:
    """Check that every step is known and applies to a sensor of some algorithm."""
    touched = {step.declaration.name for pair in pairs for step in pair.steps}
    for step in experiment.steps:
        try:
            known = list(view.steps.options(step.kind))
        except SlamHiveError as error:
            raise at(step.place, error) from None
        for axis in step.options:
            if axis.option not in known:
                raise at(axis.place, unknown(f"option of step {step.kind}", axis.option, known))
            if any(isinstance(value, tuple) for value in axis.values):
                raise InvalidInput(
                    f"{axis.place}: {axis.name} holds a list within a list", "options of steps are plain values"
                )
        if pairs and step.name not in touched:
            raise InvalidInput(
                f"{step.place}: step {step.name} treats no sensor: none of the algorithms listens to "
                f"{', '.join(step.sensors)} on these datasets",
                "leave it out, or name other sensors",
            )


# Datasets that an experiment chooses by a filter: ``datasets: {where: indoor and sensor = stereo}``.
#
# The filter is replaced by the names that it describes when the experiment is planned or started. The stored file has
# names, so it means the same when datasets come and go.


KEY = "datasets"


def name_datasets(text: str, source: str, choose: Callable[[str], Sequence[str]]) -> str:
    """The experiment file with names in place of its filter over datasets; ``text`` itself if it has none.

    Args:
        text: The YAML.
        source: What to call it in messages.
        choose: The names of the datasets that a filter describes; raises InvalidInput.

    Raises:
        InvalidInput: naming source, line and what is wrong; also if no dataset fits.
    """
    content, lines = strict_yaml.parse_with_lines(text, source)
    if not isinstance(content.get(KEY), dict):
        return text
    place = strict_yaml.Places(source, lines).of(KEY, "where")
    try:
        where = DatasetsWhere.model_validate(content[KEY]).where
        names = choose(where)
    except ValidationError as error:
        raise InvalidInput(f"{place}: {KEY}.{first_problem(error, DatasetsWhere)}") from None
    except InvalidInput as error:
        raise at(place, InvalidInput(error.message, error.remedy)) from None
    if not names:
        raise InvalidInput(f"{place}: no dataset fits {where!r}", "slamhive dataset list shows all")
    start, end = _span(text)
    named = json.dumps(list(names)) + "\n" * text[start:end].count("\n")
    return f"{text[:start]}{named}{text[end:].rstrip()}\n# chosen by: {' '.join(where.split())}\n"


def _span(text: str) -> tuple[int, int]:
    """Where the value of the key stands, without the space after it; the text has been parsed already."""
    for key, value in YAML(typ="safe", pure=True).compose(text).value:
        if key.value == KEY:
            start, end = value.start_mark.index, value.end_mark.index
            return start, start + len(text[start:end].rstrip())
    raise AssertionError(text)


# Expands an experiment into its runs, in a fixed order and under fixed names.


MAX_COMBINATIONS = 1_000_000
"""Before conditions; an experiment of more is refused unless the caller sets another limit."""


@dataclass(frozen=True, slots=True)
class Size:
    """Size of an experiment.

    ``combinations`` before conditions, ``configurations`` after (identical ones, which become one when expanded,
    still counted each), ``runs`` with seeds and repeats. ``variants`` of datasets are needed for them. ``axes``: {what
    varies: how many values it takes}.
    """

    combinations: int
    configurations: int
    runs: int
    variants: int
    axes: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """A planned run.

    ``number`` counts runs, ``cell`` configurations with limits, and ``repeat`` repeats, from 1; ``name``
    (``paper-euroc-0007``) is that of the cell.
    ``values`` holds the value of each axis that applies, by axis name, after ``algorithm`` and ``dataset``.
    """

    number: int
    cell: int
    name: str
    configuration: Configuration
    content_hash: str
    values: Mapping[str, Value]
    seed: int
    repeat: int
    limits: Limits


def count(experiment: Experiment, view: CatalogueView, limit: int = MAX_COMBINATIONS) -> Size:
    """Check the whole experiment and count its runs; nothing is kept in memory.

    Raises:
        NotFound: a name that nothing answers to, with the nearest that there is.
        InvalidInput: a value, tie or condition that makes no sense, or more than ``limit`` combinations. The message
            names file and line.
    """
    return _checked(experiment, view, limit)[0]


class Expansion(Iterator[PlannedRun]):
    """Yield the runs of a checked experiment.

    Attributes:
        size: As counted beforehand.
        pairs: The algorithms on the datasets that configurations remain for.
        variants: The variants of each dataset that they need; {dataset name: variants}, without the dataset as it is.
        merged: How many configurations were identical to an earlier one so far, and therefore left out.
    """

    def __init__(self, experiment: Experiment, view: CatalogueView, limit: int = MAX_COMBINATIONS) -> None:
        self.size, pairs, conditions = _checked(experiment, view, limit)
        self.pairs = tuple((pair.algorithm, pair.dataset) for pair in pairs)
        self.variants = _variants(pairs)
        self.merged = 0
        self._runs = self._plan(experiment, pairs, conditions)

    def __next__(self) -> PlannedRun:
        return next(self._runs)

    def _plan(self, experiment: Experiment, pairs: list[ParameterPair], conditions: Filter) -> Iterator[PlannedRun]:
        digits = max(4, len(str(self.size.configurations)))
        seen: set[bytes | tuple[bytes, Limits]] = set()
        number = 0
        for pair in pairs:
            heading: dict[str, Value] = {"algorithm": pair.algorithm.label, "dataset": pair.dataset.name}
            configurations = PairConfigurations(pair)
            shared = pair.limits.limits
            for row in pair.rows(conditions):
                configuration, content_hash = configurations.of(row)
                digest = bytes.fromhex(content_hash)
                limits = pair.limits_of(row) if pair.limit_axes else shared
                identity = (digest, limits) if pair.limit_axes else digest
                if identity in seen:
                    self.merged += 1
                    continue
                seen.add(identity)
                name = f"{experiment.name}-{len(seen):0{digits}d}"
                values = {**heading, **row}
                if row.get(FIRST_LOOK) == WHOLE:
                    del values[FIRST_LOOK]
                for seed in experiment.seeds:
                    for repeat in range(1, experiment.repeats + 1):
                        number += 1
                        yield PlannedRun(
                            number, len(seen), name, configuration, content_hash, values, seed, repeat, limits
                        )


def expand(experiment: Experiment, view: CatalogueView, limit: int = MAX_COMBINATIONS) -> Expansion:
    """Check everything as :func:`count` does, then yield the runs; identical configurations come once."""
    return Expansion(experiment, view, limit)


def _checked(experiment: Experiment, view: CatalogueView, limit: int) -> tuple[Size, list[ParameterPair], Filter]:
    pairs, conditions = bind_all(experiment, view)
    combinations = _check_size(experiment, pairs, limit)
    remaining = {id(pair): pair.count(conditions) for pair in pairs}
    pairs = [pair for pair in pairs if remaining[id(pair)]]
    configurations = sum(remaining.values())
    if configurations == 0:
        text = " and ".join(f"({where.text})" for where in experiment.where)
        raise InvalidInput(f"{experiment.where[0].place}: the condition {text} removes every combination", "loosen it")
    runs = configurations * len(experiment.seeds) * experiment.repeats
    if runs > limit:
        raise InvalidInput(
            f"{experiment.place}: {configurations:,} configurations with {len(experiment.seeds)} seeds and "
            f"{experiment.repeats} repeats are {runs:,} runs, more than the limit of {limit:,}",
            "vary less at once",
        )
    variants = sum(map(len, _variants(pairs).values()))
    return Size(combinations, configurations, runs, variants, _axis_sizes(experiment, pairs)), pairs, conditions


def _variants(pairs: list[ParameterPair]) -> dict[str, frozenset[Variant]]:
    needed: dict[str, frozenset[Variant]] = {}
    for pair in pairs:
        found = frozenset(variant for variant in pair.variants.values() if variant)
        needed[pair.dataset.name] = needed.get(pair.dataset.name, frozenset()) | found
    return needed


def _check_size(experiment: Experiment, pairs: list[ParameterPair], limit: int) -> int:
    combinations = sum(pair.size for pair in pairs)
    if combinations > limit:
        sizes = ", ".join(f"{name} {size:,}" for name, size in _axis_sizes(experiment, pairs).items())
        raise InvalidInput(
            f"{experiment.place}: {combinations:,} combinations ({sizes}) are more than the limit of {limit:,}",
            "vary less at once, or let axes move together (linked)",
        )
    return combinations


def _axis_sizes(experiment: Experiment, pairs: list[ParameterPair]) -> dict[str, int]:
    sizes = {"algorithm": len(experiment.algorithms.values), "dataset": len(experiment.datasets.values)}
    for pair in pairs:
        for group in pair.groups:
            if len(group) > 1:
                sizes[" + ".join(group.axes)] = len(group)
    return {name: size for name, size in sizes.items() if size > 1}
