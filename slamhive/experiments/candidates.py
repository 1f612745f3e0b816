"""The candidates of an experiment that chooses its runs: what is compared, on every dataset alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from slamhive.base.errors import InvalidInput
from slamhive.domain.names import plural
from slamhive.domain.parameters import Value
from slamhive.experiments.experiment import Experiment

DATASET = "dataset"
ALGORITHM = "algorithm"
LEAST_SEARCH_RUNS = 24
"""A search makes so many runs at random places before it can say anything of the others."""


@dataclass(frozen=True, slots=True)
class ExperimentCandidate:
    """A combination of everything but the dataset; ``cells``: {dataset: number of its cell}."""

    values: Mapping[str, Value]
    cells: Mapping[str, int]
    label: str


def candidates_of(cells: Iterable[tuple[int, Mapping[str, Value]]]) -> tuple[ExperimentCandidate, ...]:
    """The candidates among cells, given as numbers and the values of their axes, in the order of their first cells."""
    found: dict[tuple[tuple[str, Value], ...], dict[str, int]] = {}
    for number, values in cells:
        key = tuple((axis, value) for axis, value in values.items() if axis != DATASET)
        found.setdefault(key, {})[str(values[DATASET])] = number
    seen: dict[str, set[Value]] = {}
    for key in found:
        for axis, value in key:
            seen.setdefault(axis, set()).add(value)
    told = [axis for axis, values in seen.items() if len(values) > 1] or [ALGORITHM]
    return tuple(ExperimentCandidate(dict(key), places, _label(dict(key), told)) for key, places in found.items())


def check_candidates(experiment: Experiment, candidates: Iterable[ExperimentCandidate]) -> None:
    """Raise InvalidInput, naming the place, unless the plan of ``experiment`` can be followed with these candidates."""
    plan = experiment.plan
    if plan is None:
        return
    found = list(candidates)
    datasets = {dataset: None for candidate in found for dataset in candidate.cells}
    for candidate in found:
        lacking = [dataset for dataset in datasets if dataset not in candidate.cells]
        if lacking:
            raise InvalidInput(
                f"{plan.place}: {candidate.label} does not run on {', '.join(lacking)}, where others do",
                "loosen where, so that all candidates run on all datasets",
            )
    if len(found) < 2:
        raise InvalidInput(
            f"{plan.place}: there is nothing to choose: {found[0].label} is the only candidate",
            "give two algorithms, or two values of a parameter or step",
        )
    least, each = 2 * len(found) * len(datasets), "2 runs of each"
    if experiment.optimise is not None:
        least, each = min(LEAST_SEARCH_RUNS, len(found)), "the first runs"
    if plan.budget.runs is not None and plan.budget.runs < least:
        raise InvalidInput(
            f"{plan.place}: the budget of {plan.budget.words} is too small for one look: {each} of "
            f"{len(found)} candidates on {plural(len(datasets), 'dataset')} are {least}",
            "raise it, or compare fewer",
        )


def _label(values: Mapping[str, Value], told: Iterable[str]) -> str:
    parts = []
    for axis in told:
        if axis in values:
            value = values[axis]
            text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            parts.append(text if axis == ALGORITHM else f"{axis} {text}")
    return ", ".join(parts)
