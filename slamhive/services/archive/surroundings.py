"""Merge of everything that runs of an archive refer to with what is here; what is here stays as it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from itertools import count, islice
from typing import Any, TypeVar

from slamhive.base.errors import SlamHiveError
from slamhive.base.settings import Settings
from slamhive.documents.archive import AlgorithmLine, ConfigurationLine
from slamhive.domain.accounts import Visibility, taken_over
from slamhive.domain.parameters import Parameter
from slamhive.experiments.file import parse_experiment
from slamhive.packages.dataset_file import DATASET_FILE, load_dataset
from slamhive.recordings.staging import new_dataset_folder
from slamhive.services.archive import layout, writing
from slamhive.services.archive.reading import ArchiveReader, Contents
from slamhive.services.datasets import Catalogue
from slamhive.services.experiments import ExperimentFolder, StoredExperiment
from slamhive.services.stored_analyses import AnalysisFolder
from slamhive.store import Store, Transaction
from slamhive.store.records import ExperimentRecord, ExperimentState, NewCell, NewConfiguration
from slamhive.store.same_cpu import NOT_KNOWN

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
        aliases = {
            (algorithm.name, parameter.key): parameter.general
            for algorithm in self._catalogue.algorithms()
            for parameter in algorithm.parameters
        }
        for part in _batched(self._configuration_lines()):
            entries = [
                NewConfiguration(
                    line.configuration,
                    line.configuration.content_hash,
                    algorithms[line.configuration.algorithm],
                    datasets[line.configuration.dataset],
                    _definitions(line, aliases),
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
            cells: dict[str, list[NewCell]] = {}
            for content in part:
                name, cell = writing.cell_from_line(content)
                cells.setdefault(self._experiment_names[name], []).append(
                    replace(cell, configuration_id=self._configurations[cell.configuration_id])
                )

            def work(t: Transaction, cells: dict[str, list[NewCell]] = cells) -> None:
                for name, entries in cells.items():
                    t.archive.add_cells(ids[name], entries)

            self._store.write(work)


def _definitions(line: ConfigurationLine, aliases: dict[tuple[str, str], Any]) -> list[Parameter]:
    """Return the stored definitions of parameters; one that is defined here keeps its general name from here."""
    algorithm = line.configuration.algorithm
    return [replace(entry, general=aliases.get((algorithm, entry.key), entry.general)) for entry in line.definitions]


def _batched(entries: Iterable[T]) -> Iterator[list[T]]:
    stream = iter(entries)
    while part := list(islice(stream, _CHUNK)):
        yield part
