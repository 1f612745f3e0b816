"""A ROS or MCAP recording to import: its topics from the index, a few messages, and streams of single topics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from slamhive.bags.bag_writer import NS_PER_S
from slamhive.bags.importing import ImportOptions
from slamhive.bags.reader import DAMAGE, damaged
from slamhive.errors import InvalidInput, nearest
from slamhive.files import visible_files
from slamhive.runtime.messages import stamp_ns

_WINDOWS_S = (2.0, 20.0, 200.0)
"""How long before the end the last message of a topic is looked for, before the whole topic is read."""
_LONGEST_DEFINITION_BYTES = 1_000_000
_BAD_METADATA = (TypeError, AttributeError)
"""What follows from values of another type in ``metadata.yaml``, which rosbags does not check."""


@dataclass(frozen=True, slots=True)
class SourceTopic:
    """A topic of the recording: name, message type such as ``sensor_msgs/msg/Imu``, and number of messages."""

    name: str
    type: str
    count: int


class SourceBag:
    """An open recording; use :func:`open_source`.

    Attributes:
        path: What messages call it.
        topics: By name, those with messages only.
        start_ns: When the first message was received.
        end_ns: When the last message was received.
    """

    def __init__(self, path: Path, reader: AnyReader, spare: Typestore) -> None:
        self.path = path
        self.reader = reader
        self._spare = spare
        self.topics = {topic.name: topic for topic in self._listed() if topic.count}
        if not self.topics:
            raise InvalidInput(f"{path} holds no messages", "record or copy it again")
        self.start_ns = int(reader.start_time)
        self.end_ns = max(int(reader.end_time) - 1, self.start_ns)
        self._first: dict[str, Any] = {}

    def topic(self, name: str, purpose: str) -> SourceTopic:
        """The topic called ``name``, which is wanted for ``purpose``; raises InvalidInput with the nearest name."""
        if name not in self.topics:
            raise InvalidInput(f"{self.path} has no topic {name!r} for {purpose}; {nearest(name, list(self.topics))}")
        return self.topics[name]

    def of_type(self, *types: str) -> list[SourceTopic]:
        """The topics of these message types."""
        return [topic for topic in self.topics.values() if topic.type in types]

    def first(self, topic: str) -> Any:
        """The first message of ``topic``."""
        if topic not in self._first:
            found = next(self.stream(topic), None)
            if found is None:
                raise InvalidInput(f"{self.path}: the index has messages of {topic}, the recording none", "reindex it")
            self._first[topic] = found[1]
        return self._first[topic]

    def stamps_ns(self, topic: str) -> tuple[int, int]:
        """The timestamps in the headers of the first message of ``topic`` and of the last one."""
        return stamp_ns(self.first(topic)), stamp_ns(self._last(topic))

    def stream(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[int, Any]]:
        """When each message of ``topic`` was received, and the message; raises InvalidInput where it is damaged."""
        for connection, received_ns, raw in self.raw(topic, start_ns=start_ns):
            yield received_ns, self.decode(connection, raw)

    def raw(self, *topics: str, start_ns: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """The messages of ``topics`` in order of time, not decoded; raises InvalidInput where one is damaged."""
        wanted = [entry for entry in self.reader.connections if entry.topic in topics]
        source = self.reader.messages(connections=wanted, start=start_ns)
        number = 0
        while True:
            try:
                entry = next(source, None)
            except DAMAGE as error:
                raise self.damaged(error, f"message {number + 1} of {', '.join(topics)}{self._near()}") from None
            if entry is None:
                return
            number += 1
            yield entry

    def decode(self, connection: Connection, raw: bytes) -> Any:
        """The message in ``raw``; raises InvalidInput if its type is unknown or it is damaged."""
        self._define(connection)
        try:
            return self.reader.deserialize(raw, connection.msgtype)
        except DAMAGE as error:
            raise self.damaged(error, f"a message of {connection.topic}") from None

    def damaged(self, error: Exception, place: str) -> InvalidInput:
        """What rosbags found wrong at ``place``, in one line."""
        found = damaged(self.path, error)
        return InvalidInput(f"{found.message} ({place})", found.remedy)

    def _near(self) -> str:
        """Where reading stopped, for files of which that is known."""
        storages = [getattr(reader, "storage", reader) for reader in self.reader.readers]
        files = [getattr(part, "bio", None) for storage in storages for part in getattr(storage, "storages", [storage])]
        places = [file.tell() for file in files if file is not None]
        return f", before byte {places[0]}" if len(places) == 1 else ""

    def _last(self, topic: str) -> Any:
        for window_s in _WINDOWS_S:
            start_ns = self.end_ns - int(window_s * NS_PER_S)
            raw = _last_of(self.raw(topic, start_ns=start_ns))
            if raw is not None or start_ns <= self.start_ns:
                break
        else:
            raw = _last_of(self.raw(topic))
        return self.first(topic) if raw is None else self.decode(raw[0], raw[2])

    def _listed(self) -> Iterator[SourceTopic]:
        kinds: dict[str, set[str]] = {}
        counts: dict[str, int] = {}
        for entry in self.reader.connections:
            kinds.setdefault(entry.topic, set()).add(entry.msgtype)
            counts[entry.topic] = counts.get(entry.topic, 0) + entry.msgcount
        for name in sorted(kinds):
            yield SourceTopic(name, kinds[name].pop() if len(kinds[name]) == 1 else "various", counts[name])

    def _define(self, connection: Connection) -> None:
        """Add the definition of a type that the recording lacks."""
        kind, known = connection.msgtype, self.reader.typestore
        if kind in known.fielddefs:
            return
        if kind not in self._spare.fielddefs:
            raise InvalidInput(
                f"{self.path}: type {kind} of topic {connection.topic} is not defined in the recording",
                "give a folder with its .msg file and those it uses (--msgs DIR), or name a --typestore that has it",
            )
        missing = {name: fields for name, fields in self._spare.fielddefs.items() if name not in known.fielddefs}
        known.register(missing)


@contextmanager
def open_source(paths: Sequence[Path], options: ImportOptions, name: Path | None = None) -> Iterator[SourceBag]:
    """Open a recording, or several ROS 1 bags as one.

    Args:
        paths: The file, the folder of a ROS 2 bag, or the parts of a ROS 1 recording.
        options: Where definitions of message types come from.
        name: What messages call it; the first path unless given.

    Raises:
        InvalidInput: It is empty, damaged or none at all; a type store or definition is unknown.
    """
    spare = _spare_types(options)
    path = name or paths[0]
    for part in paths:
        if part.is_file() and part.stat().st_size == 0:
            raise InvalidInput(f"{part} is empty (0 bytes)", "copy or download it again")
    try:
        reader = AnyReader(paths, default_typestore=spare)
        reader.open()
    except (*DAMAGE, *_BAD_METADATA) as error:
        raise damaged(path, error) from None
    try:
        yield _opened(path, reader, spare)
    finally:
        reader.close()


def _opened(path: Path, reader: AnyReader, spare: Typestore) -> SourceBag:
    try:
        return SourceBag(path, reader, spare)
    except _BAD_METADATA:
        raise InvalidInput(
            f"{path}: metadata.yaml lacks a number or a name, or has another value there",
            "run `ros2 bag reindex` on it",
        ) from None


def _spare_types(options: ImportOptions) -> Typestore:
    """Definitions for recordings that have none: those of ROS 2 Humble or the named store, and those in files."""
    names = {store.value: store for store in Stores}
    wanted = options.typestore or Stores.ROS2_HUMBLE.value
    if wanted not in names:
        raise InvalidInput(f"typestore {wanted!r} is unknown; {nearest(wanted, list(names))}")
    store = get_typestore(names[wanted])
    if options.message_definitions is not None:
        found = _definitions(options.message_definitions)
        store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
    return store


def _definitions(folder: Path) -> dict[str, Any]:
    """The types of all ``.msg`` files below ``folder``; ``PACKAGE/msg/Name.msg`` names the package."""
    files = visible_files(folder, "**/*.msg")
    if not files:
        raise InvalidInput(f"{folder} holds no .msg file", "give the folder of PACKAGE/msg/Name.msg")
    found: dict[str, Any] = {}
    for file in files:
        package = file.parent.parent.name if file.parent.name == "msg" else file.parent.name
        try:
            text = file.read_bytes()[:_LONGEST_DEFINITION_BYTES].decode()
            found.update(get_types_from_msg(text, f"{package}/msg/{file.stem}"))
        except DAMAGE as error:
            raise InvalidInput(f"{file} is no message definition: {error}", "compare it with the package's") from None
    return found


def _last_of(messages: Iterator[tuple[Connection, int, bytes]]) -> tuple[Connection, int, bytes] | None:
    last = None
    for last in messages:  # noqa: B007 - the last one is what is wanted
        pass
    return last
