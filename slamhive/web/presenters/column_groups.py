"""The columns that the list of runs offers, in groups: of the run, metrics by family, parameters by algorithm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.metrics import CATALOGUE
from slamhive.search.fields import PARAMETER_PREFIX, VARIANT_PREFIX, Vocabulary
from slamhive.web.columns import Column, all_columns, column

OF_RUN = "Run"
SHARED = "Parameters that several algorithms share"
OTHERS = "Parameters of algorithms that are not installed"


@dataclass(frozen=True, slots=True)
class ColumnGroup:
    """Columns that are not shown, under one title."""

    title: str
    columns: tuple[Column, ...]


def column_groups(
    shown: Collection[str], algorithms: Iterable[Algorithm], vocabulary: Vocabulary, used: Collection[str]
) -> list[ColumnGroup]:
    """All columns but those ``shown``, each once, without empty groups.

    ``used`` are the parameters that configurations have, by key and by general name: others would be empty columns.
    """
    known = {name for name in used if name in vocabulary.parameters and not name.startswith(VARIANT_PREFIX)}
    parameters = ((title, _columns(sorted(keys), vocabulary)) for title, keys in _parameters(algorithms, known))
    left = ((t, tuple(entry for entry in columns if entry.key not in shown)) for t, columns in (*_fixed(), *parameters))
    return [ColumnGroup(title, columns) for title, columns in left if columns]


def _fixed() -> list[tuple[str, list[Column]]]:
    """The columns that every installation has."""
    groups: dict[str, list[Column]] = {OF_RUN: []}
    for entry in all_columns().values():
        metric = CATALOGUE.get(entry.key)
        title = OF_RUN if metric is None else f"Metrics: {metric.group.value}"
        groups.setdefault(title, []).append(entry)
    return list(groups.items())


def _parameters(algorithms: Iterable[Algorithm], known: Collection[str]) -> Iterator[tuple[str, set[str]]]:
    """The parameters by package, whose modes share them; then what several packages have, then what none has."""
    packages: dict[str, set[str]] = {}
    general: set[str] = set()
    for algorithm in algorithms:
        own = packages.setdefault(algorithm.package.name, set())
        own.update(entry.key for entry in algorithm.parameters if entry.key in known)
        general.update(entry.general for entry in algorithm.parameters if entry.general and entry.general in known)
    counts = Counter(key for keys in packages.values() for key in keys)
    shared = general | {key for key, count in counts.items() if count > 1}
    for name, keys in sorted(packages.items()):
        yield f"Parameters: {name}", keys - shared
    yield SHARED, shared
    yield OTHERS, {*known} - counts.keys() - shared


def _columns(names: Iterable[str], vocabulary: Vocabulary) -> list[Column]:
    """Their columns. A parameter that is called like another column has a prefix."""
    fixed = all_columns()
    return [column(PARAMETER_PREFIX + name if name in fixed else name, vocabulary) for name in names]
