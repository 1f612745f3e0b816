"""What a plot type gives: plots, tables with the raw data among them, and what was counted and left out."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.analysis.chart import Chart

Cell = str | int | float | None


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column of a table. ``unit`` stands in its heading; ``links_run`` marks run ids, which pages link."""

    key: str
    label: str
    unit: str = ""
    links_run: bool = False

    @property
    def heading(self) -> str:
        """``ATE RMSE [m]``."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


@dataclass(frozen=True, slots=True)
class ResultTable:
    """Rows of values; None where there is none. ``raw`` tables are for download, the others are shown."""

    key: str
    title: str
    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""
    raw: bool = False

    def __post_init__(self) -> None:
        keys = [column.key for column in self.columns]
        if len(set(keys)) != len(keys):
            raise ValueError(f"table {self.key!r} has two columns of one key: {', '.join(keys)}")


@dataclass(frozen=True, slots=True)
class Exclusion:
    """Runs that a plot type could not show, and why."""

    reason: str
    runs: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class FormResult:
    """Everything that one plot type of an analysis came to.

    Attributes:
        charts: In the order of the page.
        tables: Shown ones and raw data.
        runs: How many runs it is about, failed ones included.
        failed: How many of them count as failed.
        excluded: Runs that are left out for another reason than failing.
        protocol: The evaluation protocol of its plots in words; None if none of them has one.
        notes: What a reader should know, one sentence each.
    """

    charts: tuple[Chart, ...]
    tables: tuple[ResultTable, ...]
    runs: int
    failed: int
    excluded: tuple[Exclusion, ...] = ()
    protocol: str | None = None
    notes: tuple[str, ...] = ()
