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


@dataclass(frozen=True, slots=True)
class GivenGpu:
    """The GPU that an engine of several nodes gave to a run. What nobody could find out is None.

    Attributes:
        node: Where it is.
        number: What the engine calls it on that node.
        uuid: As in :class:`Gpu`, with ``model``, ``driver`` and ``memory_bytes``.
    """

    node: str
    number: str | None = None
    uuid: str | None = None
    model: str | None = None
    driver: str | None = None
    memory_bytes: int | None = None
