"""Where inputs and outputs lie for executors that share the file system of the controller."""

from __future__ import annotations

import shutil
import stat
from pathlib import Path

from slamhive.errors import Unavailable
from slamhive.executors.spec import RunSpec
from slamhive.files import remedy_of


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
