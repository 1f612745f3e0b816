"""The result of a plot type: plots, tables, and the runs that it counts and leaves out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from slamhive.analysis.chart import Chart
from slamhive.schema.arrays import Kind

Cell = str | bool | int | float | None


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column of a table.

    Pages link the runs of a column with ``links_run``. ``figures`` says that its texts are numbers such as
    ``0.031 ± 0.002``, which are right-aligned like numbers.
    """

    kind: Kind[Literal["TableColumn"]] = field(default="TableColumn", kw_only=True, repr=False)
    key: str
    label: str
    unit: str = ""
    links_run: bool = False
    figures: bool = False

    @property
    def heading(self) -> str:
        """``ATE RMSE [m]``."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


@dataclass(frozen=True, slots=True)
class ResultTable:
    """Rows of values, None where a value is missing. Pages show a table unless it is ``raw``, for download only.

    ``ranks`` has a row for each row and an entry for each cell: 1 for the best value, printed bold, 2 for the second
    best, underlined, None for others. It is empty for tables that rank nothing.
    """

    kind: Kind[Literal["ResultTable"]] = field(default="ResultTable", kw_only=True, repr=False)
    key: str
    title: str
    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""
    raw: bool = False
    ranks: tuple[tuple[int | None, ...], ...] = ()

    def __post_init__(self) -> None:
        keys = [column.key for column in self.columns]
        if len(set(keys)) != len(keys):
            raise ValueError(f"table {self.key!r} has two columns of one key: {', '.join(keys)}")

    def rank(self, row: int, column: int) -> int | None:
        """The rank of a cell; None if it has none."""
        return self.ranks[row][column] if self.ranks else None

    def is_number(self, column: int) -> bool:
        """Whether a column holds numbers alone, or texts that are numbers."""
        cells = (row[column] for row in self.rows)
        return self.columns[column].figures or all(isinstance(cell, int | float | None) for cell in cells)


@dataclass(frozen=True, slots=True)
class Exclusion:
    """Runs that a plot leaves out, and why."""

    kind: Kind[Literal["Exclusion"]] = field(default="Exclusion", kw_only=True, repr=False)
    reason: str
    runs: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class PlotResult:
    """Plots and tables of one plot type.

    Attributes:
        tables: Tables to show, and raw data.
        runs: Number of runs, including failed ones.
        failed: Number of failed runs.
        excluded: Runs left out for other reasons than failing.
        protocol: The evaluation protocol of its metrics in words; None if no metric depends on one.
        notes: Remarks for the reader, one sentence each.
    """

    kind: Kind[Literal["FormResult"]] = field(default="FormResult", kw_only=True, repr=False)
    charts: tuple[Chart, ...]
    tables: tuple[ResultTable, ...]
    runs: int
    failed: int
    excluded: tuple[Exclusion, ...] = ()
    protocol: str | None = None
    notes: tuple[str, ...] = ()


FormResult = PlotResult
"""The name of version 0.1, for plug-ins."""
