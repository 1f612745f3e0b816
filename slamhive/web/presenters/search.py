"""The search page: search fields, saved searches, groups as table rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import quote

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.finding import MOST_PINNED
from slamhive.domain.metrics import CATALOGUE, Metric
from slamhive.filters.fields import PARAMETER_PREFIX, VARIANT_PREFIX, FieldKind, Vocabulary
from slamhive.filters.syntax import filter_text
from slamhive.services.exports import by_protocol
from slamhive.services.hive import Hive
from slamhive.store.records import GroupRecord, ProtocolLabel, Repeats, RunRecord, SavedSearchRecord
from slamhive.web.columns import PINNED, ColumnKind, ListColumn, ListLook, all_columns, column, settings_of
from slamhive.web.formatting import (
    DASH,
    TableCell,
    display_unit,
    mean_text,
    median_text,
    plural,
    significant,
    value_text,
)
from slamhive.web.presenters.runs import ListRow
from slamhive.web.queries import RunListQuery
from slamhive.web.small_plots import ComparableClass, levels, repeats_path, repeats_words

GONE = "no longer exists"
"""Group of the names that runs refer to but no folder provides."""


@dataclass(frozen=True, slots=True)
class FilterChip:
    """A condition of the search: its text, and the search without it."""

    text: str
    without: RunListQuery


@dataclass(frozen=True, slots=True)
class GroupColumn:
    """A metric in a table of groups."""

    metric: Metric
    unit: str


@dataclass(frozen=True, slots=True)
class GroupRow:
    """One configuration under one protocol. ``first`` is false for its further protocols.

    ``parameters`` are those that not all of the groups share.

    ``means`` are the numbers in ``cells``, None for a missing one. ``sparks`` are the repeats of each cell as a path
    and in words, if they are drawn; None for a cell without.
    """

    group: GroupRecord
    protocol: ProtocolLabel | None
    parameters: str
    all_parameters: str
    cells: tuple[TableCell, ...]
    means: tuple[float | None, ...]
    first: bool
    sparks: tuple[tuple[str, str] | None, ...] = ()


def chips(query: RunListQuery) -> list[FilterChip]:
    """The conditions of a search, each of which can be removed."""
    return [FilterChip(filter_text(part), query.without(place)) for place, part in enumerate(query.conditions)]


def with_differences(rows: Sequence[ListRow]) -> list[ListRow]:
    """The same rows; the column of differences keeps the settings that not all of them share."""
    settings = [settings_of(row.run) for row in rows]
    names = dict.fromkeys(name for found in settings for name in found)
    differ = [name for name in names if len({found.get(name) for found in settings}) > 1]

    def cell(found: Mapping[str, str], shown: TableCell) -> TableCell:
        own = [f"{name}={found[name]}" for name in differ if name in found]
        return replace(shown, text=", ".join(own) or DASH, missing=not own)

    return [
        replace(
            row,
            cells=tuple(
                (column, cell(found, content) if column.kind is ColumnKind.DIFFERS else content)
                for column, content in row.cells
            ),
        )
        for row, found in zip(rows, settings, strict=True)
    ]


def saved_args(record: SavedSearchRecord) -> dict[str, Any]:
    """The address of a saved search."""
    args = {"where": record.filter_text, "columns": ",".join(record.columns), "sort": record.sort.key}
    args["order"] = "desc" if record.sort.descending else "asc"
    if record.grouped:
        args["group"] = "configuration"
    return {name: text for name, text in args.items() if text} | ListLook.of(record).args()


def place_of(query: RunListQuery, saved: Sequence[SavedSearchRecord]) -> int | None:
    """The place of the saved search that the page shows; None if it shows another one."""
    shown = (query.search.text, query.columns, query.sort, query.grouped, query.look)
    known = [(entry.filter_text, entry.columns, entry.sort, entry.grouped, ListLook.of(entry)) for entry in saved]
    return known.index(shown) if shown in known else None


def filter_fields(vocabulary: Vocabulary, names: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Every name that a filter may use, with its label, unit and values to choose from.

    ``names``: {field: the names that are stored}, for fields whose values the language does not fix.
    """
    found = []
    for name in dict.fromkeys(vocabulary.names()):
        field = vocabulary.fields(name)[0]
        values = ("yes", "no") if field.kind is FieldKind.FLAG else names.get(name, field.choices)
        found.append({"name": name, "label": field.label, "unit": field.unit, "values": list(values)})
    return found


def fields_of_filters(hive: Hive) -> list[dict[str, Any]]:
    """:func:`filter_fields` of an installation."""
    algorithms, datasets = hive.searches.names()
    experiments = [entry.name for entry in hive.experiments.list()]
    vocabulary = hive.searches.vocabulary()
    names = {"algorithm": algorithms, "dataset": datasets, "experiment": experiments, "tag": hive.notes.tags()}
    names["protocol"] = list(dict.fromkeys(vocabulary.protocols.values()))
    return filter_fields(vocabulary, names)


def group_columns(columns: Sequence[str]) -> list[GroupColumn]:
    """The metrics among the selected columns."""
    return [GroupColumn(CATALOGUE[key], display_unit(CATALOGUE[key]).unit) for key in columns if key in CATALOGUE]


def group_rows(groups: Iterable[GroupRecord], columns: Sequence[GroupColumn]) -> list[GroupRow]:
    """A row per configuration, and another for each further protocol of its runs."""
    rows = []
    listed = list(groups)
    keys = dict.fromkeys(key for group in listed for key in group.parameters)
    differ = [key for key in keys if len({value_text(group.parameters.get(key, ())) for group in listed}) > 1]
    for group in listed:
        everything, text = (
            ", ".join(f"{key}={value_text(group.parameters[key])}" for key in chosen if key in group.parameters)
            for chosen in (keys, differ)
        )
        for place, (label, figures) in enumerate(by_protocol(group)):
            spreads = [figures.get(column.metric.key) for column in columns]
            cells = []
            for entry, spread in zip(columns, spreads, strict=True):
                if spread is None:
                    cells.append(TableCell(DASH, f"no {entry.metric.label} known", missing=True))
                    continue
                # Mean and standard deviation of the good runs; their number, range and median on hover.
                unit = display_unit(entry.metric)
                std = None if spread.std is None else spread.std * unit.factor
                low, high = (significant(value * unit.factor) for value in (spread.minimum, spread.maximum))
                exact = f"mean of {plural(spread.n, 'good run')}, {low} to {high} {unit.unit}".strip()
                median = median_text(spread.n, spread.median * unit.factor)
                shown = mean_text(spread.mean * unit.factor, std)
                cells.append(TableCell(shown, f"{exact}, {median}" if median else exact))
            means = tuple(None if spread is None else spread.mean for spread in spreads)
            rows.append(GroupRow(group, label, text or DASH, everything, tuple(cells), means, first=place == 0))
    return rows


def with_repeats(rows: Sequence[GroupRow], columns: Sequence[GroupColumn], repeats: Repeats) -> list[GroupRow]:
    """The same rows with the values behind each mean."""

    def spark(row: GroupRow, column: GroupColumn) -> tuple[str, str] | None:
        protocol = row.protocol.fingerprint if column.metric.needs_protocol and row.protocol is not None else None
        values = repeats.get((row.group.configuration_id, protocol, column.metric.key), ())
        factor = display_unit(column.metric).factor
        path = repeats_path(values)
        return (path, repeats_words(values, factor, column.unit)) if path else None

    return [replace(row, sparks=tuple(spark(row, column) for column in columns)) for row in rows]


# -- the columns that the list of runs offers, in groups ---------------------------------------------------------------

OF_RUN = "Run"
SHARED = "Parameters that several algorithms share"
OTHERS = "Parameters of algorithms that are not installed"


@dataclass(frozen=True, slots=True)
class ColumnGroup:
    """Columns that are not shown, under one title."""

    title: str
    columns: tuple[ListColumn, ...]


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


def _fixed() -> list[tuple[str, list[ListColumn]]]:
    """The columns that every installation has."""
    groups: dict[str, list[ListColumn]] = {OF_RUN: []}
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


def _columns(names: Iterable[str], vocabulary: Vocabulary) -> list[ListColumn]:
    """Their columns. A parameter that is called like another column has a prefix."""
    fixed = all_columns()
    return [column(PARAMETER_PREFIX + name if name in fixed else name, vocabulary) for name in names]


# -- the columns that the list of runs shows, with the addresses that move and pin each of them ------------------------


@dataclass(frozen=True, slots=True)
class Arranged:
    """One column. ``left`` and ``right`` are None where the column cannot move further.

    ``pin`` pins the columns up to this one; on the last pinned column, it unpins all.
    """

    column: ListColumn
    left: str | None
    right: str | None
    pin: str
    pinned: bool
    last_pinned: bool


def arranged(base: str, columns: Sequence[ListColumn], pinned: int) -> list[Arranged]:
    """The columns in order. ``base`` is the address of the list with all arguments but ``columns`` and ``pinned``.

    It is made once and the links are appended to it, because Flask takes longer for each address than a row takes.
    """
    keys = [column.key for column in columns]

    def link(name: str, key: str, order: Sequence[str], count: int) -> str:
        kept = "" if count == PINNED else f"&pinned={count}"
        return f"{base}&columns={quote(','.join(order), safe=',')}{kept}#{name}-{quote(key)}"

    def moved(name: str, place: int, by: int) -> str | None:
        if not 0 <= place + by < len(keys):
            return None
        order = keys.copy()
        order.insert(place + by, order.pop(place))
        return link(name, keys[place], order, pinned)

    return [
        Arranged(
            column,
            left=moved("left", place, -1),
            right=moved("right", place, 1),
            pin=link("pin", column.key, keys, 0 if place + 1 == pinned else min(place + 1, MOST_PINNED)),
            pinned=place < pinned,
            last_pinned=place + 1 == pinned,
        )
        for place, column in enumerate(columns)
    ]


# -- colours by value: how good each metric in a list is, compared with the others that are shown ----------------------

# Only what can be compared is compared: good runs of the same dataset, and errors under the same protocol.


def coloured_runs(rows: Sequence[ListRow]) -> list[ListRow]:
    """The same rows with levels in the cells of metrics."""
    cells = [list(row.cells) for row in rows]
    for place, (shown, _) in enumerate(rows[0].cells if rows else ()):
        metric = CATALOGUE.get(shown.key)
        if metric is None:
            continue
        values = [_value(row.run, metric) for row in rows]
        found = levels(values, [_class(row.run.dataset, row.run.protocol, metric) for row in rows], metric.direction)
        for line, heat in zip(cells, found, strict=True):
            line[place] = (shown, replace(line[place][1], heat=heat))
    return [replace(row, cells=tuple(line)) for row, line in zip(rows, cells, strict=True)]


def coloured_groups(rows: Sequence[GroupRow], columns: Sequence[GroupColumn]) -> list[GroupRow]:
    """The same rows with levels in their cells, by the means."""
    cells: list[list[TableCell]] = [list(row.cells) for row in rows]
    for place, shown in enumerate(columns):
        values = [row.means[place] for row in rows]
        classes = [_class(row.group.dataset, row.protocol, shown.metric) for row in rows]
        for line, heat in zip(cells, levels(values, classes, shown.metric.direction), strict=True):
            line[place] = replace(line[place], heat=heat)
    return [replace(row, cells=tuple(line)) for row, line in zip(rows, cells, strict=True)]


def _value(run: RunRecord, metric: Metric) -> float | None:
    """The metric of a run that did not fail: a failed run can have a small error over the little that it tracked."""
    failed = run.verdict is not None and run.verdict.failed
    return None if failed else (run.metrics or {}).get(metric.key)


def _class(dataset: str, protocol: ProtocolLabel | None, metric: Metric) -> ComparableClass:
    return dataset, protocol.fingerprint if metric.needs_protocol and protocol is not None else None
