"""A file of which parts have been received: ``NAME.part`` with its bytes, ``NAME.part.json`` with what is there.

Both survive a kill. The list is written after the bytes that it names, so it never promises too much.
"""

from __future__ import annotations

import fcntl
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from slamhive.clock import monotonic_s
from slamhive.errors import Conflict, Unavailable
from slamhive.files import remedy_of, write_aside

Span = tuple[int, int]
"""First byte, and the one after the last."""

_SAVE_EVERY_S = 1.0


@dataclass(frozen=True, slots=True)
class Remote:
    """What an address offers: its size in bytes (None if it does not say), whether it gives ranges, and its version.

    ``version`` is the ETag or the date of the last change; empty if the server states neither.
    """

    address: str
    size_bytes: int | None
    ranges: bool
    version: str


class PartFile:
    """The parts of one file. Threads may write different spans at the same time.

    Args:
        target: The name of the complete file.
    """

    def __init__(self, target: Path) -> None:
        self.path = target.with_name(f"{target.name}.part")
        self._list = target.with_name(f"{target.name}.part.json")
        self._lock = threading.Lock()
        self._done: list[Span] = []
        self._origin: dict[str, object] = {}
        self._saved_s = monotonic_s()
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._file)
            raise Conflict(f"{target.name} is being downloaded by another process", "wait for it to end") from None
        self._read_list()

    @property
    def done_bytes(self) -> int:
        """How many bytes are there."""
        with self._lock:
            return sum(end - start for start, end in self._done)

    def begin(self, remote: Remote, *, trusted: bool) -> None:
        """Keep what is there if it belongs to ``remote``, else empty the file.

        ``trusted``: a checksum will prove the whole, so parts of another address with the same size are welcome.
        """
        origin: dict[str, object] = {
            "address": remote.address,
            "version": remote.version,
            "size_bytes": remote.size_bytes,
        }
        same = origin == self._origin and bool(remote.version)
        proved = trusted and self._origin.get("size_bytes") == remote.size_bytes is not None
        if not remote.ranges or not (same or proved):
            self._done = []
            self._truncate()
        self._origin = origin
        self.save()

    def missing(self, size_bytes: int, longest: int) -> Iterator[Span]:
        """What is not there yet, in spans of at most ``longest`` bytes."""
        with self._lock:
            bounds = [*self._done, (size_bytes, size_bytes)]
        position = 0
        for start, end in bounds:
            for begin in range(position, start, longest):
                yield begin, min(begin + longest, start)
            position = end

    def write(self, start: int, data: bytes) -> None:
        """Put ``data`` at ``start``; raises Unavailable if the disk refuses."""
        try:
            view, place = memoryview(data), start
            while view:
                count = os.pwrite(self._file, view, place)
                view, place = view[count:], place + count
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None
        with self._lock:
            self._done = _merged([*self._done, (start, start + len(data))])
            due = monotonic_s() - self._saved_s > _SAVE_EVERY_S
        if due:
            self.save()

    def save(self) -> None:
        """Bring the bytes to the disk, then the list of what is there."""
        self._saved_s = monotonic_s()
        with self._lock:
            done = list(self._done)
        os.fdatasync(self._file)
        write_aside(self._list, json.dumps({**self._origin, "done": done}))

    def forget(self) -> None:
        """Empty the file."""
        with self._lock:
            self._done = []
        self._truncate()
        self.save()

    def finish(self, target: Path) -> None:
        """Give the file its name."""
        os.fsync(self._file)
        self.path.rename(target)
        self._list.unlink(missing_ok=True)

    def discard(self) -> None:
        """Remove everything."""
        self.path.unlink(missing_ok=True)
        self._list.unlink(missing_ok=True)

    def close(self) -> None:
        """Release the lock."""
        os.close(self._file)

    def _truncate(self) -> None:
        os.ftruncate(self._file, 0)

    def _read_list(self) -> None:
        try:
            content = json.loads(self._list.read_text(encoding="utf-8"))
            done = [(int(start), int(end)) for start, end in content.pop("done")]
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return
        size = os.fstat(self._file).st_size
        if all(0 <= start < end <= size for start, end in done):
            self._done, self._origin = _merged(done), content


@contextmanager
def part_file(target: Path) -> Iterator[PartFile]:
    """The parts of ``target``; what is there is listed when the block ends, however it ends."""
    parts = PartFile(target)
    try:
        yield parts
    finally:
        parts.close()


def _merged(spans: list[Span]) -> list[Span]:
    merged: list[Span] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((start, end))
    return merged
