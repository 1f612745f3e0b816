"""Keeping the ledger: what a transaction has stored is written to it right after the commit."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence

from slamhive.domain.external import IMPORTED
from slamhive.errors import SlamHiveError
from slamhive.services.ledger.book import Book, Line
from slamhive.services.ledger.evaluation_lines import asked_line, ended_lines
from slamhive.services.ledger.files import LedgerFiles
from slamhive.services.ledger.lines import (
    NOT_A_LINE,
    cancelled_line,
    cell_line,
    configuration_lines,
    label_line,
    live_configurations,
    run_lines,
)
from slamhive.services.ledger.missing import Missing, catalogue_lines, search_lines
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.changes import Changes

logger = logging.getLogger(__name__)


class Ledger:
    """The ledger of one installation.

    Args:
        settings: Where it lies.
        store: The store that it records.
    """

    def __init__(self, settings: Settings, store: Store) -> None:
        self._store = store
        self.files = LedgerFiles(settings.ledger_folder)
        self._missing = Missing(settings, store, self.files)
        self._experiments: dict[int, str] = {}

    def note(self, changes: Changes) -> None:
        """Write what was stored. If this fails, :meth:`check` completes the ledger later."""
        try:
            if changes.uncertain:
                self.check()
            else:
                self._note(changes)
        except NOT_A_LINE:
            logger.exception("a damaged line in %s prevents its completion", self.files.folder)
        except SlamHiveError as error:
            logger.warning("%s; the ledger is completed when a worker starts", error)

    def check(self) -> None:
        """Write what is missing, because a kill or a full disk can prevent the lines of a transaction."""
        files, missing = self.files, self._missing
        for book, lines in (
            (files.configurations, missing.configurations()),
            (files.cells, missing.cells()),
            (files.runs, missing.runs()),
            (files.evaluations, missing.evaluations()),
        ):
            book.append(lines)
        self._replace(files.catalogue, catalogue_lines)
        self._replace(files.searches, search_lines)

    def knows_more(self) -> bool:
        """Whether the ledger has entries but the database is empty, so it was lost."""
        if not self._store.read(lambda t: t.ledger.empty()):
            return False
        return bool(live_configurations(self.files.configurations)) or any(self.files.searches.read())

    def _note(self, changes: Changes) -> None:
        if changes.catalogue:
            self._replace(self.files.catalogue, catalogue_lines)
        if changes.searches:
            self._replace(self.files.searches, search_lines)
        self.files.configurations.append(self._configurations(changes))
        self.files.cells.append(self._cells(changes))
        self.files.runs.append(self._runs(changes))
        self.files.evaluations.append(self._evaluations(changes))

    def _replace(self, book: Book, wanted: Callable[[Store], Iterator[Line]]) -> None:
        """Make a small book equal to the database."""
        if list(book.read()) != list(wanted(self._store)):
            with book.replaced() as lines:
                lines.extend(wanted(self._store))

    def _configurations(self, changes: Changes) -> Iterator[Line]:
        yield from configuration_lines([row for row in changes.configurations if row.id not in changes.deleted])
        described = sorted(changes.described - changes.deleted)
        if described:
            for record in self._store.read(lambda t: t.configuration_book.records(described)):
                yield label_line(record)
        if changes.deleted:
            yield {"deleted": sorted(changes.deleted)}

    def _cells(self, changes: Changes) -> Iterator[Line]:
        for experiment, cells in changes.cells:
            yield cell_line(self._uid(experiment), cells)
        if changes.experiments:
            sizes = self._store.read(lambda t: t.ledger.sizes())
            for experiment in sorted(changes.experiments):
                yield {"experiment": self._uid(experiment), "size": sizes[self._uid(experiment)]}

    def _runs(self, changes: Changes) -> Iterator[Line]:
        # Imported runs never wait: their folders follow immediately.
        rows = [row for row in changes.runs if row.content.executor != IMPORTED]
        named = {row.content.experiment_id for row in rows} - {None}
        yield from run_lines(rows, {number: self._uid(number) for number in named if number is not None})
        for members, at, why in changes.cancelled:
            if members:
                yield cancelled_line(members, at, why)
        if changes.asked_to_end:
            yield {"asked_to_end": sorted(changes.asked_to_end)}

    def _evaluations(self, changes: Changes) -> Iterator[Line]:
        yield from map(asked_line, changes.asked_evaluations)
        if changes.evaluated:
            evaluated: Sequence[int] = sorted(changes.evaluated)
            for _, run_id, entry in self._store.read(lambda t: t.ledger.ended(evaluated)):
                yield from ended_lines({run_id: [entry]})

    def _uid(self, experiment: int) -> str:
        if experiment not in self._experiments:
            self._experiments = self._store.read(lambda t: t.ledger.experiments())
        return self._experiments[experiment]
