"""The search page: search fields, saved searches, groups as table rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.metrics import CATALOGUE, Metric
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.sensors import SensorSetup
from slamhive.domain.verdict import GROUPS, VerdictKind
from slamhive.executors.registry import EXECUTORS
from slamhive.search.fields import TRUST, Kind, Vocabulary
from slamhive.services.exports import by_protocol
from slamhive.services.hive import Hive
from slamhive.store.records import GroupRecord, ProtocolLabel, Repeats, RunRecord, SavedSearchRecord, Spread
from slamhive.web.formatting import DASH, Cell, display_unit, mean_text, median_text, plural, significant, value_text
from slamhive.web.look import Look
from slamhive.web.run_query import RunQuery
from slamhive.web.sparks import repeats_path, repeats_words

GONE = "no longer exists"
"""Group of the names that runs refer to but no folder provides."""


@dataclass(frozen=True, slots=True)
class Choice:
    """A selection list: {group: values}, with "" for values without a group."""

    name: str
    title: str
    groups: Mapping[str, tuple[tuple[str, str], ...]]
    chosen: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RangeField:
    """Minimum and maximum of a metric, as typed."""

    metric: Metric
    minimum: str
    maximum: str


@dataclass(frozen=True, slots=True)
class GroupColumn:
    """A metric in a table of groups."""

    metric: Metric
    unit: str


@dataclass(frozen=True, slots=True)
class GroupRow:
    """One configuration under one protocol. ``first`` is false for its further protocols.

    ``means`` are the numbers in ``cells``, None for a missing one. ``sparks`` are the repeats of each cell as a path
    and in words, if they are drawn; None for a cell without.
    """

    group: GroupRecord
    protocol: ProtocolLabel | None
    parameters: str
    cells: tuple[Cell, ...]
    means: tuple[float | None, ...]
    first: bool
    sparks: tuple[tuple[str, str] | None, ...] = ()


def choices(
    fields: Mapping[str, tuple[str, ...]],
    algorithms: Sequence[Algorithm],
    datasets: Sequence[Dataset],
    stored: tuple[list[str], list[str]],
) -> list[Choice]:
    """The selection lists, grouped. Names in ``stored`` without a folder stay selectable."""
    there = ({entry.name for entry in algorithms}, {entry.name for entry in datasets})
    gone = [[(GONE, name, name) for name in stored[place] if name not in there[place]] for place in (0, 1)]
    found = {
        "algorithm": (
            "Algorithms",
            _grouped([*((a.package.name, a.name, f"{a.name} ({a.setup.value})") for a in algorithms), *gone[0]]),
        ),
        "dataset": ("Datasets", _grouped([*((_sensors(d), d.name, d.name) for d in datasets), *gone[1]])),
        "sensor": ("Sensors", _plain(SensorSetup)),
        "state": ("State", _plain(RunState)),
        "reason": ("Failure reason", _plain(FailureReason)),
        "verdict": ("Verdict", _verdicts()),
        "trust": ("Trust", _plain(TRUST.choices)),
        "executor": ("Executor", _plain(EXECUTORS.names())),
        "experiment": ("Experiment", {}),
    }
    return [_choice(name, title, groups, fields.get(name, ())) for name, (title, groups) in found.items()]


def ranges(fields: Mapping[str, tuple[str, ...]], stored: Iterable[str]) -> dict[str, list[RangeField]]:
    """{group: fields} of the metrics that runs have, or that the user typed a limit for."""
    offered = set(stored)
    found: dict[str, list[RangeField]] = {}
    for key, metric in CATALOGUE.items():
        low, high = ("".join(fields.get(f"{bound}.{key}", ())) for bound in ("min", "max"))
        if key in offered or low or high:
            found.setdefault(metric.group.value, []).append(RangeField(metric, low, high))
    return found


def saved_args(record: SavedSearchRecord) -> dict[str, Any]:
    """The address of a saved search."""
    args = {"where": record.filter_text, "columns": ",".join(record.columns), "sort": record.sort.key}
    args["order"] = "desc" if record.sort.descending else "asc"
    if record.grouped:
        args["group"] = "configuration"
    return {name: text for name, text in args.items() if text} | Look.of(record).args()


def place_of(query: RunQuery, saved: Sequence[SavedSearchRecord]) -> int | None:
    """The place of the saved search that the page shows; None if it shows another one."""
    shown = (query.search.text, query.columns, query.sort, query.grouped, query.look)
    known = [(entry.filter_text, entry.columns, entry.sort, entry.grouped, Look.of(entry)) for entry in saved]
    return known.index(shown) if shown in known else None


def filter_fields(vocabulary: Vocabulary, names: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Every name that a filter may use, with its label, unit and values to choose from.

    ``names``: {field: the names that are stored}, for fields whose values the language does not fix.
    """
    found = []
    for name in dict.fromkeys(vocabulary.names()):
        field = vocabulary.fields(name)[0]
        values = ("yes", "no") if field.kind is Kind.FLAG else names.get(name, field.choices)
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
    return [row for group in groups for row in _rows_of(group, columns)]


def with_repeats(rows: Sequence[GroupRow], columns: Sequence[GroupColumn], repeats: Repeats) -> list[GroupRow]:
    """The same rows with the values behind each mean."""

    def spark(row: GroupRow, column: GroupColumn) -> tuple[str, str] | None:
        protocol = row.protocol.fingerprint if column.metric.needs_protocol and row.protocol is not None else None
        values = repeats.get((row.group.configuration_id, protocol, column.metric.key), ())
        factor = display_unit(column.metric).factor
        path = repeats_path(values)
        return (path, repeats_words(values, factor, column.unit)) if path else None

    return [replace(row, sparks=tuple(spark(row, column) for column in columns)) for row in rows]


def mixed_protocols(labels: Iterable[ProtocolLabel | None]) -> list[ProtocolLabel]:
    """The protocols of a list by label, if it mixes errors of several; empty otherwise."""
    several = {label.fingerprint: label for label in labels if label is not None}
    return sorted(several.values(), key=lambda label: (label.label, label.fingerprint)) if len(several) > 1 else []


def protocol_warning(mixed: Sequence[ProtocolLabel]) -> str:
    """What precedes the links to each of these protocols; empty for none."""
    if not mixed:
        return ""
    return f"This list mixes errors of {len(mixed)} protocols, which are not comparable. Show them under one:"


def trajectory_warning(runs: Iterable[RunRecord]) -> str:
    """A warning if a list mixes errors of several kinds of trajectory; empty otherwise."""
    several = sorted({run.trajectory for run in runs if run.protocol is not None and run.trajectory is not None})
    if len(several) < 2:
        return ""
    return (
        f"This list mixes {' and '.join(kind.adjective for kind in several)} trajectories, which are not comparable. "
        f"Filter by trajectory = {several[0]}, or evaluate under a protocol that names one."
    )


def _rows_of(group: GroupRecord, columns: Sequence[GroupColumn]) -> list[GroupRow]:
    text = ", ".join(f"{key}={value_text(value)}" for key, value in group.parameters.items())
    rows = []
    for place, (label, figures) in enumerate(by_protocol(group)):
        spreads = [figures.get(column.metric.key) for column in columns]
        cells = tuple(_spread_cell(column.metric, spread) for column, spread in zip(columns, spreads, strict=True))
        means = tuple(None if spread is None else spread.mean for spread in spreads)
        rows.append(GroupRow(group, label, text or DASH, cells, means, first=place == 0))
    return rows


def _spread_cell(metric: Metric, spread: Spread | None) -> Cell:
    """Mean, standard deviation and median of the good runs; their number and range on hover."""
    if spread is None:
        return Cell(DASH, f"no {metric.label} known", missing=True)
    shown = display_unit(metric)
    text = mean_text(spread.mean * shown.factor, None if spread.std is None else spread.std * shown.factor)
    low, high = (significant(value * shown.factor) for value in (spread.minimum, spread.maximum))
    exact = f"mean of {plural(spread.n, 'good run')}, {low} to {high} {shown.unit}".strip()
    return Cell(text, exact, note=median_text(spread.n, spread.median * shown.factor))


def _choice(name: str, title: str, groups: dict[str, tuple[tuple[str, str], ...]], chosen: tuple[str, ...]) -> Choice:
    known = {value for entries in groups.values() for value, _ in entries}
    lost = tuple((value, value) for value in chosen if value not in known)
    return Choice(name, title, {**groups, **({"": (*groups.get("", ()), *lost)} if lost else {})}, chosen)


def _plain(values: Iterable[str]) -> dict[str, tuple[tuple[str, str], ...]]:
    return {"": tuple((str(value), str(value).replace("_", " ")) for value in values)}


def _verdicts() -> dict[str, tuple[tuple[str, str], ...]]:
    kinds = tuple((kind.value, kind.label) for kind in VerdictKind)
    return {"": tuple((name, f"{name}, all kinds") for name in GROUPS), "single kinds": kinds}


def _grouped(entries: Iterable[tuple[str, str, str]]) -> dict[str, tuple[tuple[str, str], ...]]:
    found: dict[str, tuple[tuple[str, str], ...]] = {}
    for group, value, label in sorted(entries):
        found[group] = (*found.get(group, ()), (value, label))
    return found


def _algorithm(algorithm: Algorithm) -> tuple[str, str, str]:
    return algorithm.package.name, algorithm.name, f"{algorithm.name} ({algorithm.setup.value})"


def _sensors(dataset: Dataset) -> str:
    """The group of a dataset: its kinds of sensors."""
    return " + ".join(sorted({sensor.kind.value for sensor in dataset.sensors})) or "no sensors"
