"""Restores rows from the ledger under their old numbers. Rows that the database already has do not change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import SlamHiveError
from slamhive.documents.archive import CancelledLine, LabelLine, LedgerAlgorithmLine, VersionLine, VersionRow
from slamhive.domain.accounts import Sharing
from slamhive.domain.run import RunEvent, RunState
from slamhive.run_folder.folder import RunFolder
from slamhive.services.archive import dataset_from_line, search_from_line
from slamhive.services.configurations import general_names, with_general_names
from slamhive.services.datasets import Catalogue
from slamhive.services.ledger.book import (
    NOT_A_LINE,
    Book,
    LedgerConfiguration,
    LedgerEvaluations,
    LedgerFiles,
    LedgerRun,
    Line,
    cells_of,
    configurations_of,
    last_shared,
    live_configurations,
    read_evaluations,
    runs_of,
)
from slamhive.services.runs import dataset_of
from slamhive.store import Store, Transaction
from slamhive.store.filed_runs import FiledRun
from slamhive.store.records import AlgorithmVersion, NewConfiguration, RunFields, RunSnapshot, VersionRecord
from slamhive.store.runs import queued_event

_AT_ONCE = 500
_VERSION_FIELDS = ("number", "identity", "package_hash", "version", "created_at", "removed_at")


@dataclass
class _Cancelled:
    """Runs that were cancelled while they waited, with time and reason; and active runs that have to end."""

    waiting: dict[int, tuple[datetime, str]] = field(default_factory=dict)
    active: list[int] = field(default_factory=list)


class LedgerRestore:
    """Restores the content of the ledger. Between its steps, the caller files the folders of experiments and runs.

    Args:
        store: To be filled.
        catalogue: The algorithms and datasets that are here.
        files: The ledger.
        runs_folder: Where the folders of runs lie; what they say counts more than the ledger.
    """

    def __init__(self, store: Store, catalogue: Catalogue, files: LedgerFiles, runs_folder: Path) -> None:
        self._runs_folder = runs_folder
        self._store = store
        self._catalogue = catalogue
        self._files = files
        self._numbers: dict[int, int] = {}
        self.later: dict[int, int] = {}
        """Runs that repeat others which are not filed yet: {number: number of the other}."""
        self._unnumbered: list[tuple[str, VersionRow]] = []
        self.problems: list[str] = []

    @cached_property
    def evaluations(self) -> LedgerEvaluations:
        """All evaluations of the ledger."""
        return read_evaluations(self._files.evaluations.read())

    # -- before the folders ----------------------------------------------------------------------------------------

    def restore_before_runs(self) -> None:
        """Add the algorithms, datasets and configurations that runs refer to."""
        for line in self._files.catalogue.read():
            self._guarded(self._files.catalogue, lambda: self._restore_catalogue(line))  # noqa: B023
        last = live_configurations(self._files.configurations)
        entries = self._configurations(last)
        while part := list(islice(entries, _AT_ONCE)):
            self._restore_configurations(part)

    def restore_cells(self) -> None:
        """The cells of experiments whose rows are there."""
        experiments = self._experiments()
        for line in self._files.cells.read():
            experiment = experiments.get(str(line.get("experiment")))
            if experiment is not None:
                self._guarded(self._files.cells, lambda: self._restore_cells(line, experiment))  # noqa: B023

    # -- after the folders -----------------------------------------------------------------------------------------

    def restore_after_runs(self) -> int:
        """Runs without a folder, sizes of experiments, evaluations, labels and searches; how many runs there were."""
        self._versions()
        restored = self._runs()
        self._store.write(lambda t: t.ledger.repeat(self.later))
        # Experiments are complete if all their cells and runs are restored.
        told = {str(line.get("experiment")): line["size"] for line in self._files.cells.read() if "size" in line}

        def work(t: Transaction) -> None:
            rows = t.ledger
            stored = rows.stored_cells()
            for number, uid in rows.experiments().items():
                size = told.get(uid, {})
                runs = len(t.experiments.run_ids(number))
                if size.get("complete") and stored.get(uid, 0) == size["cells"] and runs >= size["runs"]:
                    t.experiments.change(number, cells=size["cells"], runs=size["runs"], complete=True)

        self._store.write(work)
        self._labels()
        for line in self._files.searches.read():
            self._guarded(self._files.searches, lambda: self._search(line))  # noqa: B023
        return restored

    def restore_evaluations(self) -> None:
        """Queue again the evaluations that had not ended."""

        def work(t: Transaction) -> None:
            for asked in self.evaluations.open():
                protocol_id = t.catalogue.put_protocol(asked.protocol)
                t.ledger.queue_evaluations(asked, protocol_id)

        self._store.write(work)

    # -- algorithms, datasets, configurations ----------------------------------------------------------------------

    def _restore_catalogue(self, line: Line) -> None:
        if "dataset" in line:
            name, values = dataset_from_line(line["dataset"])
            row = {**values, "folder": str(line["folder"])}
            self._store.write(lambda t: t.archive.dataset_if_absent(name, row))
            return
        if "versions_of" in line:
            version = VersionLine.read(line)
            record = VersionRecord(version.versions_of, **{name: getattr(version, name) for name in _VERSION_FIELDS})
            self._store.write(lambda t: t.versions.restore(record))
            return
        stated = LedgerAlgorithmLine.read(line)
        self._unnumbered += [(stated.package, entry) for entry in stated.versions]
        self._store.write(lambda t: t.archive.algorithm_if_absent(stated.algorithm, stated.package, stated.mode))

    def _configurations(self, last: Mapping[int, int]) -> Iterator[LedgerConfiguration]:
        book = self._files.configurations
        for number, line in enumerate(book.read()):
            found: list[LedgerConfiguration] = []
            self._guarded(book, lambda: found.extend(configurations_of(line)))  # noqa: B023
            yield from (entry for entry in found if last.get(entry.id) == number)

    def _restore_configurations(self, part: list[LedgerConfiguration]) -> None:
        names = general_names(self._catalogue)
        gone = {name: dataset_of(self._catalogue, name, {}) for name in {e.configuration.dataset for e in part}}
        now = utc_now()

        def work(t: Transaction) -> dict[int, int]:
            algorithms = {record.name: record.id for record in t.catalogue.algorithms()}
            for name in {entry.configuration.algorithm for entry in part} - algorithms.keys():
                algorithms[name] = t.catalogue.put_algorithm_named(name, name, "")
            datasets = {record.name: record.id for record in t.catalogue.datasets()}
            for name in gone.keys() - datasets.keys():
                datasets[name] = t.catalogue.put_dataset(gone[name], now)
            entries = {
                entry.id: NewConfiguration(
                    entry.configuration,
                    entry.configuration.content_hash,
                    algorithms[entry.configuration.algorithm],
                    datasets[entry.configuration.dataset],
                    with_general_names(entry.configuration.algorithm, entry.definitions, names),
                )
                for entry in part
            }
            times = {entry.id: entry.created_at for entry in part}
            return t.ledger.restore_configurations(entries, times)

        self._numbers.update(self._store.write(work))

    # -- experiments and runs --------------------------------------------------------------------------------------

    def _experiments(self) -> dict[str, int]:
        """{uid: number}."""
        found = self._store.read(lambda t: t.ledger.experiments())
        return {uid: number for number, uid in found.items()}

    def _restore_cells(self, line: Line, experiment: int) -> None:
        cells = [
            replace(cell, configuration_id=self._numbers[cell.configuration_id])
            for cell in cells_of(line)
            if cell.configuration_id in self._numbers
        ]
        self._store.write(lambda t: t.archive.add_cells(experiment, cells))

    def _runs(self) -> int:
        """The runs that have no folder."""
        cancelled = self._cancelled()
        shared = last_shared(self._files.runs)
        experiments = self._experiments()
        restored = 0
        for line in self._files.runs.read():
            found: list[LedgerRun] = []
            self._guarded(self._files.runs, lambda: found.extend(runs_of(line)))  # noqa: B023
            for place, run in enumerate(found):
                if (said := shared.get(run.id)) is not None:  # shared while it waited
                    request = replace(run.request, owner=said.owner, visibility=said.visibility)
                    found[place] = replace(run, request=request)
            for start in range(0, len(found), _AT_ONCE):
                restored += self._restore_runs(found[start : start + _AT_ONCE], experiments, cancelled)
        self._store.write(lambda t: t.ledger.ask_to_end(cancelled.active))
        self._share({run: said for run, said in shared.items() if not self._folder(run).record.exists()})
        return restored

    def _share(self, shared: Mapping[int, Sharing]) -> None:
        """Let rows without a folder say who owns and sees their runs, as the ledger does."""

        def work(t: Transaction, part: Sequence[int]) -> None:
            here = t.ledger.requests(part)
            # A run of an experiment belongs to its owner.
            t.sharing.share_runs(
                {
                    row.id: shared[row.id]
                    if row.content.experiment_id is None
                    else replace(shared[row.id], owner=row.content.owner)
                    for row in here
                }
            )

        numbers = sorted(shared)
        for start in range(0, len(numbers), _AT_ONCE):
            part = numbers[start : start + _AT_ONCE]
            self._store.write(lambda t: work(t, part))  # noqa: B023

    def _folder(self, run_id: int) -> RunFolder:
        return RunFolder(self._runs_folder / str(run_id))

    def _cancelled(self) -> _Cancelled:
        found = _Cancelled()
        for line in self._files.runs.read():
            if "cancelled" in line:
                stated = CancelledLine.read(line)
                found.waiting.update(dict.fromkeys(stated.cancelled, (stated.at, stated.why)))
            found.active += line.get("asked_to_end", ())
        return found

    def _restore_runs(self, part: list[LedgerRun], experiments: Mapping[str, int], cancelled: _Cancelled) -> int:
        def work(t: Transaction) -> tuple[int, dict[int, int]]:
            rows = t.ledger
            unknown = rows.unknown([run.id for run in part], [run.request.uid for run in part])
            new = [run for run in part if run.id in unknown and run.request.configuration_id in self._numbers]
            filed = []
            for run in new:
                experiment_id = None if run.experiment is None else experiments.get(run.experiment)
                request = replace(
                    run.request,
                    configuration_id=self._numbers[run.request.configuration_id],
                    experiment_id=experiment_id,
                    cell=None if experiment_id is None else run.request.cell,
                )
                state, fields, events = RunState.QUEUED, RunFields(), [queued_event(request, run.created_at)]
                if run.id in cancelled.waiting:
                    at, why = cancelled.waiting[run.id]
                    state, fields = RunState.CANCELLED, RunFields(ended_at=at)
                    events.append(RunEvent(at, RunState.QUEUED, state, why))
                snapshot = RunSnapshot(run.id, request, state, run.created_at, fields, 0, tuple(events))
                filed.append(FiledRun(snapshot))
            for run in part:
                if run.id not in unknown and run.id in cancelled.waiting:
                    rows.cancel_if_queued(run.id, *cancelled.waiting[run.id])
            return len(new), t.filed_runs.file(filed)

        count, left = self._store.write(work)
        self.later.update(left)
        return count

    def _versions(self) -> None:
        """Versions that an older ledger lists without a number: after those of runs, in the order of their times."""

        def work(t: Transaction) -> None:
            for package, entry in sorted(self._unnumbered, key=lambda found: found[1].created_at):
                version = AlgorithmVersion(entry.identity, entry.package_hash, entry.version)
                t.versions.put(package, version, entry.created_at)

        self._store.write(work)

    # -- what users have said --------------------------------------------------------------------------------------

    def _labels(self) -> None:
        said: dict[int, Line] = {}
        for line in self._files.configurations.read():
            if "label" in line:
                said[line["label"]] = line
            for gone in line.get("deleted", ()):
                said.pop(gone, None)
        for number, line in said.items():
            if number in self._numbers:
                self._guarded(self._files.configurations, lambda: self._label(self._numbers[number], line))  # noqa: B023

    def _label(self, number: int, line: Line) -> None:
        stated = LabelLine.read(line)

        def work(t: Transaction) -> None:
            here = t.configuration_book.get(number)
            name, note = here.name or stated.name, here.note or stated.note
            if (name, note) != (here.name, here.note):
                t.configuration_book.describe(number, name, note)
            for group in stated.groups:
                t.configuration_book.add_to_group(group, [number])

        self._store.write(work)

    def _search(self, line: Line) -> None:
        record, at = search_from_line(line)
        self._store.write(lambda t: t.archive.saved_search_if_absent(record, at))

    def _guarded(self, book: Book, work: Callable[[], Any]) -> None:
        """Note the problem of a line that is damaged or contradicts the database, and go on with the others."""
        try:
            work()
        except (SlamHiveError, *NOT_A_LINE) as error:
            detail = str(error) if isinstance(error, SlamHiveError) else repr(error)
            self.problems.append(f"{book.path.name}: {detail}")
