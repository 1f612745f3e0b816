"""The report of an analysis: as it is stored, as its page shows it, and as ``slamhive analyse --json`` prints it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self

from pydantic import Field

from slamhive.analysis.chart import Chart
from slamhive.base.errors import InvalidInput
from slamhive.documents.arrays import Kind
from slamhive.documents.model import Document, Timestamp, described
from slamhive.domain.bibliography import Reference

# The result of a plot type: plots, tables, and the runs that it counts and leaves out.


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
        """Tell if a column holds numbers alone, or texts that are numbers."""
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


FORMAT = 1


class ProtocolRuns(Document):
    """Number of runs evaluated under a protocol."""

    fingerprint: str
    label: str
    runs: int


class DisturbedRuns(Document):
    """Runs that were measured on a disturbed machine."""

    disturbed: int
    unknown: Annotated[int, described("Runs of which it is not known.")]
    left_out: Annotated[int | None, described("Null unless the analysis leaves them out.")]


class Summary(Document):
    """Subject of an analysis: its runs and how they were judged."""

    format: int = FORMAT
    name: str
    text: Annotated[str, described("Introduction in Markdown.")]
    made_at: Timestamp
    selection: Annotated[str, described("The selection in words.")]
    sets: Annotated[dict[str, str], described("Each set of runs in words.")]
    runs: int
    configurations: int
    algorithms: tuple[str, ...]
    datasets: tuple[str, ...]
    failed: Annotated[int, described("Runs that count as failed.")]
    failed_because: Annotated[dict[str, int], described("How many, by reason.")]
    unevaluated: Annotated[int, described("Runs that were left out because they have no evaluation.")] = 0
    disturbance: Annotated[DisturbedRuns | None, described("Null in reports of version 0.1.")] = None
    mixed_versions: Annotated[
        dict[str, tuple[str, ...]], described("The versions of each algorithm whose runs used several.")
    ] = Field(default_factory=dict)
    mixed_trajectories: Annotated[
        dict[str, tuple[str, ...]],
        described(
            "The algorithms by the kind of trajectory that was judged (live, final, keyframes), if several were."
        ),
    ] = Field(default_factory=dict)
    mixed_protocols: Annotated[
        str | None, described("How many runs use which protocol, and the remedy, if their errors are not comparable.")
    ] = None
    mixed_cpus: Annotated[dict[str, int], described("The number of runs on each CPU model if they ran on several.")] = (
        Field(default_factory=dict)
    )
    rule: Annotated[str, described("When a run counts as failed.")]
    protocols: tuple[ProtocolRuns, ...]
    references: Annotated[tuple[Reference, ...], described("What to cite; empty in reports of version 0.1.")] = ()

    @classmethod
    def stored(cls, content: Any) -> Self:
        """The document that was stored; raises InvalidInput if it is damaged."""
        try:
            return cls.read(content)
        except InvalidInput as error:
            raise InvalidInput(f"the stored result is damaged: {error.message}", "run the analysis again") from None


class PlotHead(Document):
    """One plot type of an analysis file."""

    place: Annotated[int, described("Its place in the file, from 1.")]
    form: Annotated[str, described("The plot type.")]
    title: str
    description: str
    text: Annotated[str, described("Markdown above the plot.")]
    error: Annotated[str | None, described("Why there is no result.")]


class Plot(PlotHead):
    """A plot type with everything that it has found."""

    result: PlotResult | None

    @property
    def charts(self) -> tuple[Chart, ...]:
        """Its plots."""
        return () if self.result is None else self.result.charts

    @property
    def tables(self) -> tuple[ResultTable, ...]:
        """Its tables and raw data."""
        return () if self.result is None else self.result.tables

    @property
    def notes(self) -> tuple[str, ...]:
        """Its remarks, one sentence each."""
        return () if self.result is None else self.result.notes

    @property
    def exclusions(self) -> list[str]:
        """The runs that it leaves out, one sentence for each reason."""
        excluded = () if self.result is None else self.result.excluded
        return [f"{len(entry.runs)} runs left out: {entry.reason}." for entry in excluded]


class Report(Summary):
    """A whole report."""

    forms: tuple[Plot, ...]
    source: Annotated[str, described("The analysis file.")]


class ShownTable(Document):
    """The first rows of a table."""

    table: ResultTable
    more: Annotated[int, described("Rows that are not shown; negative if there is room for more.")]
    numeric: Annotated[tuple[str, ...], described("Columns of numbers.")] = ()

    @property
    def rows(self) -> Sequence[Sequence[Cell]]:
        """The rows that are shown."""
        return self.table.rows


class RawData(Document):
    """A table that can be downloaded only."""

    key: str
    title: str
    rows: Annotated[int, described("How many it has.")]


class ShownPlot(PlotHead):
    """Description of a plot type for a page."""

    charts: tuple[Chart, ...]
    tables: tuple[ShownTable, ...]
    raw: tuple[RawData, ...] = ()
    notes: tuple[str, ...]
    runs: int | None
    failed: int | None


class ReportPage(Summary):
    """Content of a report's page. Its plots have no marks: those are in a file of their own."""

    source: str
    forms: tuple[ShownPlot, ...]
    files: Annotated[dict[str, tuple[int, str]], described("Place of the plot and key of plot or table, by file name.")]


class PlotBrief(Document):
    """True if the plot could be made."""

    place: int
    form: str
    title: str
    error: str | None
    charts: Annotated[int, described("How many plots it has.")]
    notes: Annotated[tuple[str, ...], described("What it has found, one sentence each.")] = ()


class ReportBrief(Summary):
    """A report without its plots."""

    source: str
    forms: tuple[PlotBrief, ...]
