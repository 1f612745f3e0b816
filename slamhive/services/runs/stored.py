"""Stored runs: looked up and listed. What lists runs needs no more than this, and loads nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from slamhive.base.settings import Settings
from slamhive.filters.binding import Search
from slamhive.run_folder.folder import RunFolder
from slamhive.store import Page, RunRecord, RunSort, Store, Transaction

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from slamhive.documents.run import RunWith
    from slamhive.domain.run import RunEvent, RunState
    from slamhive.store.run_cells import CellsWanted, RunCellPage


class StoredRuns:
    """The runs of one installation, to read only.

    Args:
        settings: Where the folders of runs are.
        store: The database.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store

    def page(
        self, wanted: Search | None = None, sort: RunSort | None = None, after: str | None = None, limit: int = 50
    ) -> Page:
        """One page of runs with their metrics."""
        return self._store.read(lambda t: t.runs.page(wanted, sort, after, limit, with_metrics=True))

    def cells(
        self, wanted: Search | None, sort: RunSort, columns: CellsWanted
    ) -> Callable[[str | None, int], RunCellPage]:
        """Reader of pages of an export: up to so many runs after a key, only what ``columns`` read of them."""
        return lambda after, limit: self._store.read(lambda t: t.runs.cells(wanted, sort, after, limit, columns))

    def repeated(self, run_ids: Sequence[int]) -> frozenset[int]:
        """Those of these runs that another run repeats."""
        return frozenset(self._store.read(lambda t: t.deleted_runs.repeated_by(run_ids)))

    def get(self, run_id: int) -> RunRecord:
        """One run with its metrics; raises NotFound."""
        return self._store.read(lambda t: t.runs.get(run_id, with_metrics=True))

    def in_full(self, run_id: int) -> RunWith:
        """A run with its moves and evaluations, as JSON shows it; raises NotFound."""
        from slamhive.services.runs.files import run_in_full  # noqa: PLC0415 - lists need no documents

        def work(t: Transaction) -> RunWith:
            run, evaluations = t.runs.get(run_id, with_metrics=True), t.evaluations.for_run(run_id)
            return run_in_full(run, self.folder(run_id), evaluations, t.runs.events(run_id))

        return self._store.read(work)

    def events(self, run_id: int) -> tuple[RunEvent, ...]:
        """The changes of state of a run, oldest first."""
        return tuple(self._store.read(lambda t: t.runs.events(run_id)))

    def counts(self) -> dict[RunState, int]:
        """Number of runs in each state."""
        return self._store.read(lambda t: t.runs.counts_by_state())

    def folder(self, run_id: int) -> RunFolder:
        """The run's folder; it exists once a worker has prepared the run."""
        return RunFolder(self._settings.runs_folder / str(run_id))

    def record(self, run_id: int) -> dict[str, Any]:
        """The content of ``run.json``: provenance and outcome; empty until a worker has claimed the run."""
        folder = self.folder(run_id)
        return folder.read_record() if folder.record.exists() else {}
