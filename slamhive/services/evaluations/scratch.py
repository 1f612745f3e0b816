"""Temporary folders for batches of evaluations, removed even if a batch is killed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.files import sweep_folder, temporary_folder

_PREFIX = ".evaluation-"


@contextmanager
def scratch_folder(data: Path) -> Iterator[Path]:
    """A folder below ``data``, removed at the end; leftovers of killed processes are removed first."""
    sweep_scratch(data)
    with temporary_folder(_PREFIX, data) as folder:
        yield folder


def sweep_scratch(data: Path) -> None:
    """Remove the folders of killed batches."""
    for left in data.glob(f"{_PREFIX}*"):
        sweep_folder(left)
