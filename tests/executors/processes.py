"""What is left of a run on this machine."""

from __future__ import annotations

from pathlib import Path

from slamhive.executors.process.environment import KEY_VARIABLE
from slamhive.executors.process.table import all_processes, living
from slamhive.executors.status import RunHandle


def processes_of(handle: RunHandle) -> list[int]:
    """The living processes that carry the run's mark, which every one of them inherits."""
    key = f"{KEY_VARIABLE}={handle.data['key']}".encode()
    container = handle.data.get("container", "no container").encode()

    def is_marked(folder: Path) -> bool:
        return key in _read(folder / "environ") or container in _read(folder / "cgroup")

    return [entry.pid for entry in living(all_processes()) if is_marked(Path(f"/proc/{entry.pid}"))]


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
