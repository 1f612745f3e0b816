"""The index of a ROS 1 bag: where each message lies, read without touching the messages.

Format 2.0, https://wiki.ros.org/Bags/Format/2.0: a bag is a list of records (header fields, then data). Messages are in
chunks, each followed by one index record for every connection in it. Connections and a summary of the chunks end the
file. Positions and sizes are bytes; times are nanoseconds.
"""

from __future__ import annotations

import bz2
import errno
import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import lz4.frame
import numpy as np

from slamhive.recordings.geometry import Array
from slamhive.runtime.recording import damaged

MAGIC = b"#ROSBAG V2.0\n"
NO_COMPRESSION = "none"
OP_MESSAGE, OP_BAG, OP_INDEX, OP_CHUNK, OP_CHUNK_INFO, OP_CONNECTION = 2, 3, 4, 5, 6, 7
U32 = struct.Struct("<L")

DECOMPRESS: dict[str, Any] = {NO_COMPRESSION: bytes, "bz2": bz2.decompress, "lz4": lz4.frame.decompress}

ENTRY = np.dtype([("time_ns", "<i8"), ("offset", "<u4"), ("connection", "<u4")])
"""One message in a chunk; ``offset`` counts from the start of the chunk's uncompressed data."""
INDEX_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])
"""The same as an index record holds it."""

_NO_RANGE_COPY = {errno.EXDEV, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP}
"""What ``copy_file_range`` answers between file systems that do not know it of each other."""

Fields = dict[bytes, bytes]


@dataclass(frozen=True, slots=True)
class Ros1Connection:
    """A connection; ``record`` is its whole record in the file, byte by byte."""

    id: int
    topic: str
    type: str
    md5: str
    definition: str
    record: bytes


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk; ``end`` is behind its index records, ``rows`` where its messages are in :attr:`Ros1Index.entries`."""

    position: int
    data_position: int
    data_bytes: int
    size_bytes: int
    compression: str
    end: int
    rows: range


@dataclass(frozen=True, slots=True)
class Ros1Index:
    """Content of a bag, with positions; ``entries`` are of :data:`ENTRY`, by chunk and then by offset."""

    path: Path
    connections: dict[int, Ros1Connection]
    chunks: tuple[Chunk, ...]
    entries: Array


class Ros1File:
    """An open ROS 1 bag that may be read from several threads; damage comes out as one line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = os.open(path, os.O_RDONLY)
        self._copies_ranges = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    def read(self, position: int, size: int) -> bytes:
        """Exactly ``size`` bytes at ``position``; raises InvalidInput where the file ends before."""
        data = os.pread(self._descriptor, size, position)
        while len(data) < size:
            more = os.pread(self._descriptor, size - len(data), position + len(data))
            if not more:
                raise damaged(self.path, EOFError(f"{size - len(data)} bytes are missing at byte {position}"))
            data += more
        return data

    def copy_to(self, descriptor: int, extent: range) -> None:
        """Append the bytes of ``extent`` to another file without taking them into this process.

        Raises InvalidInput where the file ends before, OSError where the other cannot be written.
        """
        position = extent.start
        while position < extent.stop:
            count = self._copy(descriptor, position, extent.stop - position)
            if count == 0:
                raise damaged(self.path, EOFError(f"{extent.stop - position} bytes are missing at byte {position}"))
            position += count

    def _copy(self, descriptor: int, position: int, size: int) -> int:
        if self._copies_ranges:
            try:
                return os.copy_file_range(self._descriptor, descriptor, size, position)
            except OSError as error:
                if error.errno not in _NO_RANGE_COPY:
                    raise
                self._copies_ranges = False
        return os.sendfile(descriptor, self._descriptor, position, size)

    def chunk_data(self, chunk: Chunk) -> bytes:
        """The uncompressed data of a chunk; raises InvalidInput if it is not what the chunk's header says."""
        try:
            raw: bytes = DECOMPRESS[chunk.compression](self.read(chunk.data_position, chunk.data_bytes))
        except (OSError, ValueError, EOFError, RuntimeError) as error:
            raise damaged(self.path, error) from None
        if len(raw) != chunk.size_bytes:
            raise damaged(self.path, ValueError(f"chunk at byte {chunk.position} is {len(raw)} bytes long"))
        return raw


def read_index(file: Ros1File) -> Ros1Index:
    """Connections, chunks and messages of a bag; raises InvalidInput for a truncated, damaged or unindexed one."""
    try:
        return _IndexReader(file).read()
    except (struct.error, KeyError, ValueError, IndexError, EOFError, OverflowError, UnicodeDecodeError) as error:
        raise damaged(file.path, error) from None


def parse_fields(header: bytes) -> Fields:
    """The fields of a record's header."""
    fields: Fields = {}
    position = 0
    while position < len(header):
        (size,) = U32.unpack_from(header, position)
        name, equals, value = header[position + 4 : position + 4 + size].partition(b"=")
        if not equals:
            raise ValueError(f"a header field without '=' ({name[:20]!r})")
        fields[name] = value
        position += 4 + size
    return fields


def message_offset(data: bytes | memoryview, offset: int = 0) -> int:
    """Where the message record at ``offset`` begins: an index may point at a connection record right before it.

    Raises struct.error, ValueError or KeyError where there is no message.
    """
    while True:
        (header_bytes,) = U32.unpack_from(data, offset)
        operation = parse_fields(bytes(data[offset + 4 : offset + 4 + header_bytes]))[b"op"]
        if operation == bytes([OP_MESSAGE]):
            return offset
        if operation != bytes([OP_CONNECTION]):
            raise ValueError(f"record of kind {operation.hex()} where a message was expected")
        (data_bytes,) = U32.unpack_from(data, offset + 4 + header_bytes)
        offset += 8 + header_bytes + data_bytes


class _IndexReader:
    """Walks the records that are no messages."""

    def __init__(self, file: Ros1File) -> None:
        self._stream = io.BufferedReader(io.FileIO(file.path), 1 << 14)
        self._size = file.path.stat().st_size
        self._path = file.path

    def read(self) -> Ros1Index:
        with self._stream:
            if self._take(len(MAGIC)) != MAGIC:
                raise ValueError("it does not begin as a ROS bag 2.0")
            header = self._fields(OP_BAG)
            (index_position,) = struct.unpack("<Q", header[b"index_pos"])
            if index_position == 0:
                raise ValueError("it is not indexed")
            if index_position > self._size:
                raise EOFError(f"its index should be at byte {index_position}, it has {self._size}")
            self._stream.seek(index_position)
            connections = [self._connection() for _ in range(_u32(header, b"conn_count"))]
            # Each chunk: its place, and how many connections it has messages of.
            positions: list[tuple[int, int]] = []
            for _ in range(_u32(header, b"chunk_count")):
                fields = self._fields(OP_CHUNK_INFO)
                self._take(self._u32())
                (position,) = struct.unpack("<Q", fields[b"chunk_pos"])
                positions.append((position, _u32(fields, b"count")))
            chunks, entries = self._chunks(sorted(positions))
        known = {connection.id: connection for connection in connections}
        strange = set(np.unique(entries["connection"]).tolist()) - set(known)
        if strange:
            raise ValueError(f"messages of connection {min(strange)}, which it does not describe")
        return Ros1Index(self._path, known, tuple(chunks), entries)

    def _chunks(self, positions: list[tuple[int, int]]) -> tuple[list[Chunk], Array]:
        chunks: list[Chunk] = []
        records: list[tuple[int, int, bytes]] = []
        row = 0
        for number, (position, connections) in enumerate(positions):
            self._stream.seek(position)
            fields = self._fields(OP_CHUNK)
            if fields[b"compression"].decode() not in DECOMPRESS:
                raise ValueError(f"compression {fields[b'compression'].decode()!r} is not known")
            data_bytes = self._u32()
            data_position = self._stream.tell()
            self._stream.seek(data_position + data_bytes)
            first_row = row
            for _ in range(connections):
                index = self._fields(OP_INDEX)
                raw_entries = self._take(self._u32())
                count = _u32(index, b"count")
                if len(raw_entries) != count * INDEX_ENTRY.itemsize:
                    raise ValueError("an index record of the wrong length")
                records.append((number, _u32(index, b"conn"), raw_entries))
                row += count
            rows = range(first_row, row)
            size_bytes, compression = _u32(fields, b"size"), fields[b"compression"].decode()
            chunks.append(
                Chunk(position, data_position, data_bytes, size_bytes, compression, self._stream.tell(), rows)
            )
        # One array by chunk, then by offset within it.
        raw = np.frombuffer(b"".join(data for _, _, data in records), INDEX_ENTRY)
        counts = [len(data) // INDEX_ENTRY.itemsize for _, _, data in records]
        entries = np.empty(len(raw), ENTRY)
        entries["time_ns"] = raw["s"].astype(np.int64) * 1_000_000_000 + raw["ns"]
        entries["offset"] = raw["offset"]
        entries["connection"] = np.repeat(np.array([connection for _, connection, _ in records], np.uint32), counts)
        numbers = np.repeat(np.array([number for number, _, _ in records], np.int64), counts)
        order = np.lexsort((entries["offset"], numbers))
        ends = np.array([chunk.size_bytes for chunk in chunks], np.int64)
        behind = numbers[entries["offset"] >= ends[numbers]] if len(raw) else numbers
        if len(behind):
            raise ValueError(f"a message behind the end of the chunk at byte {chunks[int(behind[0])].position}")
        return chunks, entries[order]

    def _connection(self) -> Ros1Connection:
        start = self._stream.tell()
        header = self._fields(OP_CONNECTION)
        fields = parse_fields(self._take(self._u32()))
        end = self._stream.tell()
        self._stream.seek(start)
        return Ros1Connection(
            id=_u32(header, b"conn"),
            topic=normalise_topic(header[b"topic"].decode()),
            type=normalise_type(fields[b"type"].decode()),
            md5=fields[b"md5sum"].decode(),
            definition=fields[b"message_definition"].decode(),
            record=self._take(end - start),
        )

    def _fields(self, operation: int) -> Fields:
        fields = parse_fields(self._take(self._u32()))
        if fields[b"op"] != bytes([operation]):
            raise ValueError(f"record of kind {fields[b'op'].hex()} where {operation} was expected")
        return fields

    def _u32(self) -> int:
        value: int = U32.unpack(self._take(4))[0]
        return value

    def _take(self, size: int) -> bytes:
        position = self._stream.tell()
        if position + size > self._size:
            raise EOFError(f"{size} bytes are missing at byte {position}")
        return self._stream.read(size)


def normalise_topic(topic: str) -> str:
    """The topic without doubled or trailing slashes, as rosbags names it."""
    return ("/" if topic.startswith("/") else "") + "/".join(part for part in topic.split("/") if part)


def normalise_type(name: str) -> str:
    """``package/msg/Name`` for ROS 1's ``package/Name``, as rosbags names it."""
    package, _, kind = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{kind}"


def _u32(fields: Fields, name: bytes) -> int:
    value: int = U32.unpack(fields[name])[0]
    return value
