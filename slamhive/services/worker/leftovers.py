"""Remove leftovers of killed processes when a worker starts: incomplete files and folders, scratch space.

Files that a running process uses are locked and stay.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

from slamhive.bags.staging import sweep_partial_folders
from slamhive.domain.run import RunState
from slamhive.errors import SlamHiveError
from slamhive.executors.base import Executor
from slamhive.files import sweep_asides, sweep_folder, sweep_temporary
from slamhive.runs.folder import RunFolder
from slamhive.services.challenges import sweep_challenges
from slamhive.services.datasets import Variants
from slamhive.services.evaluations import sweep_scratch
from slamhive.services.imports import sweep_imports
from slamhive.services.runs import handle_from_json
from slamhive.services.worker.disk import sweep_scratch as sweep_run_scratch
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.records import RunRecord

logger = logging.getLogger(__name__)

LATEST = 1000
"""The number of latest runs to check: a dead worker had only a few."""


def sweep_leftovers(settings: Settings, store: Store, variants: Variants, executors: Callable[[str], Executor]) -> None:
    """Remove leftovers of killed processes from the data root and the folder for temporary files."""
    data = settings.data
    sweep_scratch(data)
    sweep_temporary()
    for folder in (
        data,
        settings.ledger_folder,
        settings.baselines_folder,
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
    variants.sweep()
    sweep_imports(settings.runs_folder)
    for run in store.read(lambda t: t.runs.get_many(t.queue.lately(LATEST))):
        _sweep_run(run, RunFolder(settings.runs_folder / str(run.id)), executors)
    sweep_run_scratch(settings.runs_folder, store)


def _sweep_run(run: RunRecord, folder: RunFolder, executors: Callable[[str], Executor]) -> None:
    for place in (folder.root, folder.root / "evaluations", *_folders(folder.root / "evaluations")):
        sweep_asides(place)
    if not RunState(run.state).ended or not folder.work.exists():
        return
    try:
        if run.handle is not None:
            executors(run.executor).remove(handle_from_json(run.handle))
    except SlamHiveError as error:
        logger.info("what run %d has left may still be there: %s", run.id, error)


def _folders(root: Path) -> Iterable[Path]:
    return [entry for entry in root.iterdir() if entry.is_dir() and not entry.is_symlink()] if root.is_dir() else []
