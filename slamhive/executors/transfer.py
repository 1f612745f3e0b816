"""Archives that carry the inputs of a run to a machine that does not see our files, and its outputs back.

Inputs come from the controller and are trusted. Outputs come from an algorithm: only plain files and folders below the
output folder are taken over, up to the bounds of the output.
"""

from __future__ import annotations

import shutil
import stat
import tarfile
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import IO, Any

from slamhive.base.errors import Unavailable
from slamhive.base.files import remedy_of, write_aside
from slamhive.base.tree import DEEPEST_FOLDERS, remove_tree, unpack_trusted
from slamhive.executors.packing import MOST_LIVE_BYTES, PLAIN_FILE, Bounds
from slamhive.executors.spec import RunOutput, RunSpec

_INPUTS, _OUTPUTS, _WORK, _PACKAGE = "inputs", "outputs", "work", "package"
_LONGEST_NAME_BYTES, _LONGEST_PATH_BYTES = 255, 2000


def pack_inputs(spec: RunSpec, stream: IO[bytes]) -> None:
    """Write an archive with all inputs of the run and the scripts of its package."""
    with tarfile.open(fileobj=stream, mode="w|") as archive:
        for entry in spec.inputs:
            archive.add(entry.source.resolve(), f"{_INPUTS}/{entry.name}")
        scripts = spec.package_folder / "slamhive"
        if scripts.is_dir():
            archive.add(scripts.resolve(), f"{_PACKAGE}/slamhive")


def unpack_inputs(stream: IO[bytes], root: Path) -> None:
    """Unpack what :func:`pack_inputs` wrote, and make the run's other folders. Raises OSError, tarfile.TarError."""
    with tarfile.open(fileobj=stream, mode="r|") as archive:
        unpack_trusted(archive, root)
    for name in (_OUTPUTS, _WORK, _PACKAGE):
        (root / name).mkdir(exist_ok=True)


def relocated(spec: RunSpec, root: Path) -> RunSpec:
    """The specification with the paths that it has on the other machine, after :func:`unpack_inputs` into ``root``."""
    return replace(
        spec,
        package_folder=root / _PACKAGE,
        inputs=tuple(replace(entry, source=root / _INPUTS / entry.name) for entry in spec.inputs),
        outputs=tuple(replace(output, destination=root / _OUTPUTS / output.name) for output in spec.outputs),
        work=root / _WORK,
    )


def unpack_output(stream: IO[bytes], output: RunOutput, work: Path, below: str = "") -> None:
    """Replace the output's folder with the content of an archive. Can be done again after a crash.

    What would exceed the bounds of the output is left out, and so are names that no file system takes. Raises OSError,
    tarfile.TarError.

    Args:
        stream: What :func:`~slamhive.executors.packing.pack_folder` wrote.
        output: Where it belongs, and its bounds.
        work: A folder on the same file system for what is not complete yet.
        below: The folder in the archive that is the output; empty for all of it.
    """
    fresh, old = work / f"incoming-{output.name}", work / f"replaced-{output.name}"
    for left in (fresh, old):
        remove_tree(left)
    fresh.mkdir(parents=True)
    bounds = Bounds(output.max_bytes, output.max_files)
    with tarfile.open(fileobj=stream, mode="r|") as archive:
        for info in archive:
            if not info.name.startswith(below):
                continue
            info.name = info.name[len(below) :]
            parts = PurePosixPath(info.name).parts
            short = all(len(part.encode()) <= _LONGEST_NAME_BYTES for part in parts)
            can_be_named = short and len(parts) <= DEEPEST_FOLDERS and len(info.name.encode()) <= _LONGEST_PATH_BYTES
            if can_be_named and bounds.take(info.size):
                _take(archive, info, fresh)
    if output.destination.exists():
        output.destination.rename(old)
    fresh.rename(output.destination)
    remove_tree(old)


def unpack_live(stream: IO[bytes], output: RunOutput) -> None:
    """Replace the live files of an output, each in one step; others in the archive are left out."""
    with tarfile.open(fileobj=stream, mode="r|") as archive:
        for info in archive:
            content = archive.extractfile(info) if info.isreg() else None
            if content is not None and info.name in output.live and info.size <= MOST_LIVE_BYTES:
                write_aside(output.destination / info.name, content.read())


def _take(archive: tarfile.TarFile, info: tarfile.TarInfo, root: Path) -> None:
    parts = PurePosixPath(info.name).parts
    if info.name.startswith("/") or ".." in parts or not parts:
        raise tarfile.TarError(f"the archive names {info.name!r}, which is outside of the result")
    place = root.joinpath(*parts)
    content: IO[Any] | None = archive.extractfile(info) if info.isreg() else None
    if info.isdir():
        place.mkdir(parents=True, exist_ok=True)
    elif content is not None:
        place.parent.mkdir(parents=True, exist_ok=True)
        with place.open("wb") as stream:
            shutil.copyfileobj(content, stream)
        place.chmod(PLAIN_FILE)


# Where inputs and outputs lie for executors that share the file system of the controller.


def make_own_copies(spec: RunSpec) -> None:
    """Copy the inputs that the run may change; a copy that was cut off is completed. Raises Unavailable."""
    for entry in spec.inputs:
        copy = _own_copy(spec, entry.name)
        if not entry.own_copy or entry.source.resolve() == copy.resolve():
            continue
        try:
            if entry.source.is_dir():
                shutil.copytree(entry.source, copy, dirs_exist_ok=True)
            else:
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(entry.source, copy)
                copy.chmod(copy.stat().st_mode | stat.S_IWUSR)  # in a cache, files are read-only
        except OSError as error:
            raise Unavailable(f"{copy} cannot be written: {error}", remedy_of(error)) from None


def read_places(spec: RunSpec) -> dict[str, Path]:
    """{target: path on this machine} of everything that the run reads and must not change."""
    return {entry.target: entry.source.resolve() for entry in spec.inputs if not entry.own_copy}


def written_places(spec: RunSpec) -> dict[str, Path]:
    """{target: path on this machine} of everything that the run may change: its own copies, and its outputs."""
    copies = {entry.target: _own_copy(spec, entry.name).resolve() for entry in spec.inputs if entry.own_copy}
    return copies | {output.target: output.destination.resolve() for output in spec.outputs}


def has_written(spec: RunSpec) -> bool:
    """Return whether the run has written anything, so that it was executed."""
    places = [output.destination for output in spec.outputs]
    return any(next(place.iterdir(), None) is not None for place in places if place.is_dir())


def _own_copy(spec: RunSpec, name: str) -> Path:
    return spec.work / name
