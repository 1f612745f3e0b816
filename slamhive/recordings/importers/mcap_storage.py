"""One MCAP file, read by its index where that is complete, else in order as far as its bytes make sense.

rosbags refuses a whole file for one channel that is no CDR, a profile of another name, or an index that lacks a part.
Here such a channel is one that the file has and that cannot be read.
"""

from __future__ import annotations

import heapq
import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import ReaderError

MCAP_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    OSError,
    ValueError,
    KeyError,
    RuntimeError,
    OverflowError,
    MemoryError,
)
"""What the mcap library and its codecs raise on damaged bytes. RuntimeError is that of lz4; ValueError includes wrong
checksums and text that is not UTF-8."""

_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_RUN_BYTES = 4_000_000
"""Messages outside of chunks are read in runs of so many bytes."""

Entry = tuple[Connection, int, bytes]


@dataclass(frozen=True, slots=True)
class _Span:
    """A chunk, or messages without one that follow each other: when they were received, and where they lie."""

    start_ns: int
    end_ns: int
    offset: int
    size: int


class McapStorage:
    """An open MCAP file.

    Attributes:
        connections: The channels of ROS messages, with the number of messages of each that can be read.
        unreadable: By topic, the reason why its messages cannot be read.
        start_ns: When the first message was received.
        end_ns: When the last message was received.
        damage: Where and why reading ended early, in words; empty for a whole file.
        lost: How many messages the file says that it has, and that cannot be read; None if it does not say that.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unreadable: dict[str, str] = {}
        self.damage = ""
        self.lost: int | None = None
        self._file: IO[bytes] = path.open("rb")
        self._size = os.fstat(self._file.fileno()).st_size
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._counts: Counter[int] = Counter()
        self._spans: list[_Span] = []
        try:
            if not self._read_index():
                self._scan()
        except BaseException:
            self.close()
            raise
        self.start_ns = min((span.start_ns for span in self._spans), default=0)
        self.end_ns = max((span.end_ns for span in self._spans), default=0)
        self.connections = self._connections()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, connections: Collection[Connection], start_ns: int | None = None) -> Iterator[Entry]:
        """The messages of ``connections`` in order of time; raises rosbags' ReaderError where the file is damaged."""
        wanted = {entry.id: entry for entry in connections}
        spans = [span for span in self._spans if start_ns is None or span.end_ns >= start_ns]
        for entry in heapq.merge(*(self._sorted(span, wanted) for span in spans), key=lambda entry: entry[1]):
            if entry[0] is not None and (start_ns is None or entry[1] >= start_ns):
                yield entry[0], entry[1], entry[2]

    def _sorted(self, span: _Span, wanted: dict[int, Connection]) -> Iterator[tuple[Connection | None, int, bytes]]:
        # a chunk is read when its time has come: many of them do not fit into memory
        yield None, span.start_ns, b""
        self._file.seek(span.offset)
        data = self._file.read(span.size)
        found: list[Entry] = []
        try:
            for record in self._records(BytesIO(data), skip_magic=True):
                # no comprehension: what was read stays when the reader finds the end of the span
                if isinstance(record, Message) and record.channel_id in wanted:
                    found.append((wanted[record.channel_id], record.log_time, record.data))  # noqa: PERF401
        except EndOfFile:
            pass
        except MCAP_DAMAGE as error:
            raise ReaderError(f"{error} in {span.size} bytes from byte {span.offset} on") from None
        yield from sorted(found, key=lambda entry: entry[1])

    def _records(self, stream: IO[bytes], **how: bool) -> Iterator[object]:
        reader = StreamReader(stream, validate_crcs=True, record_size_limit=self._size, **how)
        return iter(reader.records)

    def _read_index(self) -> bool:
        """Take spans, channels and counts from the summary; whether it has them all."""
        try:
            summary = SeekingReader(self._file, record_size_limit=self._size).get_summary()
        except MCAP_DAMAGE:
            return False
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return False
        counts = summary.statistics.channel_message_counts
        schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
        whole = counts.keys() <= summary.channels.keys() and schemas <= summary.schemas.keys()
        if not whole or summary.statistics.chunk_count != len(summary.chunk_indexes):
            return False
        self._channels, self._schemas = dict(summary.channels), dict(summary.schemas)
        self._counts.update(counts)
        self._spans = [
            _Span(chunk.message_start_time, chunk.message_end_time, chunk.chunk_start_offset, chunk.chunk_length)
            for chunk in summary.chunk_indexes
        ]
        return True

    def _scan(self) -> None:
        """Go through the whole file in order, until its end or to where its bytes make no sense."""
        self._file.seek(0)
        place, stated, reason = 0, None, ""
        try:
            # checksums of the whole data are not asked for: a file that was cut has none
            reader = StreamReader(self._file, emit_chunks=True, record_size_limit=self._size)
            for record in reader.records:
                end = self._file.tell()
                if isinstance(record, Statistics):
                    stated = record.message_count
                elif isinstance(record, Chunk):
                    reason = self._add_chunk(record, place, end - place) or reason
                else:
                    self._add(record, place, end - place)
                place = end
        except EndOfFile:
            reason = "it ends within a record"
        except MCAP_DAMAGE as error:
            reason = " ".join(str(error).split())[:200] or "its bytes make no sense"
        read = sum(self._counts.values())
        if stated is not None:
            self.lost = max(stated - read, 0)
        if reason:
            of = "" if stated is None else f" of {stated}"
            self.damage = f"{self.path.name}: {read}{of} messages can be read; from byte {place} on, {reason}"

    def _add_chunk(self, chunk: Chunk, offset: int, size: int) -> str:
        """Note what is in a chunk; the reason if it cannot be read."""
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except MCAP_DAMAGE as error:
            return f"a chunk is damaged ({' '.join(str(error).split())[:200]})"
        times_ns = [record.log_time for record in records if isinstance(record, Message)]
        for record in records:
            self._note(record)
        if times_ns:
            self._spans.append(_Span(min(times_ns), max(times_ns), offset, size))
        return ""

    def _add(self, record: object, offset: int, size: int) -> None:
        self._note(record)
        if not isinstance(record, Message):
            return
        time_ns, last = record.log_time, self._spans[-1] if self._spans else None
        if last is not None and last.offset + last.size == offset and last.size < _RUN_BYTES:
            self._spans[-1] = _Span(
                min(last.start_ns, time_ns), max(last.end_ns, time_ns), last.offset, last.size + size
            )
        else:
            self._spans.append(_Span(time_ns, time_ns, offset, size))

    def _note(self, record: object) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message):
            self._counts[record.channel_id] += 1

    def _connections(self) -> list[Connection]:
        found = []
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            kind = "" if schema is None else _ros2_name(schema.name)
            if channel.message_encoding not in {"cdr", "ros1"}:
                self.unreadable[channel.topic] = f"its messages are {channel.message_encoding or 'of no encoding'}"
                continue
            if not kind:
                self.unreadable[channel.topic] = "the file does not say of which type its messages are"
                continue
            format_ = _FORMATS.get("" if schema is None else schema.encoding, MessageDefinitionFormat.NONE)
            text = "" if schema is None or format_ is MessageDefinitionFormat.NONE else _text(schema.data)
            found.append(
                Connection(
                    number,
                    channel.topic,
                    kind,
                    MessageDefinition(format_ if text else MessageDefinitionFormat.NONE, text),
                    channel.metadata.get("md5sum", ""),
                    self._counts[number],
                    ConnectionExtRosbag2(channel.message_encoding, []),
                    self,
                )
            )
        return found


def _ros2_name(name: str) -> str:
    """``sensor_msgs/msg/Imu`` for the ``sensor_msgs/Imu`` of ROS 1."""
    package, _, kind = name.partition("/")
    return name if "/" in kind or not kind else f"{package}/msg/{kind}"


def _text(data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return ""
