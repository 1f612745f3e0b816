"""The files of a run folder that an archive holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path

from slamhive.runs.folder import STAYING, travels
from slamhive.services.archive import layout
from slamhive.tree import Entry, walk

ODD_NAMES = "files with names that no archive holds"
STRANGE_FILES = "files that do not belong to a run folder"


class Part(StrEnum):
    """Files of runs that an export may go without."""

    TRAJECTORIES = "trajectories"
    MAPS = "maps"
    LOGS = "logs"
    PICTURES = "pictures"


_OF_TRAJECTORIES = (
    ".tum",
    "/traj.txt",
    "/traj.live.txt",
    "/traj.final.txt",
    "/keyframe.txt",
    "/errors.csv",
    "pe.zip",
    "kitti_poses.txt",
)
_LEFT_OUT: dict[Part, Callable[[str], bool]] = {
    Part.TRAJECTORIES: lambda name: name.endswith(_OF_TRAJECTORIES),
    Part.MAPS: lambda name: name.endswith(".pcd"),
    Part.LOGS: lambda name: name in ("log.txt", "preparation.txt"),
    Part.PICTURES: lambda name: name.endswith(".png"),
}


def files_of_run(root: Path, without: Sequence[Part], left_out: Counter[str]) -> Iterator[tuple[str, Path]]:
    """The files of a run folder by name, sorted; not its owner, what is scratch, or a write that was cut off.

    What an algorithm left that no archive can hold is counted in ``left_out``.
    """
    for name, path in _files(root, left_out):
        if not any(_LEFT_OUT[part](name) for part in without):
            yield name, path


def _files(root: Path, left_out: Counter[str]) -> Iterator[tuple[str, Path]]:
    for top in sorted(root.iterdir()):
        if top.name.startswith(".") or top.name in STAYING:
            continue
        found: list[tuple[str, str | None]] = [(top.name, "")] if top.is_file() and not top.is_symlink() else []
        entries = walk(top) if top.is_dir() and not top.is_symlink() else ()
        found += [(f"{top.name}/{entry.place}", _unfit(entry)) for entry in entries]
        for name, unfit in sorted(found):
            cut_off = "/." in name and not travels(name)
            if unfit is None or cut_off:
                continue
            problem = unfit or (ODD_NAMES if not layout.is_safe(name) else STRANGE_FILES if not travels(name) else "")
            if problem:
                left_out[problem] += 1
            else:
                yield name, root / name


def _unfit(entry: Entry) -> str | None:
    """Why something below a run folder cannot be a member, empty if it can; None for a folder, which is none."""
    if entry.is_folder:
        return None if entry.entered else "folders too deep to be looked into"
    return "" if entry.is_file else "links, pipes and other things that are no files"
