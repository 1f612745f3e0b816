"""Importing an archive: merged with what is here, whole or completed by the same command, nothing twice.

Folders of runs are unpacked to a temporary place while their checksums are compared. When everything is intact, each
batch of runs is stored in one transaction, and then their folders are renamed into place. The same command completes
an import that was killed at any point.
"""

from __future__ import annotations

import secrets
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import count, islice
from pathlib import Path
from typing import Any, TypeVar

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import held_folder, remedy_of
from slamhive.base.settings import Settings
from slamhive.documents.archive import AlgorithmLine, AnalysisLine, ConfigurationLine, ExperimentLine, RunLine
from slamhive.domain.accounts import NO_SHARING, Sharing, Visibility, taken_over
from slamhive.domain.names import plural
from slamhive.domain.run import NO_NOTES
from slamhive.experiments.file import parse_experiment
from slamhive.packages.dataset_file import DATASET_FILE, load_dataset
from slamhive.recordings.staging import new_dataset_folder
from slamhive.run_folder.folder import RunFolder, travels
from slamhive.services.archive import layout, writing
from slamhive.services.archive.reading import ArchiveReader, CheckProgress, Contents, check_archive, open_archive
from slamhive.services.configurations import general_names, with_general_names
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.experiments import ExperimentFolder, StoredExperiment
from slamhive.services.imports import UNPACKED, one_import, sweep_imports
from slamhive.services.runs import (
    FolderRun,
    FoundEvaluation,
    current_protocol,
    file_runs,
    found_evaluations,
    found_notes,
    put_configurations,
    read_filed,
    snapshot_of,
)
from slamhive.services.stored_analyses import AnalysisFolder
from slamhive.store import Store, Transaction
from slamhive.store.durations import NOT_KNOWN
from slamhive.store.records import CellRecord, ExperimentRecord, ExperimentState, NewConfiguration

BATCH = 100
_CHECKING = 0.7
"""The share of the time that comparing checksums takes, unpacking on the way."""
_MB = 1_000_000


@dataclass
class ArchiveReport:
    """The result of an import: numbers of runs, and notes on what may be unexpected."""

    imported: int = 0
    known: int = 0
    completed: int = 0
    kept_numbers: bool = True
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Unpacked:
    """A run of the archive, unpacked aside (``folder`` None if it has no folder), with its ``run.json``."""

    line: RunLine
    run: FolderRun
    folder: RunFolder | None
    record: dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Ready:
    """Where folders of runs lie unpacked, and what the runs refer to."""

    aside: Path
    around: Surroundings


class ArchiveImport:
    """Imports archives into one installation.

    Args:
        settings: Mode and data root.
        store: Where rows are filed.
        catalogue: The algorithms that are here.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue

    def carry_out(self, path: Path, progress: CheckProgress) -> ArchiveReport:
        """Check the archive as a whole, then import it.

        Raises:
            InvalidInput: The archive is damaged, tampered with or none of ours; nothing has changed.
            Conflict: Another import files runs for long.
            Unavailable: The disk or the database refuses; what was imported until then stays.
        """
        check_writable(self._settings)
        report = ArchiveReport()
        with open_archive(path) as archive:
            self._check_size(archive, path)
            with self._aside() as aside:
                wanted = self._wanted(archive)

                def place(name: str) -> Path | None:
                    kind, _, below = name.partition("/")
                    number, _, file = below.partition("/")
                    return aside / below if kind == "runs" and int(number) in wanted and travels(file) else None

                try:
                    contents = check_archive(archive, lambda share, text: progress(_CHECKING * share, text), place)
                except OSError as error:
                    raise Unavailable(
                        f"{aside} cannot be written: {error.strerror}", "check space and rights"
                    ) from None
                report.notes += [note for note in (contents.note, _publicly_seen(archive)) if note is not None]
                around = Surroundings(self._settings, self._store, self._catalogue, archive, contents, report.notes)
                with self._alone(contents, progress):
                    around.import_before_runs(report.counts)
                self._runs(archive, contents, _Ready(aside, around), report, progress)
                with self._alone(contents, progress):
                    around.import_after_runs(report.counts, kept_numbers=report.kept_numbers)
        self._store.recheck()
        self._store.refresh_statistics()
        return report

    def _check_size(self, archive: ArchiveReader, path: Path) -> None:
        """Refuse runs with more files than a run may have here, and what there is no room for."""
        for number, files in archive.files_of_runs().items():
            if files > self._settings.run_files:
                raise InvalidInput(
                    f"{path}: run {number} has {files:,} files, more than {self._settings.run_files:,}",
                    "raise RUN_FILES if you trust it",
                )
        free = shutil.disk_usage(self._settings.data).free
        needed = archive.size_bytes + self._settings.min_free_disk_mb * _MB
        if free < needed:
            raise Unavailable(
                f"{self._settings.data} has {free / _MB:.0f} MB free, the archive needs {needed / _MB:.0f} MB",
                "free some space, or move the data root (SLAMHIVE_DATA)",
            )

    def _wanted(self, archive: ArchiveReader) -> set[int]:
        """The runs, by their numbers in the archive, whose folders are not here. Nothing of it has been checked yet."""
        with_folder = {
            line.uid: line.id
            for line in (writing.read_line(RunLine, content) for content in archive.lines(layout.RUNS))
            if line.record is None
        }
        known = self._store.read(lambda t: t.runs.ids_by_uid(list(with_folder)))
        lacking = self._lacking(known.values())
        return {number for uid, number in with_folder.items() if uid not in known or known[uid] in lacking}

    @contextmanager
    def _aside(self) -> Iterator[Path]:
        """The folder for what is unpacked. It is held, so that only that of a killed import is removed."""
        runs = self._settings.runs_folder
        sweep_imports(runs)
        root = runs / f"{UNPACKED}-{secrets.token_hex(8)}"
        with ExitStack() as held:
            held.callback(shutil.rmtree, root, ignore_errors=True)
            try:
                held.enter_context(held_folder(root))
            except OSError as error:
                raise Unavailable(f"{root} cannot be made: {error.strerror}", remedy_of(error)) from None
            yield root

    def _alone(self, contents: Contents, progress: CheckProgress) -> AbstractContextManager[None]:
        """The turn of this import to file something."""
        what = f"an archive of {plural(len(contents.runs), 'run')}"
        return one_import(self._settings.runs_folder, what, lambda text: progress(_CHECKING, text))

    # -- runs ------------------------------------------------------------------------------------------------------

    def _runs(
        self, archive: ArchiveReader, contents: Contents, ready: _Ready, report: ArchiveReport, progress: CheckProgress
    ) -> None:
        known = self._store.read(lambda t: t.runs.ids_by_uid(list(contents.runs)))
        numbers = dict(known)
        others = self._store.read(lambda t: t.searches.total()) > len(known)
        report.kept_numbers = not others and all(contents.runs[uid] == number for uid, number in known.items())
        stream = iter(archive.lines(layout.RUNS))
        done = 0
        while batch := [writing.read_line(RunLine, content) for content in islice(stream, BATCH)]:
            with self._alone(contents, progress):
                # Other imports may have filed the same runs in between.
                numbers.update(self._store.read(lambda t: t.runs.ids_by_uid([line.uid for line in batch])))
                self._batch(batch, ready, numbers, report)
            done += len(batch)
            progress(_CHECKING + (1 - _CHECKING) * done / len(contents.runs), f"{done}/{len(contents.runs)} runs")

    def _batch(self, batch: list[RunLine], ready: _Ready, numbers: dict[str, int], report: ArchiveReport) -> None:
        lacking = self._lacking(numbers[line.uid] for line in batch if line.uid in numbers and line.record is None)
        wanted = [line for line in batch if line.uid not in numbers or numbers[line.uid] in lacking]
        report.known += len(batch) - len(wanted)
        shared = self._store.read(
            lambda t: t.sharing.of_runs([numbers[line.uid] for line in wanted if line.uid in numbers])
        )
        unpacked = [self._read(line, ready, shared.get(numbers.get(line.uid, 0))) for line in wanted]
        new = [entry for entry in unpacked if entry.line.uid not in numbers]
        report.completed += len(unpacked) - len(new)
        keep = report.kept_numbers and not any(self._folder(entry.line.id).root.exists() for entry in new)
        try:
            given = self._store.write(lambda t: _file(t, self._catalogue, new, numbers, keep=keep)) if new else {}
        except OverflowError:
            raise InvalidInput("a run of the archive holds a number that no database can hold") from None
        report.kept_numbers = report.kept_numbers and all(given[entry.line.uid] == entry.line.id for entry in new)
        numbers.update(given)
        report.imported += len(new)
        for entry in unpacked:
            if entry.folder is not None:
                self._put_in_place(entry, entry.folder, numbers)

    def _lacking(self, numbers: Iterable[int]) -> set[int]:
        """Those of these runs whose folder a killed import has left out.

        A run that waits here has no folder either; it must not get that of an archive that claims to hold it.
        """
        without = [number for number in numbers if not self._folder(number).record.exists()]
        return {run.id for run in self._store.read(lambda t: t.runs.get_many(without)) if run.state.ended}

    def _read(self, line: RunLine, ready: _Ready, here: Sharing | None) -> _Unpacked:
        """The run as it is filed; ``here`` is the owner and visibility of one that is only completed."""
        folder, record, found = None, line.record, []
        if record is None:
            folder = RunFolder(ready.aside / str(line.id))
            if not folder.record.exists():
                raise Conflict(f"run {line.id} of the archive was deleted here meanwhile", "import it again")
            record, found = folder.read_record(), found_evaluations(folder)
        experiment = ready.around.experiment_name(line.experiment)
        record = {**writing.without_handle(record), "request": {**record["request"], "experiment": experiment}}
        filed = read_filed(self._catalogue, record, f"the record of run {line.id}")
        notes = NO_NOTES if folder is None else found_notes(folder)
        shared = here or taken_over(self._store.maker, line.visibility, ready.around.seen_by(experiment))
        said = notes, None if shared == NO_SHARING else shared
        run = FolderRun(filed, found, _current(line, folder, found), writing.evaluations_of(line), line.attempt, *said)
        return _Unpacked(line, run, folder, record)

    def _put_in_place(self, entry: _Unpacked, folder: RunFolder, numbers: dict[str, int]) -> None:
        """Give the record its numbers here, and rename the folder."""
        target = self._folder(numbers[entry.line.uid]).root
        request = {**entry.record["request"], "retry_of": _original(entry, numbers)}
        record = {**entry.record, "id": numbers[entry.line.uid], "request": request}
        try:
            if record != folder.read_record():
                # Nobody sees the folder before it is renamed: no need to replace the file in one step.
                folder.record.write_text(RunFolder.record_text(record), encoding="utf-8")
            if entry.run.sharing is not None:
                folder.write_sharing(entry.run.sharing)
            folder.root.rename(target)
        except OSError as error:
            raise Unavailable(f"{target} cannot be made: {error.strerror}", "check space and rights") from None

    def _folder(self, number: int) -> RunFolder:
        return RunFolder(self._settings.runs_folder / str(number))


def _current(line: RunLine, folder: RunFolder | None, found: list[FoundEvaluation]) -> str | None:
    """The protocol that the run showed where it comes from, if its metrics were imported too."""
    if folder is None:
        return None
    done = {result.fingerprint for _, result, _ in found if result.succeeded}
    return line.current_protocol if line.current_protocol in done else current_protocol(folder, found)


def _publicly_seen(archive: ArchiveReader) -> str | None:
    """A note if the archive calls something public: who sees it here is decided here."""
    kinds: dict[str, tuple[str, type[RunLine | ExperimentLine | AnalysisLine]]] = {
        "run": (layout.RUNS, RunLine),
        "experiment": (layout.EXPERIMENTS, ExperimentLine),
        "analysis": (layout.ANALYSES, AnalysisLine),
    }
    counts = {
        kind: sum(writing.read_line(line, content).visibility is Visibility.PUBLIC for content in archive.lines(member))
        for kind, (member, line) in kinds.items()
    }
    if not any(counts.values()):
        return None
    found = ", ".join(
        plural(count, kind, "analyses" if kind == "analysis" else None) for kind, count in counts.items() if count
    )
    return f"{found} public where the archive comes from are seen here by those who sign in; share them to publish them"


def _original(entry: _Unpacked, numbers: dict[str, int]) -> int | None:
    """The number here of the run that this one repeats; None if it repeats none, or one that is not here."""
    return None if entry.line.retry_of is None else numbers.get(entry.line.retry_of)


def _file(
    t: Transaction, catalogue: Catalogue, entries: list[_Unpacked], known: dict[str, int], *, keep: bool
) -> dict[str, int]:
    """File runs with all that is known of them; {uid: number here}."""
    if not keep or t.archive.taken([entry.line.id for entry in entries]):
        # The rows get numbers of this installation here, and right after become what the records say.
        places = put_configurations(t, catalogue, [entry.run.filed for entry in entries])
        requests = [
            replace(snapshot_of(entry.run.filed.file, configuration_id).request, retry_of=None)
            for entry, (_, configuration_id) in zip(entries, places, strict=True)
        ]
        added = t.runs.add_runs(requests, utc_now())
        given = {entry.line.uid: number for entry, number in zip(entries, added, strict=True)}
    else:
        given = {entry.line.uid: entry.line.id for entry in entries}
    numbers = {**known, **given}
    renumbered: list[FolderRun] = []
    for entry in entries:
        filed = entry.run.filed
        request = filed.file.request.model_copy(update={"retry_of": _original(entry, numbers)})
        file = filed.file.model_copy(update={"id": numbers[entry.line.uid], "request": request})
        renumbered.append(replace(entry.run, filed=replace(filed, file=file)))
    file_runs(t, catalogue, renumbered)
    return given


# -- merge of everything that runs of an archive refer to with what is here; what is here stays as it is ---------------


T = TypeVar("T")
_CHUNK = 500
_LONGEST_NAME = 60


class Surroundings:
    """Datasets, algorithms, configurations, experiments and saved searches of one archive.

    Args:
        settings: Where folders lie.
        store: Where rows are filed.
        catalogue: The algorithms that are here.
        archive: Checked.
        contents: What the check found.
        notes: Gets a line for each thing that is not as in the archive.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        catalogue: Catalogue,
        archive: ArchiveReader,
        contents: Contents,
        notes: list[str],
    ) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._archive = archive
        self._contents = contents
        self._notes = notes
        self._experiment_names: dict[str, str] = {}
        self._seen_by: dict[str, Visibility] = {}
        self._configurations: dict[int, int] = {}

    def import_before_runs(self, counts: Counter[str]) -> None:
        """Everything that rows of runs refer to."""
        self._datasets(counts)
        self._algorithms()
        algorithms = {record.name: record.id for record in self._store.read(lambda t: t.catalogue.algorithms())}
        datasets = {record.name: record.id for record in self._store.read(lambda t: t.catalogue.datasets())}
        names = general_names(self._catalogue)
        for part in _batched(self._configuration_lines()):
            entries = [
                NewConfiguration(
                    line.configuration,
                    line.configuration.content_hash,
                    algorithms[line.configuration.algorithm],
                    datasets[line.configuration.dataset],
                    with_general_names(line.configuration.algorithm, line.definitions, names),
                )
                for line in part
            ]
            at = [line.created_at for line in part]
            found = self._store.write(lambda t: t.archive.put_configurations(entries, at))  # noqa: B023
            for line, (number, new) in zip(part, found, strict=True):
                self._configurations[line.id] = number
                counts["configurations"] += new
        for record in self._contents.experiments:
            self._experiment(record, counts)
        self._cells()

    def import_after_runs(self, counts: Counter[str], *, kept_numbers: bool) -> None:
        """Import what refers to runs. Analyses name runs by number: they come only where numbers are kept."""
        self._labels()
        if kept_numbers:
            self._analyses(counts)
        elif any(True for _ in self._archive.lines(layout.ANALYSES)):
            self._notes.append("the analyses of the archive are not imported: runs have other numbers here")
        known = {record.name: record for record in self._store.read(lambda t: t.searches.saved())}
        for content in self._archive.lines(layout.SEARCHES):
            record, at = writing.search_from_line(content)
            if record.name not in known:
                self._store.write(lambda t: t.archive.saved_search_if_absent(record, at))  # noqa: B023
                counts["saved_searches"] += 1
            elif known[record.name] != record:
                self._notes.append(f"the saved search {record.name} is another one here, and stays")

    def _analyses(self, counts: Counter[str]) -> None:
        """Under the addresses that they have, to be computed by the worker."""
        for content in self._archive.lines(layout.ANALYSES):
            stated, source = writing.analysis_from_line(content)
            shared = taken_over(self._store.maker, stated.visibility)
            record = replace(stated, owner=shared.owner, visibility=shared.visibility)
            folder = AnalysisFolder(self._settings.analyses_folder / record.token)
            if not folder.root.exists():
                folder.create(source, record)
                counts["analyses"] += 1
                self._store.write(lambda t: t.analyses.put(record))  # noqa: B023

    def experiment_name(self, name: str | None) -> str | None:
        """Return the name here of an experiment in the archive."""
        return None if name is None else self._experiment_names.get(name)

    def seen_by(self, experiment: str | None) -> Visibility | None:
        """The visibility of the experiment of this name here; None without one."""
        return None if experiment is None else self._seen_by.get(experiment)

    # -- datasets and algorithms -----------------------------------------------------------------------------------

    def _datasets(self, counts: Counter[str]) -> None:
        for content in self._archive.lines(layout.DATASETS):
            name, values = writing.dataset_from_line(content)
            counts["datasets"] += self._dataset_folder(name)
            folder = self._settings.datasets_folder / name
            values = {**values, "folder": str(folder)}
            self._store.write(lambda t: t.archive.dataset_if_absent(name, values))  # noqa: B023
            try:
                here = load_dataset(folder).checksum
            except SlamHiveError:
                continue
            if here != values["checksum"]:
                self._notes.append(f"dataset {name} is another one here: runs of the archive were made on theirs")

    def _dataset_folder(self, name: str) -> bool:
        """Make the folder, without the recording, if there is none; whether it was made."""
        members = sorted(set(self._archive.below(f"datasets/{name}/")).difference(self._contents.left_out))
        folder = self._settings.datasets_folder / name
        if folder.exists() or f"datasets/{name}/{DATASET_FILE}" not in members:
            return False
        with new_dataset_folder(folder, 0) as aside:
            for member in members:
                self._archive.unpack(member, aside / member.split("/", 2)[2])
        return True

    def _algorithms(self) -> None:
        known = [writing.read_line(AlgorithmLine, content) for content in self._archive.lines(layout.ALGORITHMS)]

        def work(t: Transaction) -> None:
            for line in known:
                t.archive.algorithm_if_absent(line.name, line.package, line.mode)

        self._store.write(work)

    # -- configurations --------------------------------------------------------------------------------------------

    def _configuration_lines(self) -> Iterator[ConfigurationLine]:
        for content in self._archive.lines(layout.CONFIGURATIONS):
            yield writing.configuration_from_line(content)

    def _labels(self) -> None:
        """Names, notes and groups; a name or note that is here already stays."""
        for line in self._configuration_lines():
            if line.name is None and not line.note and not line.groups:
                continue
            number = self._configurations[line.id]

            def work(t: Transaction, line: ConfigurationLine = line, number: int = number) -> str | None:
                here = t.configuration_book.get(number)
                for group in line.groups:
                    t.configuration_book.add_to_group(group, [number])
                name, note = here.name or line.name, here.note or line.note
                owner = None if name is None else t.configuration_book.named(name)
                taken = owner not in (None, number)
                t.configuration_book.describe(number, here.name if taken else name, note)
                return name if taken else None

            taken = self._store.write(work)
            if taken is not None:
                self._notes.append(f"configuration {number} has no name: {taken!r} belongs to another one here")

    # -- experiments -----------------------------------------------------------------------------------------------

    def _experiment(self, record: ExperimentRecord, counts: Counter[str]) -> None:
        here = self._store.read(lambda t: t.archive.experiment(record.uid))
        if here is not None:
            self._experiment_names[record.name] = here
            self._seen_by[here] = self._store.read(lambda t: t.experiments.get(here)).seen_by
            return
        for number in count(1):
            name = record.name if number == 1 else f"{record.name[:_LONGEST_NAME]}-{number}"
            stamp = ExperimentFolder(self._settings.experiments_folder / name).read()
            taken = self._store.read(lambda t: t.experiments.find(name))  # noqa: B023
            if taken is None and (stamp is None or stamp.uid == record.uid):
                break
        self._experiment_names[record.name] = name
        if name != record.name:
            self._notes.append(f"experiment {record.name} is called {name} here: there is another one of its name")
        shared = taken_over(self._store.maker, record.visibility)
        # Nothing of an experiment that is not whole must be queued again here.
        ended = record.complete and not record.undecided
        whole = ended and self._contents.runs_of_experiment.get(record.name, 0) >= record.runs
        settled = replace(
            record,
            name=name,
            state=record.state if whole else ExperimentState.CANCELLED,
            owner=shared.owner,
            visibility=shared.visibility,
        )
        if settled.state is not record.state:
            self._notes.append(f"experiment {name} counts as cancelled: the archive has not all of its runs")
        self._seen_by[name] = settled.seen_by
        same_cpu = parse_experiment(record.source, f"experiment {record.name} of the archive").same_cpu
        values = asdict(settled) | {"cpu_model": NOT_KNOWN if same_cpu else None}
        for key in ("id", "uid", "name"):
            del values[key]
        folder = ExperimentFolder(self._settings.experiments_folder / name)
        with folder.locked():
            folder.write(StoredExperiment.of(settled), record.source)
            self._store.write(lambda t: t.archive.put_experiment(record.uid, name, values))
        counts["experiments"] += 1

    def _cells(self) -> None:
        ids = {record.name: record.id for record in self._store.read(lambda t: t.experiments.all())}
        for part in _batched(self._archive.lines(layout.CELLS)):
            cells: dict[str, list[CellRecord]] = {}
            for content in part:
                name, cell = writing.cell_from_line(content)
                cells.setdefault(self._experiment_names[name], []).append(
                    replace(cell, configuration_id=self._configurations[cell.configuration_id])
                )

            def work(t: Transaction, cells: dict[str, list[CellRecord]] = cells) -> None:
                for name, entries in cells.items():
                    t.archive.add_cells(ids[name], entries)

            self._store.write(work)


def _batched(entries: Iterable[T]) -> Iterator[list[T]]:
    stream = iter(entries)
    while part := list(islice(stream, _CHUNK)):
        yield part
