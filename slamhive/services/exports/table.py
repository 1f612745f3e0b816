"""Write a table as CSV, JSON, NDJSON or Parquet, page by page, so that memory does not grow with the rows."""

from __future__ import annotations

import csv
import io
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from slamhive.errors import Unavailable

Record = TypeVar("Record")
Cell = TypeVar("Cell")
Value = int | float | str | bool | None
Page: TypeAlias = Callable[[str | None], tuple[Sequence[Record], str | None]]
"""Returns the records of the page after a key (None for the first page) and the key of the next page."""
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n")


class Format(StrEnum):
    """The file formats of exported tables."""

    CSV = "csv"
    JSON = "json"
    NDJSON = "ndjson"
    PARQUET = "parquet"

    @property
    def media_type(self) -> str:
        """The media type for browsers."""
        types = {
            Format.CSV: "text/csv",
            Format.JSON: "application/json",
            Format.NDJSON: "application/x-ndjson",
            Format.PARQUET: "application/vnd.apache.parquet",
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
