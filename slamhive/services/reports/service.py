"""Read analysis files and compute reports, for command line, worker and pages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slamhive.analysis.analysis_file import Analysis, parse_analysis
from slamhive.analysis.paper_file import PaperNames
from slamhive.analysis.report import Report
from slamhive.clock import utc_now
from slamhive.errors import InvalidInput
from slamhive.services.datasets import Catalogue
from slamhive.services.reports.report import make_report
from slamhive.services.reports.run import AnalysisLimits, AnalysisSources, run_analysis
from slamhive.services.reports.selection import select_runs
from slamhive.services.searches import Searches
from slamhive.settings import Settings
from slamhive.store import Store, Transaction
from slamhive.strict_yaml import read_text

MAX_SOURCE_BYTES = 1_000_000


class Analyses:
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

    def read(self, text: str, source: str = "analysis.yaml") -> Analysis:
        """Parse an analysis file of this or of the published SLAM Hive; raises InvalidInput with the line."""
        if len(text.encode()) > MAX_SOURCE_BYTES:
            raise InvalidInput(f"{source} is larger than {MAX_SOURCE_BYTES} bytes", "split it into several analyses")
        return parse_analysis(text, source, self._store.read(_paper_names))

    def read_file(self, path: Path) -> Analysis:
        """The same from a file."""
        return self.read(read_text(path), str(path))

    def compute(
        self,
        analysis: Analysis,
        limits: AnalysisLimits,
        progress: Callable[[float, str], None] = lambda _share, _doing: None,
    ) -> Report:
        """Compute the report; raises InvalidInput or NotFound for an invalid selection."""
        sources = AnalysisSources(
            settings=self._settings,
            store=self._store,
            find=self._searches.find,
            saved_search=self._saved_search,
            sensors={entry.name: entry.setup.value for entry in self._catalogue.algorithms()},
            attributes={entry.name: entry.attributes for entry in self._catalogue.datasets()},
        )
        return make_report(run_analysis(analysis, sources, limits, progress), utc_now())

    def fingerprint(self, analysis: Analysis) -> str:
        """Identifies the selected runs and their metrics; raises as :meth:`compute`."""
        run_ids = select_runs(analysis, self._store, self._searches.find, self._saved_search)
        return self._store.read(lambda t: t.analyses.fingerprint(run_ids))

    def _saved_search(self, name: str) -> str:
        return self._searches.saved_named(name).filter_text


def _paper_names(transaction: Transaction) -> PaperNames:
    return PaperNames(
        algorithms={record.id: record.name for record in transaction.catalogue.algorithms()},
        datasets={record.id: record.name for record in transaction.catalogue.datasets()},
        experiments=transaction.run_table.experiment_names(),
    )
