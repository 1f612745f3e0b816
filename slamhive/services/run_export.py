"""Runs as a file: CSV, JSON or Parquet, page after page, so that any number fits into little memory."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from slamhive.domain.metrics import CATALOGUE
from slamhive.errors import Unavailable, unknown
from slamhive.search.fields import PARAMETER_PREFIX, Kind, Vocabulary
from slamhive.services.run_json import timestamp
from slamhive.services.table_text import safe_cell
from slamhive.store.records import RunRecord

Value = int | float | str | bool | None
Page = Callable[[str | None], tuple[Sequence[RunRecord], str | None]]
"""The runs of the page after a key (None: the first), and the key of the next."""


class Format(StrEnum):
    """What runs can be exported as."""

    CSV = "csv"
    JSON = "json"
    PARQUET = "parquet"

    @property
    def media_type(self) -> str:
        """For the browser."""
        types = {"csv": "text/csv", "json": "application/json", "parquet": "application/vnd.apache.parquet"}
        return types[self.value]


_COLUMNS: dict[str, Callable[[RunRecord], Value]] = {
    "id": lambda run: run.id,
    "algorithm": lambda run: run.algorithm,
    "dataset": lambda run: run.dataset,
    "variant": lambda run: "; ".join(map(str, run.variant)) or None,
    "parameters": lambda run: json.dumps(run.parameters, sort_keys=True),
    "configuration": lambda run: run.configuration_id,
    "experiment": lambda run: run.experiment,
    "executor": lambda run: run.executor,
    "playback": lambda run: f"{run.playback.mode.value} {run.playback.rate:g}",
    "seed": lambda run: run.seed,
    "state": lambda run: run.state.value,
    "reason": lambda run: None if run.reason is None else run.reason.value,
    "created_at": lambda run: timestamp(run.created_at),
    "started_at": lambda run: timestamp(run.started_at),
    "ended_at": lambda run: timestamp(run.ended_at),
    "protocol": lambda run: None if run.protocol is None else run.protocol.fingerprint,
}


class RunExport:
    """Values of chosen columns, in stored units.

    Args:
        columns: Keys of columns, metrics and parameters; raises NotFound for one that there is not.
        vocabulary: The parameters that there are.
    """

    def __init__(self, columns: Sequence[str], vocabulary: Vocabulary) -> None:
        self.columns = tuple(columns)
        self._readers = [_reader(key, vocabulary) for key in columns]
        self._numbers = [_is_number(key, vocabulary) for key in columns]

    def rows(self, page: Page) -> Iterator[tuple[Value, ...]]:
        """One row a run, in the order of the pages."""
        key: str | None = None
        while True:
            records, key = page(key)
            for record in records:
                yield tuple(read(record) for read in self._readers)
            if key is None:
                return

    def csv(self, page: Page) -> Iterator[str]:
        """Comma-separated text; no cell is taken for a formula by a spreadsheet."""
        return _csv_lines(self.columns, self.rows(page))

    def json(self, page: Page) -> Iterator[str]:
        """A JSON list with an object a run; what is not known is null."""
        separator = "["
        for row in self.rows(page):
            content = dict(zip(self.columns, row, strict=True))
            yield f"{separator}\n{json.dumps(content, ensure_ascii=False, allow_nan=False)}"
            separator = ","
        yield "[]\n" if separator == "[" else "\n]\n"

    def parquet(self, page: Page, path: Path) -> None:
        """A Parquet file, a row group for each 1000 rows; needs pyarrow."""
        try:
            import pyarrow as pa  # noqa: PLC0415 - optional
            import pyarrow.parquet as pq  # noqa: PLC0415 - optional
        except ImportError:
            raise Unavailable(
                "Parquet needs pyarrow, which is not installed", "pip install slamhive[parquet]"
            ) from None
        types = [pa.float64() if number else pa.string() for number in self._numbers]
        schema = pa.schema(list(zip(self.columns, types, strict=True)))
        with pq.ParquetWriter(path, schema) as writer:
            for rows in _batches(self.rows(page), 1000):
                columns = list(zip(*rows, strict=True)) if rows else [()] * len(types)
                values = [_typed(column, number=number) for column, number in zip(columns, self._numbers, strict=True)]
                arrays = [pa.array(column, kind) for column, kind in zip(values, types, strict=True)]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


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
    return all(entry.kind is Kind.NUMBER for entry in vocabulary.parameters[key.removeprefix(PARAMETER_PREFIX)])
