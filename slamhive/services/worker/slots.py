"""Which cores a slot of the worker measures on."""

from __future__ import annotations

import os
from collections.abc import Collection

from slamhive.errors import InvalidInput


def share_cores(slots: int, usable: Collection[int] | None = None) -> list[tuple[int, ...] | None]:
    """The cores of each slot: disjoint and as equal as can be; None (all) if there is one slot.

    Args:
        slots: How many slots there are.
        usable: The numbers of the cores to share, None for those that this process may use.

    Raises:
        InvalidInput: There are fewer cores than slots.
    """
    if slots == 1:
        return [None]
    cores = sorted(os.sched_getaffinity(0) if usable is None else usable)
    count = len(cores)
    if slots > count:
        raise InvalidInput(f"WORKER_SLOTS={slots} is more than the {count} cores that may be used here", "lower it")
    return [tuple(cores[slot * count // slots : (slot + 1) * count // slots]) for slot in range(slots)]
