"""Keep ``run.json`` up to date during a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from slamhive.domain.run import RunEvent
from slamhive.errors import SlamHiveError
from slamhive.runs.folder import RunFolder
from slamhive.services.runs.record import begin_record, events_to_json
from slamhive.store.records import RunRecord


class RecordKeeper:
    """Writes the record of one run, always with the moves that the database has.

    Args:
        folder: The run's folder.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder

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

    def begin(self, run: RunRecord, events: Sequence[RunEvent], changes: dict[str, Any] | None = None) -> None:
        """Write a record that does not exist yet or cannot be read; the arguments are those of :meth:`save`."""
        self._write({**begin_record(run), **(changes or {})}, events)

    def save(self, events: Sequence[RunEvent], changes: dict[str, Any], *, without: str | None = None) -> None:
        """Add ``changes`` and all moves, ``events``, and drop the key ``without``."""
        content = {**self.read(), **changes}
        if without is not None:
            content.pop(without, None)
        self._write(content, events)

    def _write(self, content: dict[str, Any], events: Sequence[RunEvent]) -> None:
        self._folder.write_record({**content, "events": events_to_json(events)})
