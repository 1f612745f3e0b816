"""Layout of an archive: the names of its members, its limits, and its manifest.

An archive is a bag (BagIt 1.0, RFC 8493) in a zip file: one folder with tag files and the payload below ``data/``.
The first format had the payload at the top level and its checksums in ``SHA256SUMS``; it is still read.

Other modules use the names of the first format for both: ``runs/1/run.json``, and tag files without their folder.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slamhive.base.bounds import parse_json_object
from slamhive.base.errors import InvalidInput
from slamhive.base.tree import FolderEntry, walk
from slamhive.documents.archive import KIND, ArchiveManifest
from slamhive.run_folder.folder import STAYING, travels

ABOUT = "archive.json"
CHECKSUMS = "manifest-sha256.txt"
TAG_CHECKSUMS = "tagmanifest-sha256.txt"
BAGIT, BAG_INFO = "bagit.txt", "bag-info.txt"
BAGIT_TEXT = "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n"
PAYLOAD = "data/"

ALGORITHMS = "rows/algorithms.jsonl"
DATASETS = "rows/datasets.jsonl"
CONFIGURATIONS = "rows/configurations.jsonl"
EXPERIMENTS = "rows/experiments.jsonl"
CELLS = "rows/cells.jsonl"
SEARCHES = "rows/saved_searches.jsonl"
ANALYSES = "rows/analyses.jsonl"
RUNS = "rows/runs.jsonl"
ROWS = (ALGORITHMS, DATASETS, CONFIGURATIONS, EXPERIMENTS, CELLS, SEARCHES, ANALYSES, RUNS)

LARGEST_DIRECTORY_BYTES = 128_000_000
"""The list of members is held in memory; 800,000 of them fit."""
LARGEST_TEXT_BYTES = 16_000_000
"""Most bytes of a member that is read as a whole, and of one line of the others."""
LARGEST_RATIO = 1100
"""Deflate makes nothing smaller than a 1032nd."""

VERSIONS = "versions"
_VERSION_FILE = re.compile(r"[0-9a-f]{16}\.tar")
_RUN_NUMBER = re.compile(r"[1-9][0-9]{0,17}")
_MOST_PARTS = 16
_LONGEST_PART_BYTES = 255
_LONGEST_NAME_BYTES = 1024
_SHOWN = 80


@dataclass(frozen=True, slots=True)
class ArchiveFormat:
    """One version of the format.

    Attributes:
        number: Of the version.
        about: The member with the :class:`Manifest`.
        checksums: The member with the SHA-256 of each member of the payload.
        tags: All members that do not belong to the payload.
        tags_folder: What the names of tags begin with in the zip file.
        payload_folder: What the names of the payload begin with in the zip file.
    """

    number: int
    about: str
    checksums: str
    tags: frozenset[str]
    tags_folder: str = ""
    payload_folder: str = ""

    def member(self, name: str) -> str:
        """The name that the other modules use for a member of the zip file.

        Raises:
            InvalidInput: unless the member is one that an archive of this format has.
        """
        if name.startswith(self.payload_folder):
            member = name[len(self.payload_folder) :]
            if _is_payload(member):
                return member
        tag = name.removeprefix(self.tags_folder)
        if name.startswith(self.tags_folder) and tag in self.tags:
            return tag
        raise InvalidInput(f"the archive has a member {shown(name)}, which no export writes", "it is not imported")

    def listed_as(self, member: str) -> str:
        """Return the name of a payload member in ``checksums``.

        BagIt quotes percent signs and line breaks (RFC 8493, section 2.1.3); no member has a line break.
        """
        return member if self.number == 1 else f"{PAYLOAD}{member.replace('%', '%25')}"

    def manifest(self, data: bytes) -> ArchiveManifest:
        """Read the content of ``about``; raises InvalidInput unless an export has written it."""
        content = parse_json_object(data, self.about, recorded=True)
        if content.get("kind") != KIND:
            raise InvalidInput(
                f"{self.about} does not describe an archive of SLAM Hive", "make one with slamhive archive export"
            )
        if content.get("format") != self.number:
            raise InvalidInput(
                f"the archive has format {content.get('format')!r}, this version reads 1 and 2",
                "import it with the version that made it, or a later one",
            )
        try:
            manifest = ArchiveManifest.read(content)
        except InvalidInput as error:
            raise InvalidInput(f"{self.about} is incomplete: {error.message}", "export the archive again") from None
        if self.number == 1 and manifest.checksums is None:
            raise InvalidInput(f"{self.about} is incomplete: checksums is missing", "export the archive again")
        return manifest


FIRST = ArchiveFormat(1, "manifest.json", "SHA256SUMS", frozenset(("manifest.json", "SHA256SUMS")))


def bag_format(folder: str) -> ArchiveFormat:
    """The format of today, for a bag in ``folder``."""
    return ArchiveFormat(
        number=2,
        about=ABOUT,
        checksums=CHECKSUMS,
        tags=frozenset((ABOUT, CHECKSUMS, TAG_CHECKSUMS, BAGIT, BAG_INFO)),
        tags_folder=f"{folder}/",
        payload_folder=f"{folder}/{PAYLOAD}",
    )


def format_of(names: list[str]) -> ArchiveFormat:
    """The format of an archive with these members."""
    for name in names:
        folder, slash, rest = name.partition("/")
        if slash and rest == BAGIT and _safe_part(folder):
            return bag_format(folder)
    return FIRST


def _is_payload(name: str) -> bool:
    """Tell if ``name`` is one that an export writes: below one of our folders, and without tricks."""
    if name in ROWS:
        return True
    parts = name.split("/")
    known = len(parts) > 2 and (
        parts[0] in ("datasets", "experiments")
        or (parts[0] == "runs" and _RUN_NUMBER.fullmatch(parts[1]))
        or (parts[0] == VERSIONS and len(parts) == 3 and _VERSION_FILE.fullmatch(parts[2]))
    )
    return bool(known) and _safe(parts) and len(name.encode(errors="replace")) <= _LONGEST_NAME_BYTES


def version_member(package: str, identity: str, package_hash: str) -> str:
    """The member that holds a version of a package. Its number differs from one installation to the next."""
    digest = hashlib.sha256(f"{identity} {package_hash}".encode()).hexdigest()
    return f"{VERSIONS}/{package}/{digest[:16]}.tar"


def is_safe(name: str) -> bool:
    """Tell if a file below a run folder can be a member: its name is short UTF-8 without control characters."""
    return _safe(name.split("/")) and len(name.encode(errors="replace")) < _LONGEST_NAME_BYTES - 40


def shown(name: str) -> str:
    """A name out of an archive, for a message."""
    text = repr(name)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _safe(parts: list[str]) -> bool:
    return len(parts) <= _MOST_PARTS and all(map(_safe_part, parts))


def _safe_part(part: str) -> bool:
    try:
        length = len(part.encode())
    except UnicodeEncodeError:
        return False
    plain = part.isprintable() and "\\" not in part
    return plain and part not in ("", ".", "..") and length <= _LONGEST_PART_BYTES


# Files of a run folder that an archive holds.

ODD_NAMES = "files with names that no archive holds"
STRANGE_FILES = "files that do not belong to a run folder"


class ArchivePart(StrEnum):
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
_LEFT_OUT: dict[ArchivePart, Callable[[str], bool]] = {
    ArchivePart.TRAJECTORIES: lambda name: name.endswith(_OF_TRAJECTORIES),
    ArchivePart.MAPS: lambda name: name.endswith(".pcd"),
    ArchivePart.LOGS: lambda name: name in ("log.txt", "preparation.txt"),
    ArchivePart.PICTURES: lambda name: name.endswith(".png"),
}


def files_of_run(root: Path, without: Sequence[ArchivePart], left_out: Counter[str]) -> Iterator[tuple[str, Path]]:
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
            problem = unfit or (ODD_NAMES if not is_safe(name) else STRANGE_FILES if not travels(name) else "")
            if problem:
                left_out[problem] += 1
            else:
                yield name, root / name


def _unfit(entry: FolderEntry) -> str | None:
    """Why something below a run folder cannot be a member, empty if it can; None for a folder, which is none."""
    if entry.is_folder:
        return None if entry.entered else "folders too deep to be looked into"
    return "" if entry.is_file else "links, pipes and other things that are no files"
