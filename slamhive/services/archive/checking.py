"""Everything in an archive that will be filed is read once before anything is filed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath

from slamhive.bags.staging import PLAY_SCRIPT
from slamhive.catalogue.dataset_file import DATASET_FILE, load_dataset
from slamhive.domain.dataset import Dataset
from slamhive.domain.names import check_name
from slamhive.domain.numbers import plural
from slamhive.errors import InvalidInput
from slamhive.files import temporary_folder
from slamhive.runs.folder import travels
from slamhive.schema.archive import AlgorithmLine, RunLine
from slamhive.schema.record import RunFile
from slamhive.services.archive import layout, lines
from slamhive.services.archive.reading import ArchiveReader, Place, not_unpacked
from slamhive.services.datasets import REPORT_FILE
from slamhive.services.experiments import RECORD, SOURCE
from slamhive.store.experiment_records import ExperimentRecord
from slamhive.sweep.experiment_file import parse_experiment

_MOST_SHOWN = 5

Progress = Callable[[float, str], None]
"""Called with the share done (0..1) and what is being done."""


@dataclass
class Contents:
    """What is known of an archive that was checked.

    Attributes:
        runs: {uid: number}.
        datasets: Those that are described, None for the others, by name.
        experiments: As they are stated.
        runs_of_experiment: {name: how many runs of it there are}.
        left_out: Members that are not taken over: no run folder or dataset has such a file, or it says what only the
            installation itself decides, such as who sees a run.
    """

    runs: dict[str, int] = field(default_factory=dict)
    datasets: dict[str, Dataset | None] = field(default_factory=dict)
    experiments: list[ExperimentRecord] = field(default_factory=list)
    runs_of_experiment: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    @property
    def note(self) -> str | None:
        """In words, what is not taken over; None if everything is."""
        if not self.left_out:
            return None
        shown = ", ".join(map(layout.shown, self.left_out[:_MOST_SHOWN]))
        more = f" and {len(self.left_out) - _MOST_SHOWN} more" if len(self.left_out) > _MOST_SHOWN else ""
        return f"{plural(len(self.left_out), 'file')} left out, which no export writes: {shown}{more}"


def check_archive(archive: ArchiveReader, progress: Progress, place: Place = not_unpacked) -> Contents:
    """Compare every member with its checksum and read every row; raises InvalidInput for the first that is wrong.

    Members for which ``place`` returns a path are unpacked on the way.
    """
    archive.verify(lambda done, total: progress(0.8 * done / max(total, 1), "comparing checksums"), place)
    contents = Contents()
    _check_runs(archive, contents, progress)
    _check_datasets(archive, contents)
    algorithms = {lines.read_line(AlgorithmLine, content).name for content in archive.lines(layout.ALGORITHMS)}
    configurations = set()
    for content in archive.lines(layout.CONFIGURATIONS):
        line = lines.configuration_from_line(content)
        if line.configuration.algorithm not in algorithms or line.configuration.dataset not in contents.datasets:
            raise InvalidInput(f"configuration {line.id} of the archive refers to what it lacks", "export it again")
        configurations.add(line.id)
    contents.experiments = [lines.experiment_from_line(content) for content in archive.lines(layout.EXPERIMENTS)]
    names = {record.name for record in contents.experiments}
    if len(names) < len(contents.experiments):
        raise InvalidInput("the archive has two experiments of one name", "export it again")
    for record in contents.experiments:
        parse_experiment(record.source, f"experiment {record.name} of the archive")
    cells: set[tuple[str, int]] = set()
    for content in archive.lines(layout.CELLS):
        experiment, cell = lines.cell_from_line(content)
        if (experiment, cell.number) in cells:
            raise InvalidInput(f"the archive has cell {cell.number} of {experiment[:64]} twice", "export it again")
        cells.add((experiment, cell.number))
        if experiment not in names or cell.configuration_id not in configurations:
            raise InvalidInput(f"a cell of the archive refers to what it lacks: {experiment[:64]}, {cell.name}")
    for content in archive.lines(layout.SEARCHES):
        lines.search_from_line(content)
    for content in archive.lines(layout.ANALYSES):
        lines.analysis_from_line(content)
    _check_folders(archive, contents, names)
    return contents


def _check_runs(archive: ArchiveReader, contents: Contents, progress: Progress) -> None:
    expected = max(archive.manifest.counts.get("runs", 0), 1)
    numbers: set[int] = set()
    for line, _ in recorded_runs(archive):
        if line.uid in contents.runs or line.id in numbers:
            raise InvalidInput(f"the archive has run {line.id} twice", "export it again")
        contents.runs[line.uid] = line.id
        numbers.add(line.id)
        if line.experiment is not None:
            name = check_name("experiment", line.experiment)
            contents.runs_of_experiment[name] = contents.runs_of_experiment.get(name, 0) + 1
        progress(0.8 + 0.2 * min(len(numbers) / expected, 1.0), "reading records")
    if len(numbers) != archive.manifest.counts.get("runs", 0):
        raise InvalidInput(f"the archive has {len(numbers)} runs and says to have another number", "export it again")


def recorded_runs(archive: ArchiveReader) -> Iterator[tuple[RunLine, RunFile]]:
    """Every run with its record; raises InvalidInput for one that is not whole."""
    for content in archive.lines(layout.RUNS):
        line = lines.read_line(RunLine, content)
        record = archive.json(f"runs/{line.id}/run.json") if line.record is None else line.record
        yield line, lines.check_record(record, line)


def _check_datasets(archive: ArchiveReader, contents: Contents) -> None:
    for content in archive.lines(layout.DATASETS):
        name, _ = lines.dataset_from_line(content)
        contents.datasets[name] = archived_dataset(archive, name)


def archived_dataset(archive: ArchiveReader, name: str) -> Dataset | None:
    """The dataset as the archive describes it, None if it does not; its folder does not exist. Raises InvalidInput."""
    description = f"datasets/{check_name('dataset', name)}/{DATASET_FILE}"
    if not archive.has(description):
        return None
    with temporary_folder() as folder:
        archive.unpack(description, folder / name / DATASET_FILE)
        dataset = load_dataset(folder / name)
    if dataset.name != name:
        raise InvalidInput(f"dataset {name} of the archive is described as {dataset.name}")
    return dataset


def _check_folders(archive: ArchiveReader, contents: Contents, experiments: set[str]) -> None:
    """Check that no member is outside the folders of what is filed, and note those that are not taken over."""
    numbers, datasets = set(contents.runs.values()), contents.datasets
    for name in archive.names:
        kind, *rest = PurePosixPath(name).parts
        file = "/".join(rest[1:])
        known = (
            (kind == "runs" and int(rest[0]) in numbers and travels(file))
            or (kind == "datasets" and rest[0] in datasets and _of_dataset(file, datasets[rest[0]]))
            or (kind == "experiments" and rest[0] in experiments and file in (SOURCE, RECORD))
        )
        if not rest or kind in ("rows", layout.VERSIONS) or known:
            continue
        if (kind == "runs" and int(rest[0]) in numbers) or (
            kind == "datasets" and rest[0] in datasets and "/" not in file
        ):
            contents.left_out.append(name)
        else:
            raise InvalidInput(f"{layout.shown(name)} belongs to nothing in the archive", "it is not imported")


def _of_dataset(file: str, dataset: Dataset | None) -> bool:
    """Return whether archives hold this file of a dataset: those that its description names, and its recording.

    What a check has found, and the script that plays the recording in a run, are always those of the installation.
    """
    if dataset is None or file in (REPORT_FILE, PLAY_SCRIPT):
        return False
    truth = dataset.groundtruth
    named = {DATASET_FILE, dataset.relations, *(() if truth is None else (truth.file, truth.kitti_poses))}
    return file in named or (bool(dataset.bag) and dataset.bag in (file, file.rpartition("/")[0]))
