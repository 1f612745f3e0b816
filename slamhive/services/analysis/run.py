"""Read analysis files and compute them: select runs, load their table once, build each plot."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamhive.analysis.analysis_file import PROTOCOL, Analysis, PlotRequest, parse_analysis, set_words
from slamhive.analysis.analysis_model import SetModel, evaluate, names_in
from slamhive.analysis.chart import THUMBNAIL
from slamhive.analysis.plot_types import PlotData, one_value
from slamhive.analysis.print_chart import print_chart
from slamhive.analysis.report import DisturbedRuns, Plot, PlotResult, ProtocolRuns, Report
from slamhive.analysis.table import FAILED, Column, ColumnKind, RunTable, metric_column
from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.base.settings import Settings
from slamhive.base.strict_yaml import read_text
from slamhive.domain.bibliography import Reference
from slamhive.domain.dataset import ATTRIBUTE_KINDS, Dataset
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.names import plural
from slamhive.domain.protocol import TrajectoryKind, with_trajectory
from slamhive.packages.published.combination import is_combination
from slamhive.services.analysis.table import (
    StoredRunFiles,
    TableRequest,
    check_columns,
    check_size,
    load_every_protocol,
    load_table,
)
from slamhive.services.citations import Citations
from slamhive.services.datasets import Catalogue, stored_numbers
from slamhive.services.searches import Searches
from slamhive.store import Store, Transaction

if TYPE_CHECKING:
    import pandas as pd

# Selecting runs: look up each set in the store, then evaluate the expression.

Find = Callable[[str], Sequence[int]]
"""Returns the runs that match a filter."""


def select_runs(analysis: Analysis, store: Store, find: Find, saved: Callable[[str], str]) -> tuple[int, ...]:
    """The ids of the selected runs, in order.

    Args:
        analysis: Defines the selection.
        store: For experiments, groups and configurations.
        find: Finds the runs of a filter.
        saved: Finds the filter of a saved search.

    Raises:
        InvalidInput: a filter is invalid, or nothing is selected.
        NotFound: an experiment, saved search, group or run does not exist.
    """

    def members(name: str) -> frozenset[int]:
        try:
            return frozenset(_members(analysis.sets[name], store, find, saved))
        except SlamHiveError as error:
            raise analysis.placed(name, error) from None

    sets = {name: members(name) for name in names_in(analysis.use)}
    chosen = evaluate(analysis.use, lambda name: sets[name])
    if not chosen:
        sizes = ", ".join(f"{name} holds {len(sets[name])} ({set_words(analysis.sets[name])})" for name in sorted(sets))
        raise InvalidInput(f"the selection holds no run: {sizes}", "select more, or run the experiment first")
    return tuple(sorted(chosen))


def _members(chosen: SetModel, store: Store, find: Find, saved: Callable[[str], str]) -> Sequence[int]:
    if chosen.where is not None:
        return find(chosen.where)
    if chosen.search is not None:
        return find(saved(chosen.search))
    return store.read(lambda transaction: _listed(chosen, transaction))


def _listed(chosen: SetModel, transaction: Transaction) -> Sequence[int]:
    if chosen.experiment is not None:
        return transaction.run_table.runs_of_experiment(chosen.experiment)
    if chosen.group is not None:
        return transaction.run_table.runs_of_group(chosen.group)
    if chosen.configurations is not None:
        return transaction.run_table.runs_of_configurations(chosen.configurations)
    wanted = chosen.runs or []
    missing = set(wanted) - transaction.run_table.existing(wanted)
    if missing:
        shown = ", ".join(map(str, sorted(missing)[:8])) + (", ..." if len(missing) > 8 else "")
        raise NotFound(f"unknown runs {shown}", "list runs that exist")
    return wanted


# Small pictures for the page on which an analysis is written.


def previews_of(report: Report) -> list[dict[str, Any]]:
    """For each plot, its first picture as PNG in base64, or what there is in place of one."""
    return [_preview(plot) for plot in report.forms]


def _preview(plot: Plot) -> dict[str, Any]:
    image, note = None, plot.error or ""
    if plot.result is not None and plot.result.charts:
        image = base64.b64encode(print_chart(plot.result.charts[0], THUMBNAIL)).decode()
        more = len(plot.result.charts) - 1
        note = f"and {plural(more, 'more plot')}" if more else ""
    elif plot.result is not None:
        tables = [table for table in plot.result.tables if not table.raw]
        note = ", ".join(f"{table.title}: {plural(len(table.rows), 'row')}" for table in tables) or "a table"
    return {"form": plot.form, "title": plot.title, "image": image, "note": note}


# Axes that a person chooses from while writing an analysis.

MOST_LOOKED_AT = 200
"""Runs that are looked at, spread over all that are selected."""


@dataclass(frozen=True, slots=True)
class OfferedColumns:
    """Of ``looked_at`` of the ``runs``: metrics with values, and numbers and groups that differ among them."""

    runs: int = 0
    looked_at: int = 0
    metrics: tuple[Column, ...] = ()
    numbers: tuple[Column, ...] = ()
    groups: tuple[Column, ...] = ()


def spread_over(run_ids: Sequence[int], most: int = MOST_LOOKED_AT) -> tuple[int, ...]:
    """At most ``most`` of the runs, evenly spaced, so that they hold more than the first configuration."""
    return tuple(run_ids[:: -(-len(run_ids) // most)]) if run_ids else ()


def offered_columns(table: RunTable, measured: Sequence[str], runs: int) -> OfferedColumns:
    """From the table of the runs that are looked at, and the keys of ``measured`` metrics."""
    varied = [column for column in table.varied() if column.kind is not ColumnKind.METRIC]
    attributes = {kind.name for kind in ATTRIBUTE_KINDS}
    words = [table.columns[key] for key in ("dataset", *attributes) if key in table.columns and _differs(table, key)]
    return OfferedColumns(
        runs=runs,
        looked_at=len(table.frame),
        metrics=tuple(metric_column(key) for key in CATALOGUE if key in measured),
        numbers=tuple(column for column in varied if column.numeric),
        groups=tuple(dict.fromkeys([*words, *(column for column in varied if column.key != "algorithm")])),
    )


def _differs(table: RunTable, key: str) -> bool:
    return key == "dataset" or table.frame[key].nunique() > 1


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
        """True if every plot could be made."""
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

        try:
            tell(0.0)
            found = request.plot_type.build(PlotData(table, every, files, tell), request.options)
            outcomes.append(PlotOutcome(request, found, None))
        except SlamHiveError as error:
            outcomes.append(PlotOutcome(request, None, f"{request.place}: {error}"))
    progress(1.0, "done")
    return AnalysisOutcome(analysis, table, tuple(outcomes))


# Building the report, from which pages and files are made.

SHOWN_ROWS = 200
"""Rows of a table on a page of the server; the CSV file has all rows."""

WHOLE_ROWS = 5_000
"""Rows of a table in a page that is a file. Tables that are shown are summaries, with fewer rows than this."""


def make_report(outcome: AnalysisOutcome, now: datetime, references: tuple[Reference, ...] = ()) -> Report:
    """The whole report, with plots and raw data, computed at ``now``; ``references`` are what to cite for it."""
    analysis, table = outcome.analysis, outcome.table
    reasons = Counter(table.failed()[FAILED])
    protocols = table.frame.dropna(subset=["protocol"]).groupby("protocol", sort=True)
    return Report(
        name=analysis.name,
        text=analysis.text,
        made_at=now,
        selection=analysis.selection_words,
        sets={name: set_words(chosen) for name, chosen in sorted(analysis.sets.items())},
        runs=len(table.frame),
        configurations=int(table.frame["configuration_id"].nunique()),
        algorithms=tuple(sorted(table.frame["algorithm"].unique())),
        datasets=tuple(sorted(table.frame["dataset"].unique())),
        failed=outcome.failed_runs,
        failed_because=dict(sorted(reasons.items())),
        unevaluated=table.not_evaluated,
        disturbance=DisturbedRuns(
            disturbed=len(table.disturbed()),
            unknown=int(table.frame["disturbed"].isna().sum()),
            left_out=table.without_disturbed,
        ),
        mixed_versions=table.mixed_versions,
        mixed_trajectories=table.mixed_trajectories,
        mixed_protocols=None if table.mixed_protocols is None else table.mixed_protocols.sentences,
        mixed_cpus=table.mixed_cpus,
        rule=table.rule_words,
        protocols=tuple(
            ProtocolRuns(fingerprint=str(name), label=_label(rows), runs=len(rows)) for name, rows in protocols
        ),
        references=references,
        forms=tuple(_plot(plot, place) for place, plot in enumerate(outcome.plots, start=1)),
        source=analysis.source,
    )


def _label(rows: pd.DataFrame) -> str:
    """The label of the protocol of runs; it names the kind of their trajectories if all have one."""
    kinds = set(rows["trajectory"].dropna()) if rows["trajectory"].notna().all() else set()
    return with_trajectory(str(rows["protocol_label"].iloc[0]), TrajectoryKind(*kinds) if len(kinds) == 1 else None)


def _plot(plot: PlotOutcome, place: int) -> Plot:
    return Plot(
        place=place,
        form=plot.request.plot_type.key,
        title=plot.title,
        description=plot.request.plot_type.description,
        text=plot.request.options.text,
        error=plot.error,
        result=plot.result,
    )


def file_name(place: int, key: str, ending: str) -> str:
    """``03_scatter_ate.rmse.pdf``: files are numbered in the order of the plots."""
    return f"{place:02d}_{key}.{ending}"


# -- read analysis files and compute reports, for command line, worker and pages ---------------------------------------


MAX_SOURCE_BYTES = 1_000_000


class AnalysisService:
    """Reads analysis files and computes reports.

    Args:
        settings: In force.
        store: The database.
        catalogue: Algorithms, with their sensors.
        searches: Filters and saved searches.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue, searches: Searches) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._searches = searches
        self._citations = Citations(store, catalogue)

    def read(self, text: str, source: str = "analysis.yaml", ids: Mapping[str, str] | None = None) -> Analysis:
        """Parse an analysis file of this or of the published SLAM Hive; raises InvalidInput with the line.

        ``ids`` says what numbers in a published file mean, see :func:`slamhive.packages.published.combination.meant`.
        """
        if len(text.encode()) > MAX_SOURCE_BYTES:
            raise InvalidInput(f"{source} is larger than {MAX_SOURCE_BYTES} bytes", "split it into several analyses")
        try:
            return parse_analysis(text, source, stored_numbers(self._store), ids)
        except InvalidInput:
            if not is_combination(text):
                raise
            raise InvalidInput(
                f"{source} is a combination file of the published SLAM Hive, not an analysis",
                f"make an experiment of it: slamhive experiment convert {source}",
            ) from None

    def check(self, text: str) -> str:
        """The name in an analysis file that can be computed here; raises as :meth:`read`, and for unknown columns."""
        analysis = self.read(text)
        # A name in the file of a stored experiment may be one of its axes.
        store = self._store
        check_columns(
            analysis, self._searches.vocabulary(), lambda name: store.read(lambda t: t.experiments.mention(name))
        )
        return analysis.name

    def mixed_runs(self, text: str) -> tuple[int, ...]:
        """The runs of an analysis that takes the current errors of each run; none if it names a protocol.

        Raises as :meth:`read` and :meth:`compute`.
        """
        analysis = self.read(text)
        return () if analysis.protocol is not None else self._selected(analysis)

    def read_file(self, path: Path, ids: Mapping[str, str] | None = None) -> Analysis:
        """The same from a file."""
        return self.read(read_text(path), str(path), ids)

    def compute(
        self,
        analysis: Analysis,
        limits: AnalysisLimits,
        progress: Callable[[float, str], None] = lambda _share, _doing: None,
    ) -> Report:
        """Compute the report; raises InvalidInput or NotFound for an invalid selection."""
        outcome = run_analysis(analysis, self._sources(), limits, progress)
        names = outcome.table.frame["algorithm"], outcome.table.frame["dataset"]
        return make_report(outcome, utc_now(), self._citations.of_names(*names))

    def offered(self, text: str) -> OfferedColumns:
        """List the axes over which the selected runs can be drawn; nothing while none is evaluated.

        Raises as :meth:`read` and :meth:`compute`.
        """
        analysis = self.read(text)
        run_ids = self._selected(analysis)
        seen = spread_over(run_ids)
        found = self._store.read(lambda t: t.metrics.for_runs(seen))
        measured = {key for values in found.values() for key in values}
        sources = self._sources()
        asked = TableRequest(seen, (), analysis.protocol, analysis.rule, analysis.exclude_disturbed)
        try:
            table = load_table(self._store, asked, sources.sensors, sources.datasets)
        except InvalidInput:
            return OfferedColumns(runs=len(run_ids))
        return offered_columns(table, sorted(measured), len(run_ids))

    def references(self, analysis: Analysis) -> tuple[Reference, ...]:
        """List the works to cite for the runs that an analysis selects now; raises as :meth:`compute`."""
        return self._citations.of_runs(self._selected(analysis))

    def fingerprint(self, analysis: Analysis) -> str:
        """Identifies the selected runs and their metrics; raises as :meth:`compute`."""
        run_ids = self._selected(analysis)
        return self._store.read(lambda t: t.analyses.fingerprint(run_ids))

    def _sources(self) -> AnalysisSources:
        return AnalysisSources(
            settings=self._settings,
            store=self._store,
            find=self._searches.find,
            saved_search=self._saved_search,
            sensors={entry.name: entry.setup.value for entry in self._catalogue.algorithms()},
            datasets={entry.name: entry for entry in self._catalogue.datasets()},
        )

    def _selected(self, analysis: Analysis) -> tuple[int, ...]:
        return select_runs(analysis, self._store, self._searches.find, self._saved_search)

    def _saved_search(self, name: str) -> str:
        return self._searches.saved_named(name).filter_text
