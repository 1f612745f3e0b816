"""What an archive holds: the names of its members, its limits, and its manifest.

An archive is a bag (BagIt 1.0, RFC 8493) in a zip file: one folder with tag files and the payload below ``data/``.
The first format had the payload at the top level and its checksums in ``SHA256SUMS``; it is still read.

Other modules use the names of the first format for both: ``runs/1/run.json``, and tag files without their folder.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass

from slamhive.errors import InvalidInput
from slamhive.input_bounds import parse_json_object
from slamhive.schema.archive import KIND, Manifest

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
class Format:
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
        """How a member of the payload is named in ``checksums``.

        BagIt quotes percent signs and line breaks (RFC 8493, section 2.1.3); no member has a line break.
        """
        return member if self.number == 1 else f"{PAYLOAD}{member.replace('%', '%25')}"

    def manifest(self, data: bytes) -> Manifest:
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
            manifest = Manifest.read(content)
        except InvalidInput as error:
            raise InvalidInput(f"{self.about} is incomplete: {error.message}", "export the archive again") from None
        if self.number == 1 and manifest.checksums is None:
            raise InvalidInput(f"{self.about} is incomplete: checksums is missing", "export the archive again")
        return manifest


FIRST = Format(1, "manifest.json", "SHA256SUMS", frozenset(("manifest.json", "SHA256SUMS")))


def bag_format(folder: str) -> Format:
    """The format of today, for a bag in ``folder``."""
    return Format(
        number=2,
        about=ABOUT,
        checksums=CHECKSUMS,
        tags=frozenset((ABOUT, CHECKSUMS, TAG_CHECKSUMS, BAGIT, BAG_INFO)),
        tags_folder=f"{folder}/",
        payload_folder=f"{folder}/{PAYLOAD}",
    )


def format_of(names: list[str]) -> Format:
    """The format of an archive with these members."""
    for name in names:
        folder, slash, rest = name.partition("/")
        if slash and rest == BAGIT and _safe_part(folder):
            return bag_format(folder)
    return FIRST


def _is_payload(name: str) -> bool:
    """Whether ``name`` is one that an export writes: below one of our folders, and without tricks."""
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
    """Whether a file below a run folder can be a member: its name is short UTF-8 without control characters."""
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
