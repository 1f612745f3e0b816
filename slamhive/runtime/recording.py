"""Reads a recording for the player: messages in order of time, with a small page cache and clear errors."""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import apsw
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag1 import ReaderError as Ros1Error
from rosbags.rosbag2 import ReaderError as Ros2Error
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.runtime.messages import SUPPORTED

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdError
else:
    from backports.zstd import ZstdError

DAMAGE = (
    AnyReaderError,
    Ros1Error,
    Ros2Error,
    SerdeError,
    TypesysError,
    ZstdError,
    apsw.Error,
    OSError,
    ValueError,
    KeyError,
    IndexError,
    AssertionError,
    EOFError,
    struct.error,
    RuntimeError,
    OverflowError,
    MemoryError,
    SyntaxError,
    TypeError,
)
"""Errors that rosbags and its codecs raise on damaged bytes.

ValueError includes text that is not UTF-8. OverflowError and MemoryError are lengths that bytes make up. SyntaxError
is a damaged message definition, of which rosbags generates code. TypeError is a file that ends too early.
"""

_FORGET_EVERY_BYTES = 32_000_000


@dataclass(frozen=True, eq=False)
class Incoming:
    """One message: for which role, of which type, when it was recorded, and its content."""

    role: str
    kind: str
    recorded_ns: int
    message: Any


class Recording:
    """An open recording; close it, or use it as a context manager.

    Args:
        path: A ``.bag``, an ``.mcap`` or a ROS 2 folder.
        topics: Role to topic; a topic may serve one role only.

    Raises:
        InvalidInput: damaged, or a topic is missing or of a type that is not read.
    """

    def __init__(self, path: Path, topics: dict[str, str]) -> None:
        self._path = path
        self._roles = {topic: role for role, topic in topics.items()}
        try:
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except DAMAGE as error:
            raise damaged(path, error) from None
        self._connections = [entry for entry in self._reader.connections if entry.topic in self._roles]
        self.kinds = {role: self._kind(role, topic) for role, topic in topics.items()}
        self.start_ns = int(self._reader.start_time)
        self.end_ns = max(int(self._reader.end_time) - 1, self.start_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def count(self, role: str) -> int:
        """The number of messages of ``role``."""
        return sum(entry.msgcount for entry in self._connections if self._roles[entry.topic] == role)

    def messages(self) -> Iterator[Incoming]:
        """All messages of the roles in order of time; raises InvalidInput where the recording is damaged."""
        source = self._reader.messages(connections=self._connections)
        since_forgotten = 0
        while True:
            try:
                entry = next(source, None)
                if entry is None:
                    return
                connection, recorded_ns, raw = entry
                message = self._reader.deserialize(raw, connection.msgtype)
            except DAMAGE as error:
                raise damaged(self._path, error) from None
            since_forgotten += len(raw)
            if since_forgotten >= _FORGET_EVERY_BYTES:
                forget_pages(self._path)
                since_forgotten = 0
            yield Incoming(self._roles[connection.topic], connection.msgtype, int(recorded_ns), message)

    def _kind(self, role: str, topic: str) -> str:
        kinds = {entry.msgtype for entry in self._connections if entry.topic == topic}
        if not kinds:
            known = ", ".join(sorted({entry.topic for entry in self._reader.connections})) or "none"
            self._reader.close()
            raise InvalidInput(f"{self._path.name} has no topic {topic!r} for {role}", f"it has {known}")
        kind = kinds.pop()
        if kinds or kind not in SUPPORTED:
            self._reader.close()
            raise InvalidInput(f"topic {topic!r} holds {kind}, which is not read", f"expected {', '.join(SUPPORTED)}")
        return kind


def forget_pages(path: Path) -> None:
    """Ask the kernel to drop the recording's pages, which count as the container's memory otherwise."""
    files = [path] if path.is_file() else [entry for entry in path.iterdir() if entry.is_file()]
    for file in files:
        with suppress(OSError):
            descriptor = os.open(file, os.O_RDONLY)
            try:
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(descriptor)


def damaged(path: Path, error: Exception) -> InvalidInput:
    """A one-line error for what rosbags or its codecs found wrong with the recording at ``path``."""
    reason = " ".join(str(error).split())[:200]
    inner = isinstance(error, UnicodeError | EOFError | TypeError) or "('" in reason or not reason
    return InvalidInput(
        f"{path} cannot be read as a recording: {'its bytes make no sense' if inner else reason}",
        f"it may be truncated or no bag at all: compare its size with the original, or {reindexing(path)}",
    )


def reindexing(path: Path) -> str:
    """Advice to renew the index, or the metadata, of the recording at ``path``."""
    if path.suffix == ".bag":
        return "run 'rosbag reindex' on it"
    return "run 'ros2 bag reindex' on it" if path.is_dir() else "copy or download it again"
