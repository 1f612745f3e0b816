"""Keeping the ledger: what a transaction has stored is written to it right after the commit."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime

from slamhive.base.errors import SlamHiveError
from slamhive.base.settings import Settings
from slamhive.documents.archive import DatasetLine, LedgerAlgorithmLine, SearchLine, VersionLine
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.run import RunState
from slamhive.run_folder.folder import RunFolder
from slamhive.services.ledger.book import (
    NOT_A_LINE,
    Book,
    LedgerFiles,
    Line,
    asked_line,
    cancelled_line,
    cell_line,
    configuration_lines,
    ended_lines,
    label_line,
    live_configurations,
    read_evaluations,
    record_line,
    run_lines,
)
from slamhive.store import Store, Transaction
from slamhive.store.changes import AskedEvaluations, Changes
from slamhive.store.configuration_listing import ConfigurationRecord
from slamhive.store.records import EndedEvaluation

logger = logging.getLogger(__name__)

# Lines are only added, since the database may be the older one.

_AT_ONCE = 500


class Missing:
    """The lines that each book lacks.

    Args:
        settings: Where run folders lie.
        store: The database.
        files: The books.
    """

    def __init__(self, settings: Settings, store: Store, files: LedgerFiles) -> None:
        self._settings = settings
        self._store = store
        self._files = files

    def configurations(self) -> Iterator[Line]:
        """Configurations, and what users say about them."""
        told: set[int] = set()
        said: dict[int, Line] = {}
        for line in self._files.configurations.read():
            told.update(entry[0] for entry in line.get("configurations", ()))
            for number in line.get("deleted", ()):
                told.discard(number)
                said.pop(number, None)
            if "label" in line:
                said[line["label"]] = line
        stored, described = self._store.read(lambda t: (t.ledger.configurations(), t.ledger.described()))
        if told - stored:
            logger.warning(
                "%s lists %d configurations that the database does not know: slamhive reindex restores them",
                self._files.configurations.path,
                len(told - stored),
            )
        for record in self._records(sorted(stored - told)):
            yield record_line(record)
        for record in self._records(sorted({*described, *(stored & said.keys())})):
            if said.get(record.id) != (line := label_line(record)):
                yield line

    def cells(self) -> Iterator[Line]:
        """Cells of experiments, and how many there are."""
        told: dict[str, set[int]] = defaultdict(set)
        sizes: dict[str, Line] = {}
        for line in self._files.cells.read():
            told[line["experiment"]].update(entry[0] for entry in line.get("cells", ()))
            if "size" in line:
                sizes[line["experiment"]] = line["size"]
        stored, counted = self._store.read(lambda t: (t.ledger.stored_cells(), t.ledger.sizes()))
        for record in self._store.read(lambda t: t.experiments.all()):
            if stored.get(record.uid, 0) > len(told[record.uid]):
                after = -1
                while cells := self._store.read(lambda t: t.experiments.cells(record.id, after, _AT_ONCE)):  # noqa: B023
                    yield cell_line(record.uid, cells)
                    after = cells[-1].number
            if sizes.get(record.uid) != counted[record.uid]:
                yield {"experiment": record.uid, "size": counted[record.uid]}

    def runs(self) -> Iterator[Line]:
        """Runs that wait, those that were cancelled before they had a folder, and active ones that are to end."""
        told: dict[RunState, set[int]] = {RunState.QUEUED: set(), RunState.CANCELLED: set()}
        asked: set[int] = set()
        for line in self._files.runs.read():
            told[RunState.QUEUED].update(entry[0] for entry in line.get("runs", ()))
            told[RunState.CANCELLED].update(line.get("cancelled", ()))
            asked.update(line.get("asked_to_end", ()))
        waiting, to_end, experiments = self._store.read(
            lambda t: (
                t.ledger.waiting(),
                t.ledger.asked_to_end(),
                t.ledger.experiments(),
            )
        )
        untold: list[int] = []
        for run_id, state in waiting.items():
            if run_id in told[state]:
                continue
            # The folder of a run may say it where the book does not.
            folder = RunFolder(self._settings.runs_folder / str(run_id))
            try:
                filed = folder.record.exists() and folder.read_record().get("state") == state.value
            except SlamHiveError:
                filed = False
            if not filed:
                untold.append(run_id)
        for part in _parts(sorted(set(untold) - told[RunState.QUEUED])):
            yield from run_lines(self._store.read(lambda t: t.ledger.requests(part)), experiments)  # noqa: B023
        yield from self._cancelled([run_id for run_id in untold if waiting[run_id] is RunState.CANCELLED])
        if new := sorted(set(to_end) - asked):
            yield {"asked_to_end": new}

    def evaluations(self) -> Iterator[Line]:
        """Evaluations that wait, and those that have ended."""
        told = read_evaluations(self._files.evaluations.read())
        ended, waiting = self._store.read(lambda t: t.ledger.evaluation_counts())
        known = {key for entries in told.ended.values() for key in entries}
        if ended > len(known):
            protocols = set(told.protocols)
            for run_id, entry in self._ended():
                if (run_id, entry.protocol.fingerprint, entry.created_at) not in known:
                    if entry.protocol.fingerprint not in protocols:
                        protocols.add(entry.protocol.fingerprint)
                        yield asked_line(AskedEvaluations(entry.protocol, entry.artefacts, entry.created_at, ()))
                    yield from ended_lines({run_id: [entry]})
        if waiting:
            for asked in self._store.read(lambda t: t.ledger.open()):
                new = [run for run in asked.run_ids if (run, asked.protocol.fingerprint, asked.at) not in told.asked]
                if new:
                    yield asked_line(replace(asked, run_ids=new))

    def _records(self, ids: list[int]) -> Iterator[ConfigurationRecord]:
        for part in _parts(ids):
            yield from self._store.read(lambda t: t.configuration_book.records(part))  # noqa: B023

    def _cancelled(self, run_ids: list[int]) -> Iterator[Line]:
        together: dict[tuple[datetime, str], list[int]] = defaultdict(list)
        for part in _parts(run_ids):
            found = self._store.read(lambda t: t.ledger.cancellations(part))  # noqa: B023
            for run_id, when in found.items():
                together[when].append(run_id)
        for (at, why), members in together.items():
            yield cancelled_line(members, at, why)

    def _ended(self) -> Iterator[tuple[int, EndedEvaluation]]:
        after = 0
        while found := self._store.read(lambda t: t.ledger.ended(after=after)):  # noqa: B023
            yield from ((run_id, entry) for _, run_id, entry in found)
            after = found[-1][0]


def catalogue_lines(store: Store) -> Iterator[Line]:
    """Algorithms, versions of packages, and datasets."""

    def work(t: Transaction) -> list[Line]:
        algorithms = [LedgerAlgorithmLine.of(entry, versions=()).content for entry in t.catalogue.algorithms()]
        versions = [VersionLine.of(entry, version=entry.version).content for entry in t.versions.all()]
        datasets = [
            {"dataset": DatasetLine.of(entry).content, "folder": entry.folder} for entry in t.catalogue.datasets()
        ]
        return [*algorithms, *versions, *datasets]

    yield from store.read(work)


def search_lines(store: Store) -> Iterator[Line]:
    """Saved searches."""
    for record, at in store.read(lambda t: t.archive.saved_searches()):
        yield SearchLine.of(record, created_at=at).content


def _parts(ids: Iterable[int]) -> Iterator[list[int]]:
    wanted = list(ids)
    for start in range(0, len(wanted), _AT_ONCE):
        yield wanted[start : start + _AT_ONCE]


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
        """Tell if the ledger has entries but the database is empty, so it was lost."""
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
