"""Reading an archive from an untrusted source: all of it is checked before any of it is used."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import struct
import zipfile
import zlib
from calendar import timegm
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO, Any

from slamhive.base.bounds import parse_json_object
from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.base.files import temporary_folder
from slamhive.documents.archive import AlgorithmLine, ArchiveManifest, RunLine
from slamhive.documents.record import RunFile
from slamhive.domain.dataset import Dataset
from slamhive.domain.names import check_name, plural
from slamhive.downloads.unpack import UnpackLimits, zip_directory_bytes
from slamhive.experiments.file import parse_experiment
from slamhive.packages.dataset_file import DATASET_FILE, load_dataset
from slamhive.recordings.staging import PLAY_SCRIPT
from slamhive.run_folder.folder import travels
from slamhive.services.archive import layout, writing
from slamhive.services.archive.layout import (
    FIRST,
    LARGEST_DIRECTORY_BYTES,
    LARGEST_RATIO,
    LARGEST_TEXT_BYTES,
    ROWS,
    TAG_CHECKSUMS,
    format_of,
    shown,
)
from slamhive.services.datasets import REPORT_FILE, TRIAL_FILE
from slamhive.services.experiments import RECORD, SOURCE
from slamhive.store.records import ExperimentRecord

_BLOCK_BYTES = 1 << 20
_SUM = re.compile(r"([0-9a-f]{64})  (.+)")
_ENCRYPTED = 0x1
_REFUSED = "nothing of it is imported"
_DAMAGED = "fetch or export it again"
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error)
"""What :mod:`zipfile` raises for a damaged or hostile file."""

Progress = Callable[[int, int], None]
"""Called with how much is done, and how much there is."""
Place = Callable[[str], Path | None]
"""Where to unpack a member, by its name; None to leave it packed."""


def not_unpacked(_name: str) -> None:
    """A :data:`Place` that leaves everything packed."""


class ArchiveReader:
    """An archive whose list of members was checked; its content is trustworthy only after :meth:`verify`.

    Args:
        file: The open zip file.
        path: For messages.
    """

    def __init__(self, file: zipfile.ZipFile, path: Path) -> None:
        self._file = file
        self._path = path
        self._format = format_of([info.orig_filename for info in file.infolist()])

        # No export writes a member twice, one file below another, or members that overlap.
        members: dict[str, zipfile.ZipInfo] = {}
        for info in file.infolist():
            name = self._format.member(info.orig_filename)
            if name in members:
                raise InvalidInput(f"{path} has {shown(name)} twice", _REFUSED)
            _check_kind(info, path)
            members[name] = info
        for name in members:
            inside = next((str(folder) for folder in PurePosixPath(name).parents if str(folder) in members), None)
            if inside is not None:
                raise InvalidInput(f"{path}: {shown(inside)} is a file and a folder at once", _REFUSED)
        size_bytes, total_bytes = path.stat().st_size, sum(info.file_size for info in members.values())
        if sum(info.compress_size for info in members.values()) > size_bytes:
            raise InvalidInput(f"{path}: its members overlap", _REFUSED)
        most_bytes = UnpackLimits().bytes_of(size_bytes)
        if total_bytes > most_bytes:
            problem = f"{path} holds {total_bytes / 1e6:,.0f} MB, more than {most_bytes / 1e6:,.0f} MB"
            raise InvalidInput(f"{problem}: it looks like a bomb", _REFUSED)
        for name in (self._format.about, *sorted(self._format.tags), *ROWS):
            if name not in members:
                raise InvalidInput(f"{path} lacks {name}", "make an archive with slamhive archive export")

        self._members = members
        self.manifest: ArchiveManifest = self._format.manifest(self.read(self._format.about))

    @property
    def names(self) -> list[str]:
        """All members, sorted."""
        return sorted(self._members)

    @property
    def size_bytes(self) -> int:
        """Size of all members once they are unpacked."""
        return sum(info.file_size for info in self._members.values())

    def files_of_runs(self) -> Counter[int]:
        """The number of files of each run, by its number in the archive."""
        return Counter(int(name.split("/", 2)[1]) for name in self._members if name.startswith("runs/"))

    def below(self, prefix: str) -> list[str]:
        """The members whose name begins with ``prefix``."""
        return [name for name in self._members if name.startswith(prefix)]

    def has(self, name: str) -> bool:
        """Tell if there is a member of this name."""
        return name in self._members

    def read(self, name: str) -> bytes:
        """A member as a whole; raises InvalidInput if it is missing, damaged or too large for that."""
        info = self._members.get(name)
        if info is None:
            raise InvalidInput(f"{self._path} lacks {name}", _DAMAGED)
        if info.file_size > LARGEST_TEXT_BYTES:
            raise InvalidInput(f"{self._path}: {shown(name)} has {info.file_size} bytes, too many for its kind")
        return b"".join(self._blocks(name))

    def json(self, name: str) -> dict[str, Any]:
        """A member that holds a JSON object."""
        return parse_json_object(self.read(name), f"{self._path}: {shown(name)}", recorded=True)

    def lines(self, name: str) -> Iterator[dict[str, Any]]:
        """The lines of a member of :data:`slamhive.services.archive.layout.ROWS`, each a JSON object."""
        number = 0
        with self._opened(name) as stream:
            while line := stream.readline(LARGEST_TEXT_BYTES):
                number += 1
                yield parse_json_object(line, f"{self._path}: line {number} of {name}", recorded=True)

    def unpack(self, name: str, target: Path) -> None:
        """Write a member to the new file ``target``, with the time that it was changed."""
        for _ in self._unpacked(name, target):
            pass

    def verify(self, progress: Progress, place: Place = not_unpacked) -> None:
        """Read every member and compare it with its checksum; raises InvalidInput for the first that differs.

        Args:
            progress: Called with bytes.
            place: Which members are unpacked meanwhile, and where to.
        """
        if self._format.number == 1:
            tags = {FIRST.checksums: str(self.manifest.checksums)}
        else:
            tags = self._listed(TAG_CHECKSUMS)
            self._check_names(tags, self._format.tags - {TAG_CHECKSUMS}, TAG_CHECKSUMS)
        for name, checksum in tags.items():
            digest = hashlib.sha256()
            for block in self._blocks(name):
                digest.update(block)
            self._compare(name, digest.hexdigest(), checksum)
        listed = self._listed(self._format.checksums)
        payload = [name for name in self._members if name not in self._format.tags]
        self._check_names(listed, map(self._format.listed_as, payload), self._format.checksums)
        sums = {name: listed[self._format.listed_as(name)] for name in payload}  # in the order of the zip file
        total, done = self.size_bytes, 0
        for name, expected in sums.items():
            digest = hashlib.sha256()
            target = place(name)
            for block in self._blocks(name) if target is None else self._unpacked(name, target):
                digest.update(block)
                done += len(block)
            self._compare(name, digest.hexdigest(), expected)
            progress(done, total)

    def _unpacked(self, name: str, target: Path) -> Iterator[bytes]:
        """The blocks of a member, once each has been written."""
        try:
            stream = target.open("xb")
        except FileNotFoundError:
            target.parent.mkdir(parents=True)
            stream = target.open("xb")
        with stream:
            for block in self._blocks(name):
                stream.write(block)
                yield block
        at = timegm((*self._members[name].date_time, 0, 0, 0))
        os.utime(target, (at, at))

    def _check_names(self, listed: Iterable[str], present: Iterable[str], source: str) -> None:
        present = set(present)
        for name in present.symmetric_difference(listed):
            where = f"is not in {source}, so it was added" if name in present else "is missing"
            raise InvalidInput(f"{self._path}: {shown(name)} {where}", _DAMAGED)

    def _listed(self, name: str) -> dict[str, str]:
        """The lines of a list of checksums: {name as it is written: checksum}."""
        sums: dict[str, str] = {}
        with self._opened(name) as stream:
            while line := stream.readline(LARGEST_TEXT_BYTES):
                found = _SUM.fullmatch(line.decode(errors="replace").rstrip("\n"))
                if found is None or found[2] in sums:
                    raise InvalidInput(f"{self._path}: {name} is not what an export writes", _DAMAGED)
                sums[found[2]] = found[1]
        return sums

    def _compare(self, name: str, found: str, expected: str) -> None:
        if found != expected:
            raise InvalidInput(f"{self._path}: {shown(name)} is not what was exported", _DAMAGED)

    def _blocks(self, name: str) -> Iterator[bytes]:
        with self._opened(name) as stream:
            while block := stream.read(_BLOCK_BYTES):
                yield block

    @contextmanager
    def _opened(self, name: str) -> Iterator[IO[bytes]]:
        if name not in self._members:
            raise InvalidInput(f"{self._path} lacks {name}", _DAMAGED)
        try:
            with self._file.open(self._members[name]) as stream:
                yield stream
        except (*_BROKEN, OSError) as error:  # a place before the beginning of the file is an OSError
            raise InvalidInput(f"{self._path}: {shown(name)} is damaged: {error}", _DAMAGED) from None


@contextmanager
def open_archive(path: Path) -> Iterator[ArchiveReader]:
    """Open the archive at ``path``; raises NotFound, Unavailable, or InvalidInput unless an export wrote it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise NotFound(f"{path} does not exist") from None
    except OSError as error:
        raise Unavailable(f"{path} cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InvalidInput(f"{path} is not a file", "give a file that slamhive archive export has written")
    with os.fdopen(descriptor, "rb") as stream:
        # Refuse a file that is no zip file, was cut short, or whose list of members is too long for memory.
        size = zip_directory_bytes(stream)
        if size is None:
            raise InvalidInput(f"{path} is not an archive, or was cut short", _DAMAGED)
        if size > LARGEST_DIRECTORY_BYTES:
            raise InvalidInput(f"{path} lists its members in {size} bytes, more than any export writes")
        stream.seek(0)
        try:
            file = zipfile.ZipFile(stream)
        except _BROKEN as error:
            raise InvalidInput(f"{path} is damaged: {error}", _DAMAGED) from None
        with file:
            yield ArchiveReader(file, path)


def _check_kind(info: zipfile.ZipInfo, path: Path) -> None:
    """Refuse links, encrypted members, other ways of packing, and impossible sizes."""
    name = shown(info.orig_filename)
    if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
        raise InvalidInput(f"{path}: {name} is a link or no file", _REFUSED)
    if info.flag_bits & _ENCRYPTED or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InvalidInput(f"{path}: {name} is encrypted or packed in a way that no export uses", _REFUSED)
    if info.file_size > LARGEST_RATIO * max(info.compress_size, 1):
        raise InvalidInput(f"{path}: {name} claims {info.file_size} bytes, more than it can hold", _REFUSED)


_MOST_SHOWN = 5

CheckProgress = Callable[[float, str], None]
"""Called with the share done (0..1) and what is being done."""


@dataclass
class Contents:
    """Knowledge of an archive that was checked.

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


def check_archive(archive: ArchiveReader, progress: CheckProgress, place: Place = not_unpacked) -> Contents:
    """Compare every member with its checksum and read every row; raises InvalidInput for the first that is wrong.

    Members for which ``place`` returns a path are unpacked on the way.
    """
    archive.verify(lambda done, total: progress(0.8 * done / max(total, 1), "comparing checksums"), place)
    contents = Contents()
    expected = max(archive.manifest.counts.get("runs", 0), 1)
    numbers: set[int] = set()
    for run, _ in recorded_runs(archive):
        if run.uid in contents.runs or run.id in numbers:
            raise InvalidInput(f"the archive has run {run.id} twice", "export it again")
        contents.runs[run.uid] = run.id
        numbers.add(run.id)
        if run.experiment is not None:
            name = check_name("experiment", run.experiment)
            contents.runs_of_experiment[name] = contents.runs_of_experiment.get(name, 0) + 1
        progress(0.8 + 0.2 * min(len(numbers) / expected, 1.0), "reading records")
    if len(numbers) != archive.manifest.counts.get("runs", 0):
        raise InvalidInput(f"the archive has {len(numbers)} runs and says to have another number", "export it again")
    described = [writing.dataset_from_line(content)[0] for content in archive.lines(layout.DATASETS)]
    contents.datasets.update({name: archived_dataset(archive, name) for name in described})
    algorithms = {writing.read_line(AlgorithmLine, content).name for content in archive.lines(layout.ALGORITHMS)}
    configurations = set()
    for content in archive.lines(layout.CONFIGURATIONS):
        line = writing.configuration_from_line(content)
        if line.configuration.algorithm not in algorithms or line.configuration.dataset not in contents.datasets:
            raise InvalidInput(f"configuration {line.id} of the archive refers to what it lacks", "export it again")
        configurations.add(line.id)
    contents.experiments = [writing.experiment_from_line(content) for content in archive.lines(layout.EXPERIMENTS)]
    names = {record.name for record in contents.experiments}
    if len(names) < len(contents.experiments):
        raise InvalidInput("the archive has two experiments of one name", "export it again")
    for record in contents.experiments:
        parse_experiment(record.source, f"experiment {record.name} of the archive")
    cells: set[tuple[str, int]] = set()
    for content in archive.lines(layout.CELLS):
        experiment, cell = writing.cell_from_line(content)
        if (experiment, cell.number) in cells:
            raise InvalidInput(f"the archive has cell {cell.number} of {experiment[:64]} twice", "export it again")
        cells.add((experiment, cell.number))
        if experiment not in names or cell.configuration_id not in configurations:
            raise InvalidInput(f"a cell of the archive refers to what it lacks: {experiment[:64]}, {cell.name}")
    for content in archive.lines(layout.SEARCHES):
        writing.search_from_line(content)
    for content in archive.lines(layout.ANALYSES):
        writing.analysis_from_line(content)
    _check_folders(archive, contents, names)
    return contents


def recorded_runs(archive: ArchiveReader) -> Iterator[tuple[RunLine, RunFile]]:
    """Every run with its record; raises InvalidInput for one that is not whole."""
    for content in archive.lines(layout.RUNS):
        line = writing.read_line(RunLine, content)
        record = archive.json(f"runs/{line.id}/run.json") if line.record is None else line.record
        yield line, writing.check_record(record, line)


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
        dataset = datasets.get(rest[0]) if kind == "datasets" and rest else None
        known = (kind == "runs" and int(rest[0]) in numbers and travels(file)) or (
            kind == "experiments" and rest[0] in experiments and file in (SOURCE, RECORD)
        )
        # Archives hold the files of a dataset that its description names, and its recording. What a check has found,
        # and the script that plays the recording in a run, are always those of the installation.
        if dataset is not None and file not in (REPORT_FILE, TRIAL_FILE, PLAY_SCRIPT):
            truth = dataset.groundtruth
            named = {DATASET_FILE, dataset.relations, *(() if truth is None else truth.files)}
            known = file in named or (bool(dataset.bag) and dataset.bag in (file, file.rpartition("/")[0]))
        if not rest or kind in ("rows", layout.VERSIONS) or known:
            continue
        if (kind == "runs" and int(rest[0]) in numbers) or (
            kind == "datasets" and rest[0] in datasets and "/" not in file
        ):
            contents.left_out.append(name)
        else:
            raise InvalidInput(f"{layout.shown(name)} belongs to nothing in the archive", "it is not imported")
