"""One installation of SLAM Hive: opens it, connects its use cases, and closes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

from slamhive.errors import Conflict, Unavailable
from slamhive.foreign.numbers import Numbers
from slamhive.project import project_root
from slamhive.services.algorithms import AlgorithmImports
from slamhive.services.analyses import AnalysisJobs, StoredAnalyses
from slamhive.services.configurations import Configurations
from slamhive.services.data_root import DataRoot, open_data_root
from slamhive.services.datasets import Catalogue, DatasetChecks, DatasetViews, Variants, check_writable, stored_numbers
from slamhive.services.evaluations import Comparisons, CurrentProtocols, Evaluations, Protocols
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentContext, Experiments
from slamhive.services.imports import Imports
from slamhive.services.ledger import Ledger
from slamhive.services.run_comparison import RunComparisons
from slamhive.services.runs import Runs
from slamhive.services.searches import Searches
from slamhive.services.versions import Versions
from slamhive.services.worker import Worker, WorkerLock
from slamhive.settings import Mode, Settings
from slamhive.settings_sources import load_settings
from slamhive.store import Store

if TYPE_CHECKING:
    from slamhive.services.fetching import Fetching
    from slamhive.services.reports import Analyses


class Hive:
    """The use cases of one installation. They raise a SlamHiveError for every mistake that a user can make.

    Args:
        settings: In force.
        store: Open, with tables of this version.
        catalogue: Algorithms and datasets.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue) -> None:
        self.settings = settings
        self.store = store
        self.catalogue = catalogue
        self.ledger = Ledger(settings, store)
        if settings.mode is not Mode.VIEW_ONLY:
            store.listener = self.ledger.note
        self.executors = Executors(settings, catalogue.project_root, self.worker_alive)
        self.variants = Variants(settings, store)
        self.dataset_views = DatasetViews()
        self.dataset_checks = DatasetChecks(settings)
        self.searches = Searches(settings, store, catalogue)
        self.configurations = Configurations(settings, store, catalogue, self.variants)
        self.versions = Versions(settings, store, catalogue, self.executors)
        self.runs = Runs(settings, store, self.configurations, self.executors)
        self.protocols = Protocols(store)
        self.evaluations = Evaluations(settings, store, catalogue, self.protocols, self.executors.evaluation_runner)
        self.current_protocols = CurrentProtocols(store, self.evaluations, settings.runs_folder)
        self.comparisons = Comparisons(store, self.evaluations, settings.runs_folder)
        self.run_comparisons = RunComparisons(store, settings.runs_folder)
        self.experiments = Experiments(ExperimentContext(settings, store, catalogue, self.variants, self.executors))
        self.algorithms = AlgorithmImports(settings, catalogue, self.executors)
        self.imports = Imports(settings, store, catalogue)
        self.stored_analyses = StoredAnalyses(settings, store, lambda text: self.analyses.read(text).name)
        self.analysis_jobs = AnalysisJobs(settings, store, catalogue.project_root)

    @cached_property
    def analyses(self) -> Analyses:
        """Analysis files and reports; loaded on first use, because matplotlib, pandas and scipy take two seconds."""
        from slamhive.services.reports import Analyses  # noqa: PLC0415

        return Analyses(self.settings, self.store, self.catalogue, self.searches)

    @cached_property
    def fetching(self) -> Fetching:
        """Public sequences; loaded on first use, because few commands fetch."""
        from slamhive.services.fetching import Collections, Fetching  # noqa: PLC0415

        return Fetching(self.settings, self.catalogue, Collections(self.catalogue.project_root))

    def worker(self, only: Sequence[int] | None = None) -> Worker:
        """A worker of this installation, for all runs or for ``only`` these; its ``run`` does the work."""
        self.check_writable()
        return Worker(self.settings, self.store, self.catalogue, self.executors.get, self.evaluations, only)

    def worker_alive(self) -> bool:
        """Whether a worker of this data root is running on this machine."""
        return WorkerLock(self.settings.data).held_elsewhere()

    def numbers(self) -> Numbers:
        """The numbers of algorithms, datasets and experiments in the database."""
        return stored_numbers(self.store)

    def check_writable(self) -> None:
        """Raise Forbidden in view-only mode."""
        check_writable(self.settings)

    def close(self) -> None:
        """Close the database and the connections to engines."""
        self.executors.close()
        self.store.close()


def open_hive(options: Mapping[str, Any] | None = None, data_root: DataRoot = DataRoot.MADE) -> Hive:
    """Read the settings, open the database, and check that mode and data root can be used.

    Raises InvalidInput for wrong settings, and NotFound if something is missing that ``data_root`` requires. Raises
    Unavailable for a mode that does not exist yet, and if the data root or the database cannot be used.
    """
    root = project_root()
    settings = load_settings(root, options=options)
    if settings.mode in (Mode.CLUSTER, Mode.CLOUD):
        raise Unavailable(f"MODE={settings.mode} is not available yet", "use workstation or view-only")
    return Hive(settings, open_data_root(settings, data_root), Catalogue(settings, root))


def check_indexed(hive: Hive) -> None:
    """Raise Conflict if there is data but the database is empty: it was lost, and numbers would be used twice."""
    if sum(hive.runs.counts().values()) == 0:
        runs = hive.settings.runs_folder
        if any(entry.name.isdigit() for entry in runs.iterdir()):
            raise Conflict(f"{runs} holds runs that are missing from the database", "slamhive reindex files them")
    if hive.ledger.knows_more():
        raise Conflict(
            f"{hive.settings.ledger_folder} holds configurations or searches, but the database is empty",
            "slamhive reindex restores them",
        )
