"""The CPU cores of each slot of the worker."""

from __future__ import annotations

import os
from collections.abc import Collection

from slamhive.errors import InvalidInput


def share_cores(slots: int, usable: Collection[int] | None = None) -> list[tuple[int, ...] | None]:
    """Share cores between slots: disjoint sets of nearly equal size; None (all cores) for a single slot.

    Args:
        slots: Number of slots.
        usable: Numbers of the cores to share; None for those that this process may use.

    Raises:
        InvalidInput: There are fewer cores than slots.
    """
    if slots == 1:
        return [None]
    cores = sorted(os.sched_getaffinity(0) if usable is None else usable)
    count = len(cores)
    if slots > count:
        raise InvalidInput(f"WORKER_SLOTS={slots} exceeds the {count} cores that this process may use", "lower it")
    return [tuple(cores[slot * count // slots : (slot + 1) * count // slots]) for slot in range(slots)]
