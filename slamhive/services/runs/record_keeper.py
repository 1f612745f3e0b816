"""Keep ``run.json`` up to date during a run."""

from __future__ import annotations

from typing import Any

from slamhive.domain.run import RunEvent
from slamhive.errors import SlamHiveError
from slamhive.runs.folder import RunFolder
from slamhive.services.runs.record import begin_record, events_to_json
from slamhive.store import Store
from slamhive.store.records import RunRecord


class RecordKeeper:
    """Writes the record of one run, always with the state changes in the database.

    Args:
        folder: The run's folder.
        store: The database.
        run_id: The run.
    """

    def __init__(self, folder: RunFolder, store: Store, run_id: int) -> None:
        self._folder = folder
        self._store = store
        self._run_id = run_id

    def readable(self) -> bool:
        """Whether there is a readable record."""
        try:
            self._folder.read_record()
        except SlamHiveError:
            return False
        return True

    def read(self) -> dict[str, Any]:
        """The record; raises NotFound or InvalidInput."""
        return self._folder.read_record()

    def begin(self, run: RunRecord, changes: dict[str, Any] | None = None, coming: RunEvent | None = None) -> None:
        """Write a record that does not exist yet or cannot be read; the arguments are those of :meth:`save`."""
        self._write({**begin_record(run), **(changes or {})}, coming)

    def save(self, changes: dict[str, Any], coming: RunEvent | None = None, *, without: str | None = None) -> None:
        """Add ``changes`` and drop the key ``without``; ``coming`` is the move that the row is about to make."""
        content = {**self.read(), **changes}
        if without is not None:
            content.pop(without, None)
        self._write(content, coming)

    def _write(self, content: dict[str, Any], coming: RunEvent | None) -> None:
        events = self._store.read(lambda t: t.runs.events(self._run_id))
        content["events"] = events_to_json([*events, *([] if coming is None else [coming])])
        self._folder.write_record(content)
