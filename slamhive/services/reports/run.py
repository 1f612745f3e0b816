"""Compute an analysis: select runs, load their table once, build each plot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from slamhive.analysis.analysis_file import PROTOCOL, Analysis, PlotRequest
from slamhive.analysis.plot_types import PlotData, one_value
from slamhive.analysis.result import PlotResult
from slamhive.analysis.table import RunTable
from slamhive.clock import monotonic_s
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.services.reports.files import StoredRunFiles
from slamhive.services.reports.offered import spread_over
from slamhive.services.reports.selection import Find, select_runs
from slamhive.services.reports.table import TableRequest, check_size, load_every_protocol, load_table
from slamhive.settings import Settings
from slamhive.store import Store


@dataclass(frozen=True, slots=True)
class AnalysisLimits:
    """Resource limits of one analysis. With ``sample``, only so many of its runs are read, evenly spaced."""

    runs: int
    time_s: float
    sample: int | None = None


@dataclass(frozen=True, slots=True)
class AnalysisSources:
    """Data sources of an analysis: filters, saved searches, sensors of algorithms, datasets by name."""

    settings: Settings
    store: Store
    find: Find
    saved_search: Callable[[str], str]
    sensors: Mapping[str, str]
    datasets: Mapping[str, Dataset]


@dataclass(frozen=True, slots=True)
class PlotOutcome:
    """The result of one plot, or the reason why it could not be made, in one line."""

    request: PlotRequest
    result: PlotResult | None
    error: str | None

    @property
    def title(self) -> str:
        """The title in the file, or the default of the plot type."""
        return self.request.options.title or self.request.plot_type.title


@dataclass(frozen=True, slots=True)
class AnalysisOutcome:
    """The result of an analysis."""

    analysis: Analysis
    table: RunTable
    plots: tuple[PlotOutcome, ...]

    @property
    def failed_runs(self) -> int:
        """The number of selected runs that count as failed."""
        return len(self.table.failed())

    @property
    def complete(self) -> bool:
        """Whether every plot could be made."""
        return all(plot.error is None for plot in self.plots)


def run_analysis(
    analysis: Analysis,
    sources: AnalysisSources,
    limits: AnalysisLimits,
    progress: Callable[[float, str], None] = lambda _fraction, _doing: None,
) -> AnalysisOutcome:
    """Select, load, build. A plot that does not fit the data reports that; the others are not affected.

    Raises:
        InvalidInput, NotFound: the selection is empty, too large, or names something unknown.
    """
    deadline_s = monotonic_s() + limits.time_s
    progress(0.0, "selecting runs")
    run_ids = select_runs(analysis, sources.store, sources.find, sources.saved_search)
    check_size(run_ids, limits.runs)
    if limits.sample is not None:
        run_ids = spread_over(run_ids, limits.sample)
    progress(0.05, f"reading {len(run_ids)} runs")
    keys = {key for request in analysis.plots for key in request.plot_type.needs(request.options)}
    asked = TableRequest(run_ids, keys, analysis.protocol, analysis.rule, analysis.exclude_disturbed)
    try:
        table = load_table(sources.store, asked, sources.sensors, sources.datasets)
    except NotFound as error:
        raise analysis.placed(PROTOCOL, error) from None
    for key in analysis.one:
        one_value(table, key, "the analysis")
    compared = [request for request in analysis.plots if request.plot_type.all_protocols]
    compared_keys = {key for request in compared for key in request.plot_type.needs(request.options)}
    every = load_every_protocol(sources.store, compared_keys, run_ids)
    pairs = zip(table.frame["run_id"].tolist(), table.frame["protocol"].tolist(), strict=True)
    protocols = {run: fingerprint for run, fingerprint in pairs if isinstance(fingerprint, str)}  # pandas: None is NaN
    files = StoredRunFiles(sources.settings.runs_folder, protocols)
    outcomes = []
    for place, request in enumerate(analysis.plots):
        share = 0.9 / len(analysis.plots)

        def tell(fraction: float, place: int = place, request: PlotRequest = request, share: float = share) -> None:
            if monotonic_s() > deadline_s:
                raise InvalidInput(f"the analysis takes longer than {limits.time_s:g} s", "select fewer runs")
            progress(0.1 + share * (place + fraction), request.plot_type.title)

        outcomes.append(_build(request, PlotData(table, every, files, tell)))
    progress(1.0, "done")
    return AnalysisOutcome(analysis, table, tuple(outcomes))


def _build(request: PlotRequest, data: PlotData) -> PlotOutcome:
    try:
        data.progress(0.0)
        return PlotOutcome(request, request.plot_type.build(data, request.options), None)
    except SlamHiveError as error:
        return PlotOutcome(request, None, f"{request.place}: {error}")
