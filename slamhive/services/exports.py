"""Tables of runs and configurations as CSV, JSON, NDJSON and Parquet, page by page, so that memory does not grow."""

from __future__ import annotations

import csv
import functools
import io
import itertools
import json
import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from slamhive.base.clock import timestamp
from slamhive.base.errors import Unavailable, unknown
from slamhive.domain.accounts import visibility_of
from slamhive.domain.configuration import variant_of
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.packages import version_label
from slamhive.domain.trust import TRUST_METRICS, Disturbance, Trust
from slamhive.domain.verdict import outcome_words
from slamhive.filters.fields import PARAMETER_PREFIX, FieldKind, Vocabulary
from slamhive.store.metrics import VERDICT
from slamhive.store.records import GroupRecord, ProtocolLabel, Spread, trust_in, verdict_kind
from slamhive.store.run_cells import CellsWanted, RunCells

Record = TypeVar("Record")
Cell = TypeVar("Cell")
Value = int | float | str | bool | None
Page: TypeAlias = Callable[[str | None], tuple[Sequence[Record], str | None]]
"""Returns the records of the page after a key (None for the first page) and the key of the next page."""
RUNS_AT_ONCE = 4_000
"""Rows of an export that are read with one set of statements: enough that statements cost little beside rows."""
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n")


class ExportFormat(StrEnum):
    """The file formats of exported tables."""

    CSV = "csv"
    JSON = "json"
    NDJSON = "ndjson"
    PARQUET = "parquet"

    @property
    def media_type(self) -> str:
        """The media type for browsers."""
        types = {
            ExportFormat.CSV: "text/csv",
            ExportFormat.JSON: "application/json",
            ExportFormat.NDJSON: "application/x-ndjson",
            ExportFormat.PARQUET: "application/vnd.apache.parquet",
        }
        return types[self]


class TableExport(ABC, Generic[Record]):
    """A table of values, in stored units.

    Args:
        columns: Their names.
        numbers: Which of them hold numbers.
    """

    def __init__(self, columns: Sequence[str], numbers: Sequence[bool]) -> None:
        self.columns = tuple(columns)
        self._numbers = tuple(numbers)

    @abstractmethod
    def table(self, records: Sequence[Record]) -> list[list[Value]]:
        """The values of each column for some records; all columns have the same length."""

    def tables(self, page: Page[Record]) -> Iterator[list[list[Value]]]:
        """The values of each column, page by page. Columns are faster to fill, to test and to write than rows."""
        key: str | None = None
        while True:
            records, key = page(key)
            if records:
                yield self.table(records)
            if key is None:
                return

    def rows(self, page: Page[Record]) -> Iterator[tuple[Value, ...]]:
        """All rows, in order."""
        for columns in self.tables(page):
            yield from zip(*columns, strict=True)

    def csv(self, page: Page[Record]) -> Iterator[str]:
        """CSV text; no cell runs as a formula in a spreadsheet."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([safe_cell(name) for name in self.columns])
        for columns in self.tables(page):
            # numbers need no test, and the writer leaves the cell of None empty
            safe = [
                column if number else [safe_cell(value) for value in column]
                for column, number in zip(columns, self._numbers, strict=True)
            ]
            for rows in _batches(zip(*safe, strict=True), 500):
                writer.writerows(rows)
                yield text.getvalue()
                text.seek(0)
                text.truncate()
        yield text.getvalue()

    def json(self, page: Page[Record]) -> Iterator[str]:
        """A JSON list with one object for each row; missing values are null."""
        separator = "["
        for lines in self._json_lines(page):
            yield f"{separator}\n{f',{chr(10)}'.join(lines)}"
            separator = ","
        yield "[]\n" if separator == "[" else "\n]\n"

    def ndjson(self, page: Page[Record]) -> Iterator[str]:
        """A JSON object in each line, one for each row; missing values are null."""
        for lines in self._json_lines(page):
            yield "\n".join(lines) + "\n"

    def _json_lines(self, page: Page[Record]) -> Iterator[list[str]]:
        """JSON objects, one for each row, some hundred at a time."""
        names = [f"{_encode(name)}: " for name in self.columns]
        for columns in self.tables(page):
            cells = [
                [name + _json_cell(value) for value in column] for name, column in zip(names, columns, strict=True)
            ]
            for rows in _batches(zip(*cells, strict=True), 500):
                yield [f"{{{', '.join(row)}}}" for row in rows]

    def parquet(self, page: Page[Record], path: Path) -> int:
        """Write a Parquet file with a row group for each page; returns the number of rows. Needs pyarrow."""
        try:
            import pyarrow as pa  # noqa: PLC0415 - optional
            import pyarrow.parquet as pq  # noqa: PLC0415 - optional
        except ImportError:
            raise Unavailable(
                "Parquet needs pyarrow, which is not installed", "pip install slamhive[parquet]"
            ) from None
        types = [pa.float64() if number else pa.string() for number in self._numbers]
        schema = pa.schema(list(zip(self.columns, types, strict=True)))
        written = 0
        with pq.ParquetWriter(path, schema) as writer:
            for columns in self.tables(page):
                written += len(columns[0])
                arrays = [
                    pa.array(_typed(column, number=number), kind)
                    for column, number, kind in zip(columns, self._numbers, types, strict=True)
                ]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
        return written


_encode = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode


def _json_cell(value: Value) -> str:
    """``value`` as JSON. The encoder takes ten times as long for a number, since it prepares for containers."""
    if value is None:
        return "null"
    plain = type(value) is int or (type(value) is float and math.isfinite(value))
    return repr(value) if plain else _encode(value)


def _batches(rows: Iterator[tuple[Cell, ...]], size: int) -> Iterator[list[tuple[Cell, ...]]]:
    while batch := list(itertools.islice(rows, size)):
        yield batch


def _typed(column: Sequence[Value], *, number: bool) -> list[Any]:
    if number:
        return [None if isinstance(value, str) else value for value in column]
    return [value if value is None or type(value) is str else str(value) for value in column]


def safe_cell(value: Cell) -> Cell | str:
    """Put an apostrophe before text that a spreadsheet would run as a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA_STARTS) else value


# Runs as a table.


@dataclass(frozen=True)
class _Column:
    """A column of the table of runs: what it reads, and its values for some runs."""

    wanted: CellsWanted
    values: Callable[[Sequence[RunCells]], list[Value]]


def _stored(*columns: str, read: Callable[[Any], Value] | None = None) -> _Column:
    """A column made of columns of the database; the first one as it is, without ``read``."""
    value = attrgetter(columns[0]) if read is None else read
    return _Column(CellsWanted(frozenset(columns)), lambda runs: [value(run.row) for run in runs])


def _at(column: str) -> _Column:
    return _stored(column, read=lambda row: timestamp(getattr(row, column)))


def _disturbance(row: Any) -> Disturbance | None:
    return None if row.disturbance is None else Disturbance.of(row.disturbance)


def _outcomes(runs: Sequence[RunCells]) -> list[Value]:
    """The outcomes in words. Few ends differ, so each is put into words once."""
    ends = [(run.row.state, run.row.reason, run.metrics.get(VERDICT)) for run in runs]
    words = {end: outcome_words(run) for end, run in dict(zip(ends, runs, strict=True)).items()}
    return [words[end] for end in ends]


_NOTES = CellsWanted(notes=True)
_COLUMNS: dict[str, _Column] = {
    "id": _stored("id"),
    "algorithm": _stored("algorithm"),
    "version": _stored(
        "version_number",
        "package",
        read=lambda row: None if row.version_number is None else version_label(row.package, row.version_number),
    ),
    "dataset": _stored("dataset"),
    "trajectory": _stored("trajectory"),
    "variant": _stored("variant", read=lambda row: "; ".join(map(str, variant_of(row.variant))) or None),
    "parameters": _Column(CellsWanted(parameters=True), lambda runs: [run.parameters.text for run in runs]),
    "configuration": _stored("configuration_id"),
    "experiment": _stored("experiment"),
    "executor": _stored("executor"),
    "playback": _stored(
        "playback_mode", "playback_rate", read=lambda row: f"{row.playback_mode.value} {row.playback_rate:g}"
    ),
    "seed": _stored("seed"),
    "cpu_cores": _stored("cpu_cores"),
    "memory_mb": _stored("memory_mb"),
    "slow_down": _stored("slow_down"),
    "state": _stored("state", read=lambda row: row.state.value),
    "outcome": _Column(
        CellsWanted(frozenset({"state", "reason"}), frozenset({VERDICT})),
        _outcomes,
    ),
    "reason": _stored("reason", read=lambda row: None if row.reason is None else row.reason.value),
    "verdict": _Column(
        CellsWanted(frozenset({"state", "reason"}), frozenset({VERDICT})),
        lambda runs: [
            None if (kind := verdict_kind(run.state, run.reason, run.judged)) is None else kind.value for run in runs
        ],
    ),
    "trust": _Column(
        CellsWanted(frozenset({"executor", "state", "playback_mode", "disturbance"}), TRUST_METRICS),
        lambda runs: [
            trust_text(
                trust_in(run.metrics, _disturbance(run.row), run.row.state, run.row.executor, run.row.playback_mode)
            )
            for run in runs
        ],
    ),
    "disturbed": _stored("disturbance", read=lambda row: disturbed_text(_disturbance(row))),
    "owner": _stored("owner"),
    "visibility": _stored("audience", read=lambda row: visibility_of(row.audience).value),
    "tags": _Column(_NOTES, lambda runs: [", ".join(run.notes.tags) or None for run in runs]),
    "note": _Column(_NOTES, lambda runs: [run.notes.note or None for run in runs]),
    "created_at": _at("created_at"),
    "started_at": _at("started_at"),
    "ended_at": _at("ended_at"),
    "protocol": _stored("protocol_fingerprint"),
}


def disturbed_text(found: Disturbance | None) -> str | None:
    """``yes`` or ``no``; None if unknown."""
    return None if found is None else {True: "yes", False: "no", None: None}[found.disturbed]


def trust_text(found: Trust | None) -> str | None:
    """The level of trust; None if unknown."""
    return None if found is None or found.level is None else found.level.value


class RunExport(TableExport[RunCells]):
    """Values of the selected columns.

    Args:
        columns: Keys of columns, metrics and parameters; raises NotFound for an unknown one.
        vocabulary: The known parameters.
    """

    def __init__(self, columns: Sequence[str], vocabulary: Vocabulary) -> None:
        chosen = [_column(key, vocabulary) for key in columns]
        self.wanted = functools.reduce(operator.or_, (column.wanted for column in chosen), CellsWanted())
        self._values = [column.values for column in chosen]
        super().__init__(columns, [_is_number(key, vocabulary) for key in columns])

    def table(self, records: Sequence[RunCells]) -> list[list[Value]]:
        """The values of each column."""
        return [values(records) for values in self._values]


def _column(key: str, vocabulary: Vocabulary) -> _Column:
    if key in _COLUMNS:
        return _COLUMNS[key]
    if key in CATALOGUE:
        return _Column(CellsWanted(metrics=frozenset({key})), lambda runs: [run.metrics.get(key) for run in runs])
    name = key.removeprefix(PARAMETER_PREFIX)
    if name not in vocabulary.parameters:
        raise unknown("column", key, [*_COLUMNS, *CATALOGUE, *vocabulary.parameters])
    own_keys = vocabulary.own_keys.get(name, (name,))
    return _Column(CellsWanted(parameters=True), lambda runs: [_plain(run.parameters.values, own_keys) for run in runs])


def _plain(parameters: Mapping[str, Any], own_keys: Sequence[str]) -> Value:
    value = next((parameters[key] for key in own_keys if key in parameters), None)
    return json.dumps(value) if isinstance(value, tuple) else value


def _is_number(key: str, vocabulary: Vocabulary) -> bool:
    if key in _COLUMNS:
        return key in {"id", "configuration", "seed", "cpu_cores", "memory_mb", "slow_down"}
    if key in CATALOGUE:
        return True
    return all(entry.kind is FieldKind.NUMBER for entry in vocabulary.parameters[key.removeprefix(PARAMETER_PREFIX)])


# Configurations as a table.

HEAD = ("configuration", "algorithm", "dataset", "parameters", "runs", "failed", "protocol", "disturbed", "all_runs")
_NUMBERS = frozenset({"configuration", "runs", "failed", "disturbed", "all_runs"})
_PARTS = ("mean", "std", "n", "min", "max", "median")


class GroupExport(TableExport[GroupRecord]):
    """One row for each configuration and protocol, with columns such as ``ate.rmse.mean`` and ``ate.rmse.std``.

    Args:
        metrics: Keys of the metrics; the standard deviation of a single run is missing.
    """

    def __init__(self, metrics: Sequence[str]) -> None:
        self._metrics = tuple(metrics)
        figures = [f"{key}.{part}" for key in metrics for part in _PARTS]
        super().__init__((*HEAD, *figures), [name in _NUMBERS for name in HEAD] + [True] * len(figures))

    def table(self, records: Sequence[GroupRecord]) -> list[list[Value]]:
        """The values of each column, with one row for each protocol of a configuration."""
        return [list(column) for column in zip(*itertools.chain.from_iterable(map(self._rows, records)), strict=True)]

    def _rows(self, record: GroupRecord) -> Iterator[tuple[Value, ...]]:
        parameters = json.dumps(record.parameters, sort_keys=True)
        for label, figures in by_protocol(record):
            head = (record.configuration_id, record.algorithm, record.dataset, parameters, record.runs, record.failed)
            values = (value for key in self._metrics for value in _parts(figures.get(key)))
            yield (*head, None if label is None else label.fingerprint, record.disturbed, record.all_runs, *values)


def by_protocol(group: GroupRecord) -> Iterator[tuple[ProtocolLabel | None, dict[str, Spread]]]:
    """The metrics under each protocol, or without one, together with those that need no protocol."""
    measured = group.figures.get(None, {})
    labels: list[ProtocolLabel | None] = [label for label in group.figures if label is not None]
    for label in labels or [None]:
        yield label, {**measured, **({} if label is None else group.figures[label])}


def _parts(spread: Spread | None) -> tuple[Value, ...]:
    if spread is None:
        return (None,) * len(_PARTS)
    return spread.mean, spread.std, spread.n, spread.minimum, spread.maximum, spread.median
