"""Find the files to import: those in a folder that match a pattern, or those named in a table."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import TypeVar

from slamhive.base.errors import InvalidInput, SlamHiveError, nearest
from slamhive.domain.names import check_name
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.reading import FIELDS, PathPattern
from slamhive.services.imports.request import FoundImports, ImportCandidate, ImportProblem, ImportRequest
from slamhive.trajectory.formats import pose_files
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit
from slamhive.trajectory.pose_file import TrajectoryFormat
from slamhive.trajectory.table import read_bounded

_NEEDED = ("algorithm", "dataset", "file")
_OPTIONAL = (
    *("trial", "sensors", "groundtruth", "relations", "times", "format", "time_unit", "quaternion_order"),
    *("groundtruth_time_unit", "groundtruth_quaternion_order", "columns", "image_times"),
)
_ONLY_TRIAL = "1"
_POSE_FILE = ".pose.txt"
_LONGEST_NAME_BYTES, _LONGEST_PATH = 255, 1024
_LINK = "is a link, and links are not followed; put the file there"
_UNPRINTABLE = "the name holds characters that cannot be printed; rename it"


def find(request: ImportRequest) -> FoundImports:
    """The files at the source, sorted by name; only a table is read.

    What cannot be imported is among the problems. Raises InvalidInput or NotFound if there is nothing to begin with.
    """
    found = FoundImports()
    for candidate in _in_table(request, found) if request.table else _in_folder(request, found):
        try:
            _check(candidate)
        except SlamHiveError as error:
            found.problems.append(ImportProblem(candidate.name, str(error)))
        else:
            found.candidates.append(candidate)
    names: dict[tuple[str, str, str], str] = {}
    candidates, found.candidates = found.candidates, []
    for candidate in candidates:
        first = names.setdefault((candidate.algorithm, candidate.dataset, candidate.trial), candidate.name)
        if first is candidate.name:
            found.candidates.append(candidate)
        else:
            text = f"trial {candidate.trial} of {candidate.algorithm} on {candidate.dataset} occurs twice"
            found.problems.append(ImportProblem(candidate.name, f"{text}: {first} is the other; number the trials"))
    return found


def parse_setup(text: str) -> SensorSetup:
    """The sensor setup called ``text``; raises InvalidInput with the nearest."""
    try:
        return SensorSetup(text)
    except ValueError:
        known = [setup.value for setup in SensorSetup]
        raise InvalidInput(f"unknown sensors {text!r}; {nearest(text, known)}") from None


def _in_folder(request: ImportRequest, found: FoundImports) -> Iterator[ImportCandidate]:
    root = request.source
    if not root.is_dir():
        raise InvalidInput(
            f"{root} is not a folder", "give the folder that holds the trajectories, or --table for a CSV"
        )
    pattern = PathPattern(request.pattern, needed=("algorithm", "dataset"))
    stamps: dict[str, Path] = {}
    beside = [
        (PathPattern(text, ("dataset",)), files)
        for text, files in (
            (request.ground_truth, found.truths),
            (request.relations, found.relations),
            (request.times, stamps),
            (request.image_times, found.image_times),
        )
    ]
    found.truth_told[""] = request.truth_told
    trajectories: list[tuple[str, Path]] = []
    for name, path in _files(root, found):
        place = next(((match, files) for kind, files in beside if (match := kind.match(name)) is not None), None)
        if place is None:
            trajectories.append((name, path))
        else:
            place[1][place[0].get("dataset", "")] = path
    for name, path in trajectories:
        match = pattern.match(name)
        if match is None:
            found.left_out.append(name)
        else:
            yield ImportCandidate(
                algorithm=match["algorithm"],
                dataset=match["dataset"],
                trial=match.get("trial", _ONLY_TRIAL),
                path=path,
                name=name,
                format=request.format,
                times=stamps.get(match["dataset"], stamps.get("")),
                told=request.told,
                columns=request.columns,
            )


def _files(root: Path, found: FoundImports) -> Iterator[tuple[str, Path]]:
    """All regular files below ``root``, and folders of poses. Links are not followed but reported.

    Hidden files are skipped.

    Names that cannot be printed (line ends, escape sequences, bytes that are no UTF-8) are problems: they would go into
    messages, the database and the record of the run.
    """
    for folder, folders, files in os.walk(root):
        if len(pose_files(Path(folder))) > 1:
            # a trajectory whose poses have a file each: its name is that of a file, for the pattern
            yield f"{Path(folder).relative_to(root).as_posix()}.txt", Path(folder)
            files[:] = [name for name in files if not name.endswith(_POSE_FILE)]
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted([*files, *folders]):
            path = Path(folder) / name
            relative = path.relative_to(root).as_posix()
            refusal = _LINK if path.is_symlink() else _UNPRINTABLE if not name.isprintable() else None
            if refusal is not None:
                found.problems.append(ImportProblem(_printable(relative), refusal))
                folders[:] = [entry for entry in folders if entry != name]
            elif name in files and not name.startswith("."):
                yield relative, path


def _printable(name: str) -> str:
    """``name`` with unprintable characters as escapes."""
    return name if name.isprintable() else repr(name)[1:-1]


def _in_table(request: ImportRequest, found: FoundImports) -> Iterator[ImportCandidate]:
    path = request.source
    try:
        text = read_bounded(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InvalidInput(f"{path} is not a text file", "save the table as CSV in UTF-8") from None
    reader = csv.DictReader(io.StringIO(text, newline=""))
    try:
        columns, rows = [name or "" for name in reader.fieldnames or []], list(reader)
    except csv.Error as error:
        raise InvalidInput(f"{path}, line {reader.line_num}: {error}", "save the table as CSV") from None
    for column in columns:
        if column not in (*_NEEDED, *_OPTIONAL):
            known = nearest(column, [*_NEEDED, *_OPTIONAL])
            raise InvalidInput(f"{path} has the unknown column {column[:40]!r}; {known}")
    for needed in _NEEDED:
        if needed not in columns:
            raise InvalidInput(f"{path} lacks the column {needed}", f"its first line has to name {', '.join(_NEEDED)}")
    for number, row in enumerate(rows, start=2):
        name = f"{path.name}, row {number}"
        try:
            yield _row(request, found, {key: (row.get(key) or "").strip() for key in columns}, name)
        except SlamHiveError as error:
            found.problems.append(ImportProblem(name, str(error)))


def _row(request: ImportRequest, found: FoundImports, row: dict[str, str], name: str) -> ImportCandidate:
    folder = request.source.parent
    algorithm, dataset = row["algorithm"], row["dataset"]
    if row.get("sensors"):
        setup = parse_setup(row["sensors"])
        if found.setups.setdefault(algorithm, setup) is not setup:
            raise InvalidInput(f"{algorithm} has the sensors {found.setups[algorithm].value} in a row above")
    for column, kind, files in (
        ("groundtruth", "ground truth", found.truths),
        ("relations", "relations", found.relations),
        ("image_times", "image times", found.image_times),
    ):
        if row.get(column):
            file = _inside(folder, row[column])
            if files.setdefault(dataset, file) != file:
                raise InvalidInput(f"dataset {dataset} has the {kind} {files[dataset].name} in a row above")
    truth_told = _told(row, "groundtruth_", request.truth_told)
    if found.truth_told.setdefault(dataset, truth_told) != truth_told:
        raise InvalidInput(f"dataset {dataset} has another unit or order of its ground truth in a row above")
    return ImportCandidate(
        algorithm=algorithm,
        dataset=dataset,
        trial=row.get("trial") or _ONLY_TRIAL,
        path=_inside(folder, row["file"]),
        name=f"{name} ({row['file']})",
        format=_member(TrajectoryFormat, "format", row) or request.format,
        times=_inside(folder, row["times"]) if row.get("times") else None,
        told=_told(row, "", request.told),
        columns=row.get("columns") or request.columns,
    )


def _told(row: dict[str, str], prefix: str, default: Convention) -> Convention:
    """The unit and order of the row, or else those of the whole import."""
    return Convention(
        _member(TimeUnit, f"{prefix}time_unit", row) or default.time_unit,
        _member(QuaternionOrder, f"{prefix}quaternion_order", row) or default.quaternion_order,
    )


_Member = TypeVar("_Member", bound=StrEnum)


def _member(kind: type[_Member], column: str, row: dict[str, str]) -> _Member | None:
    """The value in ``column``, None if empty; raises InvalidInput with the nearest known value."""
    text = row.get(column)
    if not text:
        return None
    known = [entry.value for entry in kind]
    if text not in known:
        raise InvalidInput(f"unknown {column} {text[:40]!r}; {nearest(text, known)}")
    return kind(text)


def _inside(folder: Path, text: str) -> Path:
    """The file ``text`` below ``folder``; raises InvalidInput for a link or a file elsewhere."""
    relative = PurePosixPath(text)
    if not text or "\0" in text or relative.is_absolute() or ".." in relative.parts:
        raise InvalidInput(f"file {text[:80]!r} is not below {folder}", "name files relative to the table")
    if not text.isprintable():
        raise InvalidInput(f"file {text[:80]!r}: {_UNPRINTABLE}")
    if any(len(part.encode()) > _LONGEST_NAME_BYTES for part in relative.parts) or len(text) > _LONGEST_PATH:
        raise InvalidInput(f"file {text[:80]!r} has a name that no file can have", "name files relative to the table")
    path = folder / relative
    if any(part.is_symlink() for part in (path, *path.parents) if part != folder and folder in part.parents):
        raise InvalidInput(f"file {text[:80]!r} is a link, and links are not followed", "put the file there")
    return path


def _check(candidate: ImportCandidate) -> None:
    for kind in FIELDS:
        check_name(kind, getattr(candidate, kind))
