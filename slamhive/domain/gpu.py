"""Whether a package uses a GPU, and what a GPU is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class GpuNeed(StrEnum):
    """Whether runs of a package get a GPU."""

    NONE = "none"
    OPTIONAL = "optional"
    """A run gets one where the machine has one."""
    REQUIRED = "required"


@dataclass(frozen=True, slots=True)
class Gpu:
    """One GPU of this machine. ``uuid`` stays the same over restarts, unlike its number."""

    uuid: str
    model: str
    driver: str
    memory_bytes: int
