"""Folders and files of the data root that a pod sees, and their way into it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from slamhive.errors import Unavailable
from slamhive.executors.base import StartFailed
from slamhive.executors.local_files import make_own_copies, read_places, written_places
from slamhive.executors.spec import RunInput, RunSpec
from slamhive.files import remedy_of

MOST_BYTES_COPIED = 100_000_000
"""An input that lies outside of the data root is copied if it is no larger."""


@dataclass(frozen=True, slots=True)
class Place:
    """Something that the run sees at ``target``. ``source`` is its path on the machine of the worker."""

    target: str
    source: Path
    is_folder: bool
    read_only: bool


def outputs_on_node(spec: RunSpec, folder: Path) -> RunSpec:
    """The specification whose outputs are written below ``folder`` first; ``collect`` takes them over."""
    outputs = tuple(replace(output, destination=folder / output.name) for output in spec.outputs)
    return replace(spec, outputs=outputs)


def prepare_inputs(spec: RunSpec, data: Path, folder: Path) -> RunSpec:
    """Copy small inputs from outside of the data root to ``folder``, and those that the run may change.

    Raises Unavailable if that fails.
    """
    copied = replace(spec, inputs=tuple(_inside(entry, data, folder) for entry in spec.inputs))
    make_own_copies(copied)
    return copied


def places_of(spec: RunSpec, other: Mapping[str, Path]) -> list[Place]:
    """List what the run sees, in the order in which it is mounted. ``other``: folders that only the executor knows."""
    read_only = read_places(spec)
    places = {**read_only, **written_places(spec), **other}
    return [Place(target, path, path.is_dir(), target in read_only) for target, path in sorted(places.items())]


def volumes_of(places: list[Place], data: Path, claim: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The volumes of a pod and the mounts of its container.

    Args:
        places: What the run sees.
        data: The data root.
        claim: The claim that holds the data root; empty if nodes see all files at the path that they have here.

    Raises StartFailed for a place outside of the data root if there is a claim.
    """
    if claim:
        volume = {"name": "data", "persistentVolumeClaim": {"claimName": claim}}
        return [volume], [_mount(place, "data") | {"subPath": _below(place, data)} for place in places]
    volumes = [
        {"name": f"p{number}", "hostPath": {"path": str(place.source), "type": _kind(place)}}
        for number, place in enumerate(places)
    ]
    return volumes, [_mount(place, f"p{number}") for number, place in enumerate(places)]


def _mount(place: Place, volume: str) -> dict[str, Any]:
    return {"name": volume, "mountPath": place.target, "readOnly": place.read_only}


def _kind(place: Place) -> str:
    """The kubelet refuses a path that is something else, or missing because the node does not share it."""
    return "Directory" if place.is_folder else "File"


def _below(place: Place, data: Path) -> str:
    try:
        return str(place.source.relative_to(data.resolve()))
    except ValueError:
        raise StartFailed(
            f"{place.source} is not below the data root {data}, which is all that nodes have",
            "move it there, or use a shared file system instead of --claim",
        ) from None


def _inside(entry: RunInput, data: Path, folder: Path) -> RunInput:
    source = entry.source.resolve()
    if entry.own_copy or source.is_relative_to(data.resolve()) or entry.size_bytes > MOST_BYTES_COPIED:
        return entry
    copy = folder / entry.name
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, copy, dirs_exist_ok=True)
        else:
            shutil.copy(source, copy)
    except OSError as error:
        raise Unavailable(f"{copy} cannot be written: {error}", remedy_of(error)) from None
    return replace(entry, source=copy)
