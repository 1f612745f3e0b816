"""One installation of SLAM Hive: the use cases that command line, web pages and web API share."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamhive.clock import utc_now
from slamhive.domain.affinity import run_affinity
from slamhive.domain.run import RunEvent, RunState
from slamhive.errors import Conflict, SlamHiveError, Unavailable
from slamhive.evaluation.job import Artefacts
from slamhive.evaluation.runner import EvaluationRunner, ProcessStarter
from slamhive.executors.base import Executor
from slamhive.executors.registry import AUTO, ExecutorContext, choose_executor, installation_id, open_executor
from slamhive.files import temporary_folder
from slamhive.project import project_root
from slamhive.runs.folder import RunFolder
from slamhive.runs.log_line import read_tail
from slamhive.search.binding import Search
from slamhive.services.analyses.jobs import AnalysisJobs
from slamhive.services.analyses.stored import StoredAnalyses
from slamhive.services.configurations.service import Configurations
from slamhive.services.data_root import DataRoot, open_data_root
from slamhive.services.datasets.catalogue import Catalogue, check_writable
from slamhive.services.datasets.variants import Variants
from slamhive.services.evaluations.comparisons import Comparisons
from slamhive.services.evaluations.current import CurrentProtocols
from slamhive.services.evaluations.protocols import Protocols
from slamhive.services.evaluations.service import Evaluations
from slamhive.services.experiments.context import ExperimentContext
from slamhive.services.experiments.service import Experiments
from slamhive.services.imports.service import Imports
from slamhive.services.ledger.keeping import Ledger
from slamhive.services.runs.progress import RunProgress, run_progress
from slamhive.services.runs.record import handle_from_json
from slamhive.services.runs.retrying import check_retriable, retry_request
from slamhive.services.runs.series import RunSeries, run_series
from slamhive.services.runs.specification import check_disk, check_package, check_recorded, recorded_topics
from slamhive.services.runs.submission import Submission, protocol_for
from slamhive.services.searches.service import Searches
from slamhive.services.worker.lock import WorkerLock
from slamhive.services.worker.worker import Worker
from slamhive.settings import Mode, Settings, load_settings
from slamhive.store import (
    EvaluationRecord,
    Page,
    RunRecord,
    RunRequest,
    RunSort,
    Store,
    Transaction,
)

if TYPE_CHECKING:
    from slamhive.services.analyses.service import Analyses

logger = logging.getLogger(__name__)

LOG_TAIL_BYTES = 200_000
NO_INSTALLATION = "none"
"""Stands for the identifier of a data root that is not there: nothing was ever started for it."""


class Hive:
    """The facade. Every method may raise a SlamHiveError and nothing else that a user could have caused.

    Args:
        settings: In force.
        store: Open, with tables of this version.
        catalogue: Algorithms and datasets.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue) -> None:
        self.settings = settings
        self.store = store
        self.catalogue = catalogue
        self._executors: dict[str, Executor] = {}
        self.ledger = Ledger(settings, store)
        if settings.mode is not Mode.VIEW_ONLY:
            store.listener = self.ledger.note
        self.variants = Variants(settings, store)
        self.searches = Searches(settings, store, catalogue)
        self.configurations = Configurations(settings, store, catalogue, self.variants)
        self.protocols = Protocols(store)
        self.imports = Imports(settings, store, catalogue)
        self.experiments = Experiments(
            ExperimentContext(settings, store, catalogue, self.variants, self.executor, self.executor_name)
        )
        self.evaluations_service = Evaluations(settings, store, catalogue, self._evaluation_runner)

    # -- asking for runs -------------------------------------------------------------------------------------------

    def submit(self, submission: Submission) -> tuple[RunRecord, ...]:
        """Check everything that can be checked before a run starts, then queue ``repeat`` runs.

        Repeats get the seeds ``seed``, ``seed + 1``, ... and share one configuration.
        """
        self.check_writable()
        checked = self.configurations.check(submission)
        algorithm, dataset, configuration = checked.algorithm, checked.dataset, checked.configuration
        check_recorded(dataset, algorithm, recorded_topics(dataset))
        check_disk(self.settings)
        executor = self.executor_name(submission.executor)
        check_package(executor, self.executor, algorithm.package)
        protocol = None
        if submission.alignment is not None:
            protocol = protocol_for(algorithm, dataset, self.settings, submission.alignment)
        now = utc_now()
        uids = [uuid.uuid4().hex for _ in range(submission.repeat)]

        def work(transaction: Transaction) -> list[int]:
            algorithm_id = transaction.catalogue.put_algorithm(algorithm)
            dataset_id = transaction.catalogue.put_dataset(dataset, now)
            configuration_id, _ = transaction.configurations.get_or_create(
                configuration, algorithm_id, dataset_id, now, algorithm.parameters
            )
            requests = [
                RunRequest(
                    uid=uid,
                    configuration_id=configuration_id,
                    executor=executor,
                    seed=submission.seed + index,
                    priority=submission.priority,
                    evaluate=submission.evaluate,
                    cpu_cores=submission.cpu_cores,
                    memory_mb=submission.memory_mb,
                    timeout_s=submission.timeout_s,
                    protocol=protocol,
                    affinity=run_affinity(dataset.name, configuration.variant, algorithm.package.name),
                    stop_when=submission.stop_when,
                )
                for index, uid in enumerate(uids)
            ]
            return transaction.runs.add_runs(requests, now)

        run_ids = self.store.write(work)
        return self.store.read(lambda t: t.runs.get_many(run_ids))

    def retry(self, run_id: int) -> RunRecord:
        """Queue a new run with the configuration of one that has ended.

        Raises InvalidInput if the algorithm, as it is defined now, no longer takes the values that are stored.
        """
        self.check_writable()
        old = self.run(run_id)
        check_retriable(old)
        self.configurations.check_runnable(old.configuration_id)
        uid, now = uuid.uuid4().hex, utc_now()
        (new_id,) = self.store.write(lambda t: t.runs.add_runs([retry_request(t, old, uid)], now))
        return self.run(new_id)

    def run_configuration(self, configuration_id: int, **fields: Any) -> tuple[RunRecord, ...]:
        """Queue runs of a stored configuration; ``fields`` are those of a :class:`Submission` that say how to run it.

        Raises InvalidInput as :meth:`retry`.
        """
        self.configurations.check_runnable(configuration_id)
        submission, _ = self.configurations.submission(configuration_id)
        return self.submit(replace(submission, **fields))

    def cancel(self, run_id: int) -> RunRecord:
        """Cancel a queued run at once; ask the worker to end an active one."""
        self.check_writable()
        now = utc_now()
        self.store.write(lambda t: t.runs.request_cancel(run_id, now))
        return self.run(run_id)

    # -- looking at runs -------------------------------------------------------------------------------------------

    def runs(
        self, wanted: Search | None = None, sort: RunSort | None = None, after: str | None = None, limit: int = 50
    ) -> Page:
        """One page of runs with their figures."""
        return self.store.read(lambda t: t.runs.page(wanted, sort, after, limit, with_metrics=True))

    def run(self, run_id: int) -> RunRecord:
        """One run with its figures."""
        return self.store.read(lambda t: t.runs.get(run_id, with_metrics=True))

    def events(self, run_id: int) -> tuple[RunEvent, ...]:
        """The moves of a run, oldest first."""
        return tuple(self.store.read(lambda t: t.runs.events(run_id)))

    def evaluations(self, run_id: int) -> tuple[EvaluationRecord, ...]:
        """The evaluations of a run, oldest first."""
        return tuple(self.store.read(lambda t: t.evaluations.for_run(run_id)))

    def counts(self) -> dict[RunState, int]:
        """How many runs are in each state."""
        return self.store.read(lambda t: t.runs.counts_by_state())

    def folder(self, run_id: int) -> RunFolder:
        """The run's folder; it exists once a worker has prepared the run."""
        return RunFolder(self.settings.runs_folder / str(run_id))

    def record(self, run_id: int) -> dict[str, Any]:
        """The content of ``run.json``: provenance and outcome; empty for a run that no worker has begun."""
        folder = self.folder(run_id)
        return folder.read_record() if folder.record.exists() else {}

    def log(self, run_id: int, max_bytes: int = LOG_TAIL_BYTES) -> str:
        """The last ``max_bytes`` of what the run has printed so far."""
        run = self.run(run_id)
        folder = self.folder(run_id)
        if run.state is not RunState.RUNNING or run.handle is None:
            return read_tail(folder.log, max_bytes)
        # Not into the run's folder: the worker may have the whole log there by the time that ours is written.
        with temporary_folder() as aside:
            path = aside / folder.log.name
            self._fetch_log(run, path)
            return read_tail(path, max_bytes) or read_tail(folder.log, max_bytes)

    def progress(self, run_id: int) -> RunProgress | None:
        """How far an active run is; None for one that waits or has ended."""
        run = self.run(run_id)
        record = self.record(run_id) if run.state.active else {}
        return run_progress(run, self.folder(run_id), utc_now(), record.get("dataset", {}).get("duration_s"))

    def series(self, run_id: int) -> RunSeries:
        """Trajectory, errors, resources and latencies of a run over time."""
        return run_series(self.run(run_id), self.folder(run_id))

    # -- evaluation ------------------------------------------------------------------------------------------------

    def queue_evaluations(
        self,
        run_ids: Sequence[int] | None = None,
        protocol: str | None = None,
        artefacts: Artefacts = Artefacts.FILES,
    ) -> int:
        """Queue evaluations of these runs, or of all that have none; how many.

        ``protocol`` is the name of one, None for that of the runs.
        """
        self.check_writable()
        asked = None if protocol is None else self.protocols.named(protocol)
        wanted = self.evaluations_service.unevaluated() if run_ids is None else run_ids
        return len(self.evaluations_service.queue(wanted, asked, artefacts))

    def unevaluated(self) -> int:
        """How many runs succeeded and have no evaluation yet."""
        return self.searches.unevaluated()

    @property
    def current_protocols(self) -> CurrentProtocols:
        """Which protocol's figures are shown."""
        return CurrentProtocols(self.store, self.evaluations_service, self.settings.runs_folder)

    @property
    def comparisons(self) -> Comparisons:
        """Runs the way published tools count."""
        return Comparisons(self.store, self.evaluations_service, self.settings.runs_folder)

    # -- analyses --------------------------------------------------------------------------------------------------

    @cached_property
    def analyses(self) -> Analyses:
        """Analysis files and reports; loaded when first used, since matplotlib, pandas and scipy take two seconds."""
        from slamhive.services.analyses.service import Analyses  # noqa: PLC0415

        return Analyses(self.settings, self.store, self.catalogue, self.searches)

    @property
    def stored_analyses(self) -> StoredAnalyses:
        """Analyses with an address of their own."""
        return StoredAnalyses(self.settings, self.store, lambda text: self.analyses.read(text).name)

    @property
    def analysis_jobs(self) -> AnalysisJobs:
        """What computes them; the worker does, and in view-only mode the web server."""
        return AnalysisJobs(self.settings, self.store, self.catalogue.project_root)

    # -- machinery -------------------------------------------------------------------------------------------------

    def worker(self, only: Sequence[int] | None = None) -> Worker:
        """A worker of this installation; its ``run`` works."""
        self.check_writable()
        return Worker(self.settings, self.store, self.catalogue, self.executor, self.evaluations_service, only)

    def worker_alive(self) -> bool:
        """Whether a worker of this data root runs on this machine."""
        return WorkerLock(self.settings.data).held_elsewhere()

    def executor(self, name: str) -> Executor:
        """The executor called ``name``, made once."""
        if name not in self._executors:
            self._executors[name] = open_executor(name, self._executor_context())
        return self._executors[name]

    def executor_name(self, asked: str | None = None) -> str:
        """The executor that a run will use: the one asked for if it can be used, or the one of the settings.

        Where the settings name one and a worker runs, it is the worker's to use: a web server in a container of its
        own sees no engine. Raises Unavailable with the remedy if it cannot be used on this machine.
        """
        wanted = asked or self.settings.executor
        if wanted == self.settings.executor != AUTO and self.worker_alive():
            return wanted
        executor, _ = choose_executor(wanted, self.executor)
        return executor.name

    def executor_choice(self) -> tuple[str, str]:
        """The executor in force and, in words, why it is."""
        executor, reason = choose_executor(self.settings.executor, self.executor)
        return executor.name, reason

    def close(self) -> None:
        """Close the database and the connections to engines."""
        for executor in self._executors.values():
            executor.close()
        self._executors.clear()
        self.store.close()

    def _executor_context(self) -> ExecutorContext:
        settings = self.settings
        return ExecutorContext(
            data=settings.data,
            project_root=self.catalogue.project_root,
            installation=installation_id(settings.data) if settings.data.is_dir() else NO_INSTALLATION,
            log_max_bytes=settings.log_max_bytes,
        )

    def _evaluation_runner(self) -> EvaluationRunner:
        """Evaluation runs where the runs themselves run: in a container if Docker is in use, else in a process."""
        name, _ = self.executor_choice()
        if name == "docker":
            from slamhive.executors.docker.batch import DockerStarter  # noqa: PLC0415 - the SDK takes 0.2 s to import

            return EvaluationRunner(DockerStarter(self._executor_context()))
        return EvaluationRunner(ProcessStarter(self.catalogue.project_root))

    def _fetch_log(self, run: RunRecord, path: Path) -> None:
        try:
            self.executor(run.executor).save_log(handle_from_json(run.handle or {}), path)
        except SlamHiveError as error:
            logger.info("log of run %d: %s", run.id, error)

    def check_writable(self) -> None:
        """Raise Forbidden in view-only mode."""
        check_writable(self.settings)


def open_hive(options: Mapping[str, Any] | None = None, data_root: DataRoot = DataRoot.MADE) -> Hive:
    """Read the settings, open the database, and check that mode and data root can be used.

    Raises InvalidInput for a mode that does not exist yet, NotFound if something is missing that ``data_root`` expects,
    Unavailable if the data root cannot be written or the database does not answer.
    """
    root = project_root()
    settings = load_settings(root, options=options)
    if settings.mode in (Mode.CLUSTER, Mode.CLOUD):
        raise Unavailable(f"MODE={settings.mode} is not available yet", "use workstation or view-only")
    return Hive(settings, open_data_root(settings, data_root), Catalogue(settings, root))


def check_indexed(hive: Hive) -> None:
    """Raise Conflict if there are folders but no rows: the database was lost, numbers would be used twice."""
    if sum(hive.counts().values()) == 0 and any(_run_folders(hive.settings.runs_folder)):
        raise Conflict(
            f"{hive.settings.runs_folder} holds runs that the database does not know", "slamhive reindex files them"
        )
    if hive.ledger.knows_more():
        raise Conflict(
            f"{hive.settings.ledger_folder} tells of configurations and searches, but the database is empty",
            "slamhive reindex restores them",
        )


def _run_folders(folder: Path) -> list[Path]:
    return [entry for entry in folder.iterdir() if entry.name.isdigit()]
