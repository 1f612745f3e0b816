"""The seam of exports: what an exporter says before anything is written, and what it then writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from slamhive.domain.dataset import Dataset
from slamhive.recordings.staging import Progress


@dataclass(frozen=True, eq=False)
class ExportPlan:
    """Plan of an export.

    Attributes:
        write: Writes into an empty folder; raises InvalidInput for a damaged recording, OSError for a full disk.
        needed_bytes: The size of the result, estimated from above.
        left_out: What the format cannot hold, one phrase each: ``depth0 (depth)``. Such an export must be asked for.
        notes: What users of the result should know, one sentence each.
    """

    write: Callable[[Path, Progress], None]
    needed_bytes: int
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@runtime_checkable
class Exporter(Protocol):
    """Turns datasets into folders of one format."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Plan the export of ``dataset``; raises InvalidInput if the format is for something else."""
        ...
