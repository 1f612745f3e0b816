"""``variant.json`` beside a variant's recording: its origin, and the checksums of its files."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from slamhive.bags.staging import checksum
from slamhive.catalogue.dataset_file import load_dataset
from slamhive.clock import utc_now
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.files import write_aside
from slamhive.input_bounds import read_record

MANIFEST = "variant.json"

UNREADABLE = (InvalidInput, OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError)
"""What reading a manifest that is damaged, or removed meanwhile, may raise."""


@dataclass(frozen=True, slots=True)
class VariantPlan:
    """What is to be made: its key, where it comes from, its steps as JSON, a bound of its size.

    ``source_bytes`` is the size of the recording that has to be read for it.
    """

    key: str
    dataset: str
    steps: tuple[Mapping[str, Any], ...]
    needed_bytes: int
    source_bytes: int


@dataclass(frozen=True, slots=True)
class Manifest:
    """The content of ``variant.json``. ``files``: {path in the folder: (bytes, checksum)}.

    ``bytes_per_s`` is how fast it was made, by the size of the recording that was read; None if that is not known.
    """

    dataset: str
    steps: tuple[Mapping[str, Any], ...]
    made_at: datetime
    bytes_per_s: float | None
    files: Mapping[str, tuple[int, str]]

    @property
    def size_bytes(self) -> int:
        """Of all files together."""
        return sum(size for size, _ in self.files.values())


def write_manifest(folder: Path, plan: VariantPlan, dataset: Dataset, took_s: float) -> None:
    """Describe ``folder``, in which ``dataset`` was written in ``took_s``; nothing is added to it afterwards."""
    known = {dataset.bag: dataset.checksum}
    files: dict[str, tuple[int, str]] = {}
    for path in sorted(entry for entry in folder.rglob("*") if entry.is_file()):
        name = path.relative_to(folder).as_posix()
        files[name] = (path.stat().st_size, known.get(name) or checksum(path))
    content = {
        "dataset": plan.dataset,
        "steps": list(plan.steps),
        "made_at": utc_now().isoformat(timespec="seconds"),
        "bytes_per_s": plan.source_bytes / took_s if took_s > 0 else None,
        "files": files,
    }
    write_aside(folder / MANIFEST, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_manifest(folder: Path) -> Manifest:
    """The manifest of ``folder``; raises one of :data:`UNREADABLE`."""
    content = read_record(folder / MANIFEST)
    return Manifest(
        dataset=str(content["dataset"]),
        steps=tuple(dict(step) for step in content["steps"]),
        made_at=datetime.fromisoformat(content["made_at"]),
        bytes_per_s=_speed(content.get("bytes_per_s")),
        files={str(name): (int(size), str(digest)) for name, (size, digest) in content["files"].items()},
    )


def _speed(value: object) -> float | None:
    """None for variants that were made before it was written down, too."""
    return float(value) if isinstance(value, int | float) and value > 0 else None


def problem(folder: Path) -> str | None:
    """What keeps a variant from being used, as far as names and sizes tell; None if nothing does."""
    if not folder.is_dir():
        return "it is not there"
    try:
        for name, (size_bytes, _) in read_manifest(folder).files.items():
            found_bytes = (folder / name).stat().st_size
            if found_bytes != size_bytes:
                return f"{name} has {found_bytes} bytes, {size_bytes} were written"
        load_dataset(folder)
    except (*UNREADABLE, SlamHiveError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def changed_file(folder: Path) -> str | None:
    """Read every byte; which file is not what was written, None if all are."""
    for name, (_, expected) in read_manifest(folder).files.items():
        if checksum(folder / name) != expected:
            return f"{name} has changed since it was written"
    return None


def flush(folder: Path) -> None:
    """Everything to disk: what gets its name afterwards is whole, also after a power cut."""
    for path in [*folder.rglob("*"), folder]:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
