"""Read analysis files and compute reports, for command line, worker and pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from slamhive.analysis.analysis_file import Analysis, parse_analysis
from slamhive.analysis.report import Report
from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput
from slamhive.base.settings import Settings
from slamhive.base.strict_yaml import read_text
from slamhive.domain.bibliography import Reference
from slamhive.packages.published.combination import is_combination
from slamhive.services.analysis.run import (
    AnalysisLimits,
    AnalysisSources,
    OfferedColumns,
    make_report,
    offered_columns,
    run_analysis,
    select_runs,
    spread_over,
)
from slamhive.services.analysis.table import TableRequest, check_columns, load_table
from slamhive.services.citations import Citations
from slamhive.services.datasets import Catalogue, stored_numbers
from slamhive.services.searches import Searches
from slamhive.store import Store

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
