"""Where tests that write much put their files: in memory if there is room, which takes a third of the time."""

from __future__ import annotations

import shutil
from pathlib import Path

import psutil

_MEMORY = Path("/dev/shm")


def folder_in_memory(room_bytes: int) -> Path | None:
    """A folder whose files are in memory; None if there is less room than ``room_bytes``."""
    if not _MEMORY.is_dir():
        return None
    free_bytes = min(shutil.disk_usage(_MEMORY).free, psutil.virtual_memory().available)
    return _MEMORY if free_bytes > room_bytes else None
