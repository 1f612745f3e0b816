"""Expands an experiment into its runs, in a fixed order and under fixed names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from slamhive.base.errors import InvalidInput
from slamhive.domain.configuration import Configuration, Variant
from slamhive.domain.parameters import Value
from slamhive.experiments.binding import CatalogueView, ParameterPair, Row
from slamhive.experiments.check import Filter, bind_all
from slamhive.experiments.experiment import Experiment

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

    ``number`` counts runs, ``cell`` configurations and ``repeat`` repeats from 1; ``name`` belongs to the configuration
    (``paper-euroc-0007``).
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
        seen: set[bytes] = set()
        number = 0
        for pair in pairs:
            heading: dict[str, Value] = {"algorithm": pair.algorithm.label, "dataset": pair.dataset.name}
            for row in _rows(pair, conditions):
                configuration = pair.configuration(row)
                content_hash = configuration.content_hash
                digest = bytes.fromhex(content_hash)
                if digest in seen:
                    self.merged += 1
                    continue
                seen.add(digest)
                name = f"{experiment.name}-{len(seen):0{digits}d}"
                values = {**heading, **row}
                for seed in experiment.seeds:
                    for repeat in range(1, experiment.repeats + 1):
                        number += 1
                        yield PlannedRun(number, len(seen), name, configuration, content_hash, values, seed, repeat)


def expand(experiment: Experiment, view: CatalogueView, limit: int = MAX_COMBINATIONS) -> Expansion:
    """Check everything as :func:`count` does, then yield the runs; identical configurations come once."""
    return Expansion(experiment, view, limit)


def _checked(experiment: Experiment, view: CatalogueView, limit: int) -> tuple[Size, list[ParameterPair], Filter]:
    pairs, conditions = bind_all(experiment, view)
    combinations = _check_size(experiment, pairs, limit)
    remaining = {id(pair): sum(1 for _ in _rows(pair, conditions)) for pair in pairs}
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


def _rows(pair: ParameterPair, conditions: Filter) -> Iterator[Row]:
    """The rows that meet the conditions; their variants are checked on the way."""
    for row in pair.rows():
        if conditions and conditions.excludes(pair.context(row)):
            continue
        pair.variant(row)
        yield row


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
