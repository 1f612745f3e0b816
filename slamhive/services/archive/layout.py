"""What an archive holds: the names of its members, its limits, and its manifest."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from slamhive.errors import InvalidInput
from slamhive.input_bounds import parse_json_object

FORMAT = 1
KIND = "slamhive-archive"

MANIFEST = "manifest.json"
CHECKSUMS = "SHA256SUMS"
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
"""The list of members is held in memory; a million of them fit."""
LARGEST_TEXT_BYTES = 16_000_000
"""Most bytes of a member that is read as a whole, and of one line of the others."""
LARGEST_RATIO = 1100
"""Deflate makes nothing smaller than a 1032nd."""

_RUN_NUMBER = re.compile(r"[1-9][0-9]{0,17}")
_MOST_PARTS = 16
_LONGEST_PART_BYTES = 255
_LONGEST_NAME_BYTES = 1024
_SHOWN = 80


@dataclass(frozen=True, slots=True)
class Manifest:
    """What the archive says of itself.

    ``counts``: rows of each kind. ``without``: kinds of files that were left out. ``left_out``: {why: number} of runs;
    ``files_left_out``: {what: number} of what runs had left.
    ``checksums``: SHA-256 (hex) of the member :data:`CHECKSUMS`, which has those of all others, as ``sha256sum``
    writes and checks them.
    """

    made_at: str
    software: str
    counts: dict[str, int]
    checksums: str
    without: tuple[str, ...] = ()
    left_out: dict[str, int] = field(default_factory=dict)
    files_left_out: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> str:
        """The content of :data:`MANIFEST`."""
        return json.dumps({"kind": KIND, "format": FORMAT, **asdict(self)}, indent=1) + "\n"


def manifest_from_json(data: bytes) -> Manifest:
    """The manifest that :meth:`Manifest.to_json` wrote; raises InvalidInput for any other."""
    content = parse_json_object(data, MANIFEST, recorded=True)
    if content.get("kind") != KIND:
        raise InvalidInput(f"{MANIFEST} is not that of an archive of SLAM Hive", "slamhive archive export makes one")
    if content.get("format") != FORMAT:
        raise InvalidInput(
            f"the archive has format {content.get('format')!r}, this version reads {FORMAT}",
            "import it with the version that made it, or a later one",
        )
    try:
        return Manifest(
            made_at=str(content["made_at"]),
            software=str(content["software"]),
            counts=_numbers(content["counts"]),
            checksums=str(content["checksums"]),
            without=tuple(map(str, content["without"])),
            left_out=_numbers(content["left_out"]),
            files_left_out=_numbers(content.get("files_left_out", {})),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InvalidInput(f"{MANIFEST} is not complete: {error!r}", "export the archive again") from None


def check_member(name: str) -> None:
    """Raise InvalidInput unless ``name`` is one that an archive has: below one of our folders, and without tricks."""
    if name in (MANIFEST, CHECKSUMS, *ROWS):
        return
    parts = name.split("/")
    known = (parts[0] == "runs" and len(parts) > 2 and _RUN_NUMBER.fullmatch(parts[1])) or (
        parts[0] in ("datasets", "experiments") and len(parts) > 2
    )
    if not known or not _safe(parts) or len(name.encode(errors="replace")) > _LONGEST_NAME_BYTES:
        raise InvalidInput(f"the archive has a member {shown(name)}, which none of ours has", "it is not imported")


def is_safe(name: str) -> bool:
    """Whether a file below a run folder can be a member: its name is UTF-8 without control characters, and short."""
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


def _numbers(content: Mapping[str, Any]) -> dict[str, int]:
    return {str(key): int(value) for key, value in content.items()}
