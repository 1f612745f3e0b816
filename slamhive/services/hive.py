"""One installation of SLAM Hive: opens it, connects its use cases, and closes it.

A use case is imported and made on first use: a command loads only what it needs.
"""

# ruff: noqa: PLC0415

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamhive.base.errors import Conflict
from slamhive.base.project import project_root
from slamhive.base.settings import ExecutorOption, Mode, Settings
from slamhive.base.settings_sources import load_settings
from slamhive.services.data_root import DataRoot, open_data_root

if TYPE_CHECKING:
    from slamhive.packages.published.knowledge import Numbers
    from slamhive.services.accounts import Accounts
    from slamhive.services.algorithms import AlgorithmImports
    from slamhive.services.analysis import AnalysisService
    from slamhive.services.challenges import ChallengeJudge, ChallengeService, ImageWork
    from slamhive.services.citations import Citations
    from slamhive.services.claims import Claims
    from slamhive.services.clouds import Clouds
    from slamhive.services.configurations import Configurations
    from slamhive.services.datasets import Catalogue, DatasetChecks, DatasetViews, TruthTrials, VariantService
    from slamhive.services.deciding import Questions
    from slamhive.services.evaluations import (
        Comparisons,
        CurrentProtocols,
        Evaluations,
        ProtocolSearches,
        ProtocolService,
    )
    from slamhive.services.executors import Executors
    from slamhive.services.experiments import ExperimentService
    from slamhive.services.fetching import Fetching
    from slamhive.services.gates import Bisections, Gates, Shrinkings
    from slamhive.services.imports import Imports
    from slamhive.services.kept_answers import KeptAnswers
    from slamhive.services.ledger import Ledger
    from slamhive.services.nodes import Nodes
    from slamhive.services.replay import Replays
    from slamhive.services.run_comparison import RunComparisons
    from slamhive.services.runs import MapViews, Notes, RunService, StoredRuns
    from slamhive.services.search_actions import SearchActions
    from slamhive.services.searches import Searches
    from slamhive.services.sharing import Sharings
    from slamhive.services.stored_analyses import (
        AnalysisComputer,
        AnalysisFiles,
        AnalysisJobs,
        AnalysisPreviews,
        StoredAnalyses,
    )
    from slamhive.services.trash import Trash
    from slamhive.services.uploads import UploadImports, UploadService
    from slamhive.services.versions import Versions
    from slamhive.services.worker import Worker
    from slamhive.store import Store
    from slamhive.store.changes import Changes


class Hive:
    """The use cases of one installation. They raise a SlamHiveError for every mistake that a user can make.

    Args:
        settings: In force.
        store: Open, with tables of this version.
        project_root: The project folder, which holds the algorithms.
    """

    def __init__(self, settings: Settings, store: Store, project_root: Path) -> None:
        self.settings = settings
        self.store = store
        self.project_root = project_root
        if settings.mode is not Mode.VIEW_ONLY:
            store.listener = self._note

    @cached_property
    def catalogue(self) -> Catalogue:
        """Algorithms and datasets."""
        from slamhive.services.datasets import Catalogue

        return Catalogue(self.settings, self.project_root)

    @cached_property
    def accounts(self) -> Accounts:
        """Accounts of the web server."""
        from slamhive.services.accounts import Accounts

        return Accounts(self.store)

    @cached_property
    def ledger(self) -> Ledger:
        """The file copy of what the database alone knows."""
        from slamhive.services.ledger import Ledger

        return Ledger(self.settings, self.store)

    @cached_property
    def executors(self) -> Executors:
        """Executors of runs."""
        from slamhive.services.executors import Executors

        return Executors(self.settings, self.project_root, self.worker_alive)

    @cached_property
    def variants(self) -> VariantService:
        """Variants of datasets."""
        from slamhive.services.datasets import VariantService

        return VariantService(self.settings, self.store)

    @cached_property
    def dataset_views(self) -> DatasetViews:
        """Images, sweeps and motion of datasets."""
        from slamhive.services.datasets import DatasetViews

        return DatasetViews()

    @cached_property
    def map_views(self) -> MapViews:
        """Points of saved maps."""
        from slamhive.services.runs import MapViews

        return MapViews()

    @cached_property
    def dataset_checks(self) -> DatasetChecks:
        """Checks of datasets."""
        from slamhive.services.datasets import DatasetChecks

        return DatasetChecks(self.settings)

    @cached_property
    def truth_trials(self) -> TruthTrials:
        """Ground truths against the systems that agree with each other."""
        from slamhive.services.datasets import TruthTrials

        return TruthTrials(self.settings, self.store, self.catalogue)

    @cached_property
    def searches(self) -> Searches:
        """Filters, groups and saved searches."""
        from slamhive.services.searches import Searches

        return Searches(self.settings, self.store, self.catalogue)

    @cached_property
    def configurations(self) -> Configurations:
        """Algorithm versions that runs execute."""
        from slamhive.services.configurations import Configurations

        return Configurations(self.settings, self.store, self.catalogue, self.variants)

    @cached_property
    def versions(self) -> Versions:
        """Kept versions of packages."""
        from slamhive.services.versions import Versions

        return Versions(self.settings, self.store, self.catalogue, self.executors)

    @cached_property
    def stored_runs(self) -> StoredRuns:
        """Runs, to read only. Loads a fraction of what :attr:`runs` loads."""
        from slamhive.services.runs import StoredRuns

        return StoredRuns(self.settings, self.store)

    @cached_property
    def runs(self) -> RunService:
        """Runs, to read and to change."""
        from slamhive.services.runs import RunService

        return RunService(self.settings, self.store, self.configurations, self.executors)

    @cached_property
    def sharings(self) -> Sharings:
        """Owners of runs, experiments and analyses, and who may see them."""
        from slamhive.services.sharing import Sharings

        return Sharings(self.settings, self.store)

    @cached_property
    def notes(self) -> Notes:
        """Notes and tags of runs."""
        from slamhive.services.runs import Notes

        return Notes(self.settings, self.store)

    @cached_property
    def protocols(self) -> ProtocolService:
        """Protocols that evaluations use."""
        from slamhive.services.evaluations import ProtocolService

        return ProtocolService(self.store)

    @cached_property
    def protocol_searches(self) -> ProtocolSearches:
        """Protocols that give a number which a paper prints."""
        from slamhive.services.evaluations import ProtocolSearches

        return ProtocolSearches(self.settings, self.store, self.catalogue, self.evaluations)

    @cached_property
    def evaluations(self) -> Evaluations:
        """The queue of evaluations, and their results."""
        from slamhive.services.evaluations import Evaluations

        return Evaluations(self.settings, self.store, self.catalogue, self.protocols, self.executors.evaluation_runner)

    @cached_property
    def current_protocols(self) -> CurrentProtocols:
        """The protocol whose metrics are shown."""
        from slamhive.services.evaluations import CurrentProtocols

        return CurrentProtocols(self.settings, self.store, self.evaluations)

    @cached_property
    def run_comparisons(self) -> RunComparisons:
        """Runs side by side."""
        from slamhive.services.run_comparison import RunComparisons

        return RunComparisons(self.store, self.settings.runs_folder)

    @cached_property
    def gates(self) -> Gates:
        """Baselines, and whether runs became worse than those."""
        from slamhive.services.gates import Gates

        return Gates(self.settings, self.store, self.searches, self.catalogue, self.configurations, self.runs)

    @cached_property
    def claims(self) -> Claims:
        """Claims of papers, and whether they hold here."""
        from slamhive.services.claims import Claims, ClaimTools

        tools = ClaimTools(
            self.searches,
            self.catalogue,
            self.configurations,
            self.runs,
            self.evaluations,
            self.protocols,
            self.protocol_searches,
            self.fetching.collections,
        )
        return Claims(self.settings, self.store, tools)

    @cached_property
    def bisections(self) -> Bisections:
        """Searches for the commit that made runs worse."""
        from slamhive.services.gates import Bisections

        return Bisections(self.settings, self.catalogue, self.executors, self.versions, self.gates)

    @cached_property
    def shrinkings(self) -> Shrinkings:
        """Searches for the shortest part of a recording that shows what is wrong with a run."""
        from slamhive.services.gates import Shrinkings

        return Shrinkings(self.settings, self.catalogue, self.configurations, self.runs, self.gates)

    @cached_property
    def challenges(self) -> ChallengeService:
        """Challenges with secret ground truth, to submit to and to look at."""
        from slamhive.services.challenges import ChallengeService

        return ChallengeService(self.settings)

    @cached_property
    def challenge_judge(self) -> ChallengeJudge:
        """Evaluation of submissions to challenges."""
        from slamhive.services.challenges import ChallengeJudge

        return ChallengeJudge(self.settings, self.evaluations)

    @cached_property
    def challenge_images(self) -> ImageWork:
        """Runs of images that were submitted to challenges."""
        from slamhive.services.challenges import ImageWork

        return ImageWork(self.settings, self._installation_below)

    def _installation_below(self, data: Path) -> Hive:
        """The installation of one submitted image, with the settings of this one. It sends no notices."""
        alone = {"data": data, "database_url": "", "worker_slots": 1, "notify_webhook": "", "notify_mail_to": ""}
        settings = self.settings.with_values(alone)
        return Hive(settings, open_data_root(settings, DataRoot.MADE), self.project_root)

    @cached_property
    def replays(self) -> Replays:
        """Runs of bundles, repeated and compared."""
        from slamhive.services.replay import Replays

        return Replays(self.settings, self.store, self.catalogue, self.runs, self.versions, self.executors)

    @cached_property
    def comparisons(self) -> Comparisons:
        """Metrics of runs under several protocols."""
        from slamhive.services.evaluations import Comparisons

        return Comparisons(self.store, self.evaluations, self.settings.runs_folder)

    @cached_property
    def experiments(self) -> ExperimentService:
        """Experiments."""
        from slamhive.services.experiments import ExperimentContext, ExperimentService

        return ExperimentService(
            ExperimentContext(self.settings, self.store, self.catalogue, lambda: self.variants, lambda: self.executors)
        )

    @cached_property
    def questions(self) -> Questions:
        """Experiments that choose their runs."""
        from slamhive.services.deciding import Questions

        return Questions(self.settings, self.store, self.experiments)

    @cached_property
    def algorithms(self) -> AlgorithmImports:
        """Import of algorithm packages."""
        from slamhive.services.algorithms import AlgorithmImports

        return AlgorithmImports(self.settings, self.catalogue, self.executors)

    @cached_property
    def imports(self) -> Imports:
        """Import of trajectories."""
        from slamhive.services.imports import Imports

        return Imports(self.settings, self.store, self.catalogue)

    @cached_property
    def stored_analyses(self) -> StoredAnalyses:
        """Stored analyses."""
        from slamhive.services.stored_analyses import StoredAnalyses

        return StoredAnalyses(self.settings, self.store, lambda text: self.analyses.check(text))  # noqa: PLW0108 - loads analyses late

    @cached_property
    def analysis_jobs(self) -> AnalysisJobs:
        """The queue of analyses."""
        from slamhive.services.stored_analyses import AnalysisJobs

        return AnalysisJobs(self.settings, self.store, self.project_root)

    @cached_property
    def analysis_files(self) -> AnalysisFiles:
        """The files of stored analyses."""
        from slamhive.services.stored_analyses import AnalysisFiles

        return AnalysisFiles(self.stored_analyses, self.project_root)

    def analysis_computer(self) -> AnalysisComputer:
        """A thread that computes analyses; the caller closes it."""
        from slamhive.services.stored_analyses import AnalysisComputer

        return AnalysisComputer(self.store, self.analysis_jobs)

    @cached_property
    def analysis_previews(self) -> AnalysisPreviews:
        """Previews of analyses that are being written."""
        from slamhive.services.stored_analyses import AnalysisPreviews

        return AnalysisPreviews(self.settings, self.store, self.project_root, self.stored_analyses.check)

    @cached_property
    def analyses(self) -> AnalysisService:
        """Analysis files and reports; loaded on first use, because matplotlib, pandas and scipy take two seconds."""
        from slamhive.services.analysis import AnalysisService

        return AnalysisService(self.settings, self.store, self.catalogue, self.searches)

    @cached_property
    def citations(self) -> Citations:
        """Works to cite for runs."""
        from slamhive.services.citations import Citations

        return Citations(self.store, self.catalogue)

    @cached_property
    def clouds(self) -> Clouds:
        """Rented machines."""
        from slamhive.services.clouds import Clouds

        return Clouds(self.settings, self.catalogue, lambda: self.experiments)

    @cached_property
    def fetching(self) -> Fetching:
        """Public sequences; loaded on first use, because few commands fetch."""
        from slamhive.services.fetching import Collections, Fetching

        return Fetching(self.settings, self.catalogue, Collections(self.catalogue.project_root))

    @cached_property
    def trash(self) -> Trash:
        """Deleted runs."""
        from slamhive.services.trash import Trash

        return Trash(self.settings, self.store, self.catalogue, self.ledger)

    @cached_property
    def search_actions(self) -> SearchActions:
        """Actions on all runs of a search."""
        from slamhive.services.search_actions import SearchActions

        return SearchActions(self.store, self.runs, self.evaluations, self.notes, self.sharings, self.trash)

    @cached_property
    def kept_answers(self) -> KeptAnswers:
        """Answers to changes that programs may ask for twice."""
        from slamhive.services.kept_answers import KeptAnswers

        return KeptAnswers(self.settings.answers_folder)

    @cached_property
    def uploads(self) -> UploadService:
        """Files that programs send."""
        from slamhive.services.uploads import UploadService

        return UploadService(self.settings)

    @cached_property
    def upload_imports(self) -> UploadImports:
        """Datasets, runs and algorithms from those files."""
        from slamhive.services.uploads import UploadImports

        return UploadImports(
            self.uploads, self.catalogue, self.imports, self.evaluations, self.algorithms, self.versions, self.executors
        )

    @cached_property
    def nodes(self) -> Nodes:
        """The machines that execute runs."""
        from slamhive.services.nodes import Nodes

        return Nodes(self.settings, self.store, self.executors, self.experiments, self.worker_alive)

    def worker(self, only: Sequence[int] | None = None) -> Worker:
        """A worker of this installation, for all runs or for ``only`` these; its ``run`` does the work."""
        from slamhive.services.worker import Chores, Worker

        self.check_writable()
        chores = Chores(self.analysis_jobs, self.challenge_images, self.challenge_judge, self.questions)
        work = chores if only is None else only
        return Worker(self.settings, self.store, self.catalogue, self.executors.get, self.evaluations, work)

    def worker_alive(self) -> bool:
        """Tell if a worker of this data root is running on this machine."""
        from slamhive.services.worker import WorkerLock

        return WorkerLock(self.settings.data).held_elsewhere()

    def numbers(self) -> Numbers:
        """The numbers of algorithms, datasets and experiments in the database."""
        from slamhive.services.datasets import stored_numbers

        return stored_numbers(self.store)

    def check_writable(self) -> None:
        """Raise Forbidden in view-only mode."""
        from slamhive.services.datasets import check_writable

        check_writable(self.settings)

    def _note(self, changes: Changes) -> None:
        self.ledger.note(changes)

    def close(self) -> None:
        """Close the database and the connections to engines."""
        if "executors" in vars(self):  # making them only to close them would load the Docker SDK
            self.executors.close()
        self.store.close()


def open_hive(options: Mapping[str, Any] | None = None, data_root: DataRoot = DataRoot.MADE) -> Hive:
    """Read the settings, open the database, and check that the data root can be used.

    Raises InvalidInput for wrong settings, and NotFound if something is missing that ``data_root`` requires. Raises
    Unavailable if the data root or the database cannot be used.
    """
    root = project_root()
    settings = load_settings(root, options=options, further=_declared_by_executors)
    return Hive(settings, open_data_root(settings, data_root), root)


def _declared_by_executors() -> Sequence[ExecutorOption]:
    from slamhive.executors.registry import declared_settings

    return declared_settings()


def check_indexed(hive: Hive) -> None:
    """Raise Conflict if there is data but the database is empty: it was lost, and numbers would be used twice."""
    if any(hive.stored_runs.counts().values()):
        return
    runs = hive.settings.runs_folder
    if runs.is_dir() and any(entry.name.isdigit() for entry in runs.iterdir()):
        raise Conflict(f"{runs} holds runs that are missing from the database", "slamhive reindex files them")
    if hive.ledger.knows_more():
        raise Conflict(
            f"{hive.settings.ledger_folder} holds configurations or searches, but the database is empty",
            "slamhive reindex restores them",
        )
