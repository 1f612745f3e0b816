"""Remove leftovers of killed processes when a worker starts: incomplete files and folders, scratch space.

Files that a running process uses are locked and stay.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import SlamHiveError
from slamhive.base.files import sweep_asides, sweep_folder, sweep_temporary
from slamhive.base.settings import Settings
from slamhive.domain.run import RunState
from slamhive.executors.base import Executor
from slamhive.executors.registry import candidates
from slamhive.filters.words import matching
from slamhive.recordings.staging import sweep_partial_folders
from slamhive.run_folder.folder import RunFolder
from slamhive.services.challenges import sweep_challenges
from slamhive.services.datasets import VariantService
from slamhive.services.evaluations import sweep_scratch
from slamhive.services.imports import sweep_imports
from slamhive.services.runs import handle_from_json
from slamhive.services.worker.collecting import sweep_scratch as sweep_run_scratch
from slamhive.store import Store
from slamhive.store.records import RunRecord

logger = logging.getLogger(__name__)

LATEST = 1000
"""The number of latest runs to check: a dead worker had only a few."""


def sweep_leftovers(
    settings: Settings, store: Store, variants: VariantService, executors: Callable[[str], Executor]
) -> None:
    """Remove leftovers of killed processes from the data root and the folder for temporary files."""
    data = settings.data
    sweep_scratch(data)
    sweep_temporary()
    for folder in (
        data,
        settings.ledger_folder,
        settings.baselines_folder,
        settings.bisections_folder,
        settings.claims_folder,
        *_folders(settings.experiments_folder),
        *_folders(settings.analyses_folder),
    ):
        sweep_asides(folder)
    for aside in settings.analyses_folder.glob(".*"):
        sweep_folder(aside)
    sweep_challenges(settings.challenges_folder)
    sweep_partial_folders(settings.datasets_folder)
    for aside in settings.algorithms_folder.glob(".import-*"):
        sweep_folder(aside)
    variants.cache.sweep()
    sweep_imports(settings.runs_folder)
    for run in store.read(lambda t: t.runs.get_many(t.queue.lately(LATEST))):
        run_folder = RunFolder(settings.runs_folder / str(run.id))
        evaluations = run_folder.root / "evaluations"
        for place in (run_folder.root, evaluations, *_folders(evaluations)):
            sweep_asides(place)
        if run.state.ended and run.handle is not None and run_folder.work.exists():
            try:
                executors(run.executor).remove(handle_from_json(run.handle))
            except SlamHiveError as error:
                logger.info("what run %d has left may still be there: %s", run.id, error)
    sweep_run_scratch(settings.runs_folder, store)


def _folders(root: Path) -> Iterable[Path]:
    return [entry for entry in root.iterdir() if entry.is_dir() and not entry.is_symlink()] if root.is_dir() else []


INTERVAL_S = 60.0
MOST_ACTIVE = 1000


class EngineSweep:
    """Removes what ended runs and dead processes have left in executors, such as containers. Thread-safe.

    It asks the executors that active runs use, and those that the settings allow. One sweep at the start of a worker
    is not enough: an engine may finish what a killed worker asked for after the next worker has started.

    Args:
        setting: The executor of the settings, or ``auto``.
        store: Knows the active runs.
        executors: The executor for a name.
        interval_s: Time between two sweeps of :meth:`sweep_if_due`.
        elsewhere: The settings allow executors of other machines only.
    """

    def __init__(
        self,
        setting: str,
        store: Store,
        executors: Callable[[str], Executor],
        interval_s: float = INTERVAL_S,
        *,
        elsewhere: bool = False,
    ) -> None:
        self._setting = setting
        self._elsewhere = elsewhere
        self._store = store
        self._executors = executors
        self._interval_s = interval_s
        self._lock = threading.Lock()
        self._due_s = 0.0
        self._failures: dict[str, str] = {}

    def sweep_if_due(self) -> None:
        """Sweep unless another thread does so now, or the last sweep is less than the interval ago."""
        if monotonic_s() < self._due_s or not self._lock.acquire(blocking=False):
            return
        try:
            self._sweep()
        finally:
            self._lock.release()

    def sweep(self) -> None:
        """Sweep now."""
        with self._lock:
            self._sweep()

    def _sweep(self) -> None:
        self._due_s = monotonic_s() + self._interval_s
        names = {record.executor for record in self._active()}
        allowed = candidates(self._setting, self._executors, elsewhere=self._elsewhere)
        names.update(executor.name for executor in allowed)
        for name in sorted(names):
            try:
                removed = self._executors(name).sweep(lambda: {record.uid for record in self._active()})
            except SlamHiveError as error:
                if self._failures.get(name) != str(error):
                    logger.info("what runs have left in %s is not removed now: %s", name, error)
                self._failures[name] = str(error)
            else:
                self._failures.pop(name, None)
                if removed:
                    logger.info("removed %s, which nobody needs any more", ", ".join(removed))

    def _active(self) -> tuple[RunRecord, ...]:
        active = matching(states=tuple(state for state in RunState if state.active))
        return self._store.read(lambda t: t.runs.page(active, limit=MOST_ACTIVE)).records
