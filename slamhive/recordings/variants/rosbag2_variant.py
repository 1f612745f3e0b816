"""The recording of a variant, from a ROS 2 recording or an MCAP file: one pass in order of time.

What is needed to decide about a message is known when it comes, so nothing but the messages under way is in memory.
Messages that no step touches are copied as raw bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.staging import Pending, Progress, Ready, checksum, in_order, one_thread_in_opencv
from slamhive.recordings.variants.ros1_output import BagExtent
from slamhive.recordings.variants.ros1_rewrite import TopicChoice, check_timestamp, freed_memory_kept, one_type
from slamhive.recordings.variants.streams import TopicStream, Treatment, make_edit
from slamhive.recordings.writers import copy_connection, rosbag2_writer, storage_of
from slamhive.runtime.recording import damaged

_NS_PER_S = 1_000_000_000
_LATEST_NS = 2**31 * _NS_PER_S
"""Seconds of ROS 2 are signed numbers of 32 bits."""
_TIMESTAMP_OFFSET = 4
"""Of a message that begins with a ``std_msgs/Header``: behind the four bytes that say how it is encoded."""
_HEADER = "std_msgs/msg/Header"

Buffer = bytes | bytearray | memoryview


@dataclass(frozen=True, slots=True, eq=False)
class _Message:
    """One message of the result."""

    connection: Connection
    received_ns: int
    data: bytes | memoryview


_Task = Ready[_Message] | Pending[_Message]


def make_rosbag2(
    source: Path, target: Path, choose: TopicChoice, progress: Progress
) -> tuple[str, BagExtent, BagExtent]:
    """Write the recording ``target``; its checksum, and the extents of the source and of the result.

    Raises:
        InvalidInput: the source is damaged, or does not hold what the steps need.
        OSError: the target cannot be written.
    """
    with open_bag(source) as reader:
        topics = _topics(source, reader, choose)
        total = reader.message_count
        before = BagExtent(int(reader.start_time), int(reader.end_time) - 1) if total else BagExtent(None, None)
        with (
            freed_memory_kept(),
            one_thread_in_opencv(),
            rosbag2_writer(target, storage_of(source, reader)) as writer,
        ):
            connections = {entry.id: copy_connection(writer, entry, reader) for entry in reader.connections}
            tasks = _tasks(source, reader, topics, lambda done: progress(done / total, "making the variant"))
            after = _write(writer, in_order(tasks), connections)
    return checksum(target), before, after


def _write(writer: Writer, made: Iterator[_Message], connections: dict[int, Connection]) -> BagExtent:
    """Write all messages; their first and last receive time."""
    start_ns, end_ns = None, None
    for message in made:
        writer.write(connections[message.connection.id], message.received_ns, message.data)
        start_ns = message.received_ns if start_ns is None else min(start_ns, message.received_ns)
        end_ns = message.received_ns if end_ns is None else max(end_ns, message.received_ns)
    return BagExtent(start_ns, end_ns)


def _topics(source: Path, reader: AnyReader, choose: TopicChoice) -> dict[str, _Topic]:
    chosen = choose({entry.topic: entry.msgtype for entry in reader.connections})
    return {topic: _Topic(source, reader, topic, treatment) for topic, treatment in chosen.items()}


def _tasks(source: Path, reader: AnyReader, topics: dict[str, _Topic], done: Callable[[int], None]) -> Iterator[_Task]:
    """Result of each message that is kept."""
    for number, (connection, received_ns, raw) in enumerate(messages(reader, source), start=1):
        topic = topics.get(connection.topic)
        message = _Message(connection, received_ns, raw)
        task = Ready(message, len(raw)) if topic is None else topic.take(message)
        if task is not None:
            yield task
        done(number)


class _Topic:
    """Operations of the steps on the messages of one topic, which come in order of time."""

    def __init__(self, source: Path, reader: AnyReader, topic: str, treatment: Treatment) -> None:
        self._source = source
        self._reader = reader
        self._topic = topic
        connections = [entry for entry in reader.connections if entry.topic == topic]
        self._type = one_type(topic, {entry.msgtype for entry in connections})
        self._stream = TopicStream(treatment, sum(entry.msgcount for entry in connections))
        self._edit = make_edit(topic, self._type, self._stream)
        self._number = -1
        if self._edit is not None or self._stream.uses_stamps:
            self._check_definition()

    def take(self, message: _Message) -> _Task | None:
        """Operation on the next message; None if it is dropped."""
        self._number += 1
        raw = message.data
        stamp_ns = message.received_ns
        if self._stream.uses_stamps:
            try:
                seconds, nanoseconds = struct.unpack_from(f"{_byte_order(raw)}iI", raw, _TIMESTAMP_OFFSET)
            except (struct.error, IndexError):
                raise damaged(self._source, ValueError("a message without a header")) from None
            stamp_ns = int(seconds) * _NS_PER_S + int(nanoseconds)
        decided_ns = self._stream.decide(stamp_ns)
        if decided_ns is None:
            return None
        moved_ns = None if decided_ns == stamp_ns else check_timestamp(decided_ns, self._topic, _LATEST_NS)
        if self._edit is None and moved_ns is None:
            return Ready(message, len(raw))
        return Pending(partial(self._change, message, self._number, moved_ns), len(raw))

    def _change(self, message: _Message, number: int, moved_ns: int | None) -> _Message:
        """The message with another content or timestamp; its receive time stays."""
        data = message.data
        if self._edit is not None:
            content = decode(self._reader, self._source, message.connection, bytes(data))
            edited = self._edit(content, number, message.received_ns)
            data = self._reader.typestore.serialize_cdr(edited, self._type)
        if moved_ns is not None:
            changed = bytearray(data)
            struct.pack_into(f"{_byte_order(changed)}iI", changed, _TIMESTAMP_OFFSET, *divmod(moved_ns, _NS_PER_S))
            data = memoryview(changed)
        return _Message(message.connection, message.received_ns, data)

    def _check_definition(self) -> None:
        """Check that the type has its standard definition; others may share its name."""
        standard = get_typestore(Stores.ROS2_HUMBLE).fielddefs.get(self._type)
        found = self._reader.typestore.fielddefs.get(self._type)
        if standard is None or found is None or standard[1] != found[1] or found[1][0][1][1] != _HEADER:
            raise InvalidInput(
                f"{self._topic} carries {self._type} in a definition of its own",
                "steps that look into messages need the standard ones of ROS 2, which begin with a header",
            )


def _byte_order(raw: Buffer) -> str:
    """Of a message in CDR (OMG DDSI-RTPS 2.3, section 10.2): the second byte's lowest bit says little endian."""
    return "<" if raw[1] & 1 else ">"
