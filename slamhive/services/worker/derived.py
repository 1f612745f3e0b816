"""Make again what follows from the stored outcome of a run, when a worker starts.

It is written after the outcome, so a worker that is killed between the two, or whose disk is full then, leaves it out.
"""

from __future__ import annotations

import logging

from slamhive.domain.run import RunState
from slamhive.errors import SlamHiveError
from slamhive.runs.folder import RunFolder
from slamhive.runs.profiling import plots_are_missing, write_plots
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.records import RunRecord

logger = logging.getLogger(__name__)

_COLLECTED = (RunState.SUCCEEDED, RunState.FAILED)


def make_missing(settings: Settings, store: Store, latest: int) -> None:
    """Make what is missing in the folders of the ``latest`` runs."""
    for run in store.read(lambda t: t.runs.get_many(t.queue.lately(latest))):
        folder = RunFolder(settings.runs_folder / str(run.id))
        if not folder.record.exists():  # in the trash, or elsewhere
            continue
        try:
            _make_missing(run, folder)
        except (SlamHiveError, OSError) as error:
            logger.warning("plots or the current protocol of run %d are still missing: %s", run.id, error)


def _make_missing(run: RunRecord, folder: RunFolder) -> None:
    if run.state in _COLLECTED and plots_are_missing(folder):
        write_plots(folder)
    current = run.protocol
    if current is not None and folder.read_current_protocol() is None and folder.current_protocol.parent.is_dir():
        folder.write_current_protocol(current.fingerprint)
