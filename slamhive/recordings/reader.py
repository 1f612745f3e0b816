"""Opens recordings (ROS 1 ``.bag``, ROS 2 folder, MCAP file), with errors that name a remedy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.domain.dataset import Dataset
from slamhive.runtime.recording import DAMAGE, damaged, reindexing

__all__ = [
    "DAMAGE",
    "BagSummary",
    "TopicSummary",
    "damaged",
    "decode",
    "inspect_bag",
    "messages",
    "open_bag",
    "recording_begin_s",
    "reindexing",
]


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a recording."""

    topic: str
    type: str
    count: int


@dataclass(frozen=True, slots=True)
class BagSummary:
    """The content of a recording; ``start_ns`` and ``end_ns`` are the first and last receive times."""

    topics: tuple[TopicSummary, ...]
    start_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """From the first to the last message."""
        return (self.end_ns - self.start_ns) * 1e-9


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """An open reader on the recording at ``path``.

    Read with :func:`messages` and :func:`decode`, which explain damage found later on.

    Raises:
        InvalidInput: absent, empty, truncated, or no recording at all.
    """
    _check_kind(path)
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except DAMAGE as error:
        raise damaged(path, error) from None
    try:
        yield reader
    finally:
        reader.close()


def recording_begin_s(dataset: Dataset) -> float:
    """The time of the first message of a dataset, in s since 1970; raises InvalidInput as :func:`open_bag`."""
    with open_bag(dataset.bag_path) as reader:
        return float(reader.start_time) * 1e-9


def messages(
    reader: AnyReader, path: Path, topics: list[str] | None = None, start_ns: int | None = None
) -> Iterator[tuple[Connection, int, bytes]]:
    """Messages in order of time: connection, receive time in ns, raw bytes.

    Only those of ``topics`` and those received at ``start_ns`` or later, if these are given.

    Raises InvalidInput where the recording turns out to be damaged.
    """
    wanted = [entry for entry in reader.connections if topics is None or entry.topic in topics]
    if not wanted:
        return
    source = reader.messages(connections=wanted, start=start_ns)
    while True:
        try:
            message = next(source, None)
        except DAMAGE as error:
            raise damaged(path, error) from None
        if message is None:
            return
        yield message


def decode(reader: AnyReader, path: Path, connection: Connection, raw: bytes) -> Any:
    """The message in ``raw``, with the attributes of its ROS type; raises InvalidInput if it is damaged."""
    try:
        return reader.deserialize(raw, connection.msgtype)
    except DAMAGE as error:
        raise damaged(path, error) from None


def inspect_bag(path: Path) -> BagSummary:
    """Topics, types, counts and times of the recording at ``path``; raises InvalidInput as :func:`open_bag`."""
    with open_bag(path) as reader:
        if reader.message_count == 0:
            raise InvalidInput(f"{path} holds no messages", "record or copy it again")
        topics = tuple(
            TopicSummary(name, topic.msgtype or "various", topic.msgcount) for name, topic in reader.topics.items()
        )
        return BagSummary(topics, int(reader.start_time), int(reader.end_time) - 1)


def _check_kind(path: Path) -> None:
    remedy = "expected a ROS 1 .bag file, a ROS 2 folder with metadata.yaml, or an .mcap file"
    if not path.exists():
        raise InvalidInput(f"{path} does not exist", remedy)
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise InvalidInput(f"{path} is no recording: it holds no metadata.yaml", remedy)
    elif path.suffix not in {".bag", ".mcap", ".db3"}:
        raise InvalidInput(f"{path} is no recording, judging by its ending {path.suffix!r}", remedy)
    elif path.stat().st_size == 0:
        raise InvalidInput(f"{path} is empty (0 bytes)", "copy or download it again")
