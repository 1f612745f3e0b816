"""Notes and tags of runs: written to their folders, which are the truth, and filed in the database."""

from __future__ import annotations

from collections.abc import Sequence

from slamhive.domain.notes import NotesChange, RunNotes
from slamhive.errors import Conflict
from slamhive.runs.folder import RunFolder
from slamhive.services.datasets import check_writable
from slamhive.settings import Settings
from slamhive.store import Store


class Notes:
    """Changes notes and tags.

    Args:
        settings: Mode, and where the folders of runs are.
        store: The database.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._settings = settings
        self._store = store

    def change(self, run_ids: Sequence[int], change: NotesChange) -> dict[int, RunNotes]:
        """Apply a change to these runs; their notes afterwards.

        Raises NotFound for an unknown run, InvalidInput for what cannot be kept, Conflict for a run without a folder;
        nothing is changed then.
        """
        check_writable(self._settings)
        runs = self._store.read(lambda t: t.runs.get_many(run_ids))
        changed = {run.id: change.applied(run.notes) for run in runs}
        folders = {run_id: RunFolder(self._settings.runs_folder / str(run_id)) for run_id in changed}
        for run_id, folder in folders.items():
            if not folder.record.exists():
                raise Conflict(f"run {run_id} has no folder yet", "wait until a worker has prepared it")
        for run_id, notes in changed.items():
            folders[run_id].write_notes(notes)
        self._store.write(lambda t: t.notes.put(changed))
        return changed

    def replace(self, run_id: int, note: str | None, tags: Sequence[str] | None) -> RunNotes:
        """Replace the note and the tags of a run; None keeps them. Raises as :meth:`change`."""
        before = self._store.read(lambda t: t.runs.get(run_id)).notes.tags
        kept = before if tags is None else tuple(tags)
        removed = tuple(tag for tag in before if tag not in kept)
        return self.change([run_id], NotesChange(note, kept, removed))[run_id]

    def tags(self) -> list[str]:
        """Every tag that some run has."""
        return self._store.read(lambda t: t.notes.tags())
