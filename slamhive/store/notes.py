"""Notes and tags of runs: the index of what their folders hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from sqlalchemy import delete, insert, select

from slamhive.domain.notes import RunNotes
from slamhive.store.models import RunNote, RunTag
from slamhive.store.rows import Repository, chunks

_NOTES = RunNote.__table__
_TAGS = RunTag.__table__


class NoteRepository(Repository):
    """A run without a note has no row, and one row for each of its tags."""

    def put(self, notes: Mapping[int, RunNotes]) -> None:
        """Replace the notes and tags of these runs."""
        for part in chunks(sorted(notes)):
            for table in (_NOTES, _TAGS):
                self._connection.execute(delete(table).where(table.c.run_id.in_(part)))
        texts = [{"run_id": run_id, "note": entry.note} for run_id, entry in notes.items() if entry.note]
        tags = [{"run_id": run_id, "tag": tag} for run_id, entry in notes.items() for tag in entry.tags]
        if texts:
            self._connection.execute(insert(_NOTES), texts)
        if tags:
            self._connection.execute(insert(_TAGS), tags)

    def for_runs(self, run_ids: Iterable[int]) -> dict[int, RunNotes]:
        """{run: notes and tags} of those of these runs that have any."""
        wanted: Sequence[int] = sorted(set(run_ids))
        texts: dict[int, str] = {}
        tags: dict[int, list[str]] = {}
        for part in chunks(wanted):
            texts.update(
                (row.run_id, row.note)
                for row in self._connection.execute(select(_NOTES).where(_NOTES.c.run_id.in_(part)))
            )
            rows = select(_TAGS).where(_TAGS.c.run_id.in_(part)).order_by(_TAGS.c.run_id, _TAGS.c.tag)
            for row in self._connection.execute(rows):
                tags.setdefault(row.run_id, []).append(row.tag)
        return {
            run_id: RunNotes(texts.get(run_id, ""), tuple(tags.get(run_id, ())))
            for run_id in texts.keys() | tags.keys()
        }

    def tags(self) -> list[str]:
        """Every tag that some run has, in order."""
        return self._column(select(_TAGS.c.tag).distinct().order_by(_TAGS.c.tag))
