"""Tables of runs and configurations as CSV, JSON, NDJSON and Parquet, page by page, so that memory does not grow."""

from __future__ import annotations

import csv
import io
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from slamhive.base.errors import Unavailable, unknown
from slamhive.documents.json_values import timestamp
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.trust import Disturbance, Trust
from slamhive.filters.fields import PARAMETER_PREFIX, FieldKind, Vocabulary
from slamhive.store.records import GroupRecord, ProtocolLabel, RunRecord, Spread

Record = TypeVar("Record")
Cell = TypeVar("Cell")
Value = int | float | str | bool | None
Page: TypeAlias = Callable[[str | None], tuple[Sequence[Record], str | None]]
"""Returns the records of the page after a key (None for the first page) and the key of the next page."""
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
    """Rows of values, in stored units.

    Args:
        columns: Their names.
        numbers: Which of them hold numbers.
    """

    def __init__(self, columns: Sequence[str], numbers: Sequence[bool]) -> None:
        self.columns = tuple(columns)
        self._numbers = tuple(numbers)

    @abstractmethod
    def cells(self, record: Record) -> Iterator[tuple[Value, ...]]:
        """The rows of one record."""

    def rows(self, page: Page[Record]) -> Iterator[tuple[Value, ...]]:
        """All rows, in order."""
        key: str | None = None
        while True:
            records, key = page(key)
            for record in records:
                yield from self.cells(record)
            if key is None:
                return

    def csv(self, page: Page[Record]) -> Iterator[str]:
        """CSV text; no cell runs as a formula in a spreadsheet."""
        return _csv_lines(self.columns, self.rows(page))

    def json(self, page: Page[Record]) -> Iterator[str]:
        """A JSON list with one object for each row; missing values are null."""
        separator = "["
        for line in self.ndjson(page):
            yield f"{separator}\n{line.rstrip()}"
            separator = ","
        yield "[]\n" if separator == "[" else "\n]\n"

    def ndjson(self, page: Page[Record]) -> Iterator[str]:
        """A JSON object in each line, one for each row; missing values are null."""
        for row in self.rows(page):
            content = dict(zip(self.columns, row, strict=True))
            yield f"{json.dumps(content, ensure_ascii=False, allow_nan=False)}\n"

    def parquet(self, page: Page[Record], path: Path) -> int:
        """Write a Parquet file with a row group for each 1000 rows; returns the number of rows. Needs pyarrow."""
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
            for rows in _batches(self.rows(page), 1000):
                written += len(rows)
                columns = list(zip(*rows, strict=True))
                values = [_typed(column, number=number) for column, number in zip(columns, self._numbers, strict=True)]
                arrays = [pa.array(column, kind) for column, kind in zip(values, types, strict=True)]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
        return written


def _csv_lines(header: Sequence[str], rows: Iterable[Sequence[Value]]) -> Iterator[str]:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([safe_cell(name) for name in header])
    for row in rows:
        writer.writerow(["" if value is None else safe_cell(value) for value in row])
        if text.tell() > 32_000:
            yield text.getvalue()
            text.seek(0)
            text.truncate()
    yield text.getvalue()


def _batches(rows: Iterator[tuple[Value, ...]], size: int) -> Iterator[list[tuple[Value, ...]]]:
    batch: list[tuple[Value, ...]] = []
    for row in rows:
        batch.append(row)
        if len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch


def _typed(column: Sequence[Value], *, number: bool) -> list[Any]:
    if number:
        return [None if value is None or isinstance(value, str) else float(value) for value in column]
    return [None if value is None else str(value) for value in column]


def safe_cell(value: Cell) -> Cell | str:
    """Put an apostrophe before text that a spreadsheet would run as a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA_STARTS) else value


# Runs as a table.

_COLUMNS: dict[str, Callable[[RunRecord], Value]] = {
    "id": lambda run: run.id,
    "algorithm": lambda run: run.algorithm,
    "version": lambda run: run.version_label,
    "dataset": lambda run: run.dataset,
    "trajectory": lambda run: run.trajectory,
    "variant": lambda run: "; ".join(map(str, run.variant)) or None,
    "parameters": lambda run: json.dumps(run.parameters, sort_keys=True),
    "configuration": lambda run: run.configuration_id,
    "experiment": lambda run: run.experiment,
    "executor": lambda run: run.executor,
    "playback": lambda run: f"{run.playback.mode.value} {run.playback.rate:g}",
    "seed": lambda run: run.seed,
    "state": lambda run: run.state.value,
    "reason": lambda run: None if run.reason is None else run.reason.value,
    "verdict": lambda run: None if run.verdict is None else run.verdict.kind.value,
    "trust": lambda run: trust_text(run.trust),
    "disturbed": lambda run: disturbed_text(run.disturbance),
    "owner": lambda run: run.owner,
    "visibility": lambda run: run.seen_by.value,
    "tags": lambda run: ", ".join(run.tags) or None,
    "note": lambda run: run.note,
    "created_at": lambda run: timestamp(run.created_at),
    "started_at": lambda run: timestamp(run.started_at),
    "ended_at": lambda run: timestamp(run.ended_at),
    "protocol": lambda run: None if run.protocol is None else run.protocol.fingerprint,
}


def disturbed_text(found: Disturbance | None) -> str | None:
    """``yes`` or ``no``; None if unknown."""
    return None if found is None else {True: "yes", False: "no", None: None}[found.disturbed]


def trust_text(found: Trust | None) -> str | None:
    """The level of trust; None if unknown."""
    return None if found is None or found.level is None else found.level.value


class RunExport(TableExport[RunRecord]):
    """Values of the selected columns.

    Args:
        columns: Keys of columns, metrics and parameters; raises NotFound for an unknown one.
        vocabulary: The known parameters.
    """

    def __init__(self, columns: Sequence[str], vocabulary: Vocabulary) -> None:
        self._readers = [_reader(key, vocabulary) for key in columns]
        super().__init__(columns, [_is_number(key, vocabulary) for key in columns])

    def cells(self, record: RunRecord) -> Iterator[tuple[Value, ...]]:
        """One row for each run."""
        yield tuple(read(record) for read in self._readers)


def _reader(key: str, vocabulary: Vocabulary) -> Callable[[RunRecord], Value]:
    if key in _COLUMNS:
        return _COLUMNS[key]
    if key in CATALOGUE:
        return lambda run: (run.metrics or {}).get(key)
    name = key.removeprefix(PARAMETER_PREFIX)
    if name not in vocabulary.parameters:
        raise unknown("column", key, [*_COLUMNS, *CATALOGUE, *vocabulary.parameters])
    own_keys = vocabulary.own_keys.get(name, (name,))
    return lambda run: _plain(run.parameters, own_keys)


def _plain(parameters: Mapping[str, Any], own_keys: Sequence[str]) -> Value:
    value = next((parameters[key] for key in own_keys if key in parameters), None)
    return json.dumps(value) if isinstance(value, tuple) else value


def _is_number(key: str, vocabulary: Vocabulary) -> bool:
    if key in _COLUMNS:
        return key in {"id", "configuration", "seed"}
    if key in CATALOGUE:
        return True
    return all(entry.kind is FieldKind.NUMBER for entry in vocabulary.parameters[key.removeprefix(PARAMETER_PREFIX)])


# Configurations as a table.

HEAD = ("configuration", "algorithm", "dataset", "parameters", "runs", "failed", "protocol", "disturbed")
_NUMBERS = frozenset({"configuration", "runs", "failed", "disturbed"})
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

    def cells(self, record: GroupRecord) -> Iterator[tuple[Value, ...]]:
        """One row for each protocol."""
        parameters = json.dumps(record.parameters, sort_keys=True)
        for label, figures in by_protocol(record):
            head = (record.configuration_id, record.algorithm, record.dataset, parameters, record.runs, record.failed)
            values = (value for key in self._metrics for value in _parts(figures.get(key)))
            yield (*head, None if label is None else label.fingerprint, record.disturbed, *values)


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
