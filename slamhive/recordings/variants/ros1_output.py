"""Writing a ROS 1 bag from ready-made chunks, with its checksum computed on the way where that can be."""

from __future__ import annotations

import bz2
import errno
import hashlib
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import lz4.frame
import numpy as np

from slamhive.recordings.geometry import Array
from slamhive.recordings.staging import checksum
from slamhive.recordings.variants.ros1_index import (
    INDEX_ENTRY,
    MAGIC,
    NO_COMPRESSION,
    OP_BAG,
    OP_CHUNK,
    OP_CHUNK_INFO,
    OP_INDEX,
    U32,
    Ros1Connection,
    Ros1File,
)

# Chunks of a ROS 1 bag as they are written: their records, their index records and what the bag's end says of them.


Buffer = bytes | memoryview


@dataclass(frozen=True, slots=True)
class ChunkSummary:
    """Entry at the end of a bag about one of its chunks; ``position`` counts from the start of its piece."""

    position: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]


@dataclass(frozen=True, slots=True)
class NewChunks:
    """Chunk records with their index records, ready to be written anywhere: bytes, or where they are in the source."""

    parts: list[Buffer | range]
    summaries: list[ChunkSummary]

    @property
    def size_bytes(self) -> int:
        """Bytes that they take in the file."""
        return sum(len(part) for part in self.parts)


def new_chunk(compression: str, parts: list[Buffer | range], size_bytes: int, entries: Array) -> NewChunks:
    """One chunk of records; ``size_bytes`` before compression, ``entries`` of :data:`ENTRY` say where messages are."""
    if compression != NO_COMPRESSION:
        data = b"".join(part for part in parts if not isinstance(part, range))
        # The settings of ``rosbag``: its LZ4 only reads frames of independent blocks with a checksum and no size.
        packed: bytes = (
            bz2.compress(data, 9)
            if compression == "bz2"
            else lz4.frame.compress(
                data, block_size=lz4.frame.BLOCKSIZE_MAX1MB, block_linked=False, content_checksum=True, store_size=False
            )
        )
        parts = [packed]
    head = chunk_header(compression, size_bytes, sum(len(part) for part in parts))
    summary = summarise(0, entries)
    return NewChunks([head, *parts, *_index_records(entries, summary.counts)], [summary])


def summarise(position: int, entries: Array) -> ChunkSummary:
    """The summary of a chunk at ``position`` with ``entries``."""
    times_ns = entries["time_ns"]
    counts = dict(sorted(Counter(entries["connection"].tolist()).items()))
    return ChunkSummary(position, int(times_ns.min()), int(times_ns.max()), counts)


def _index_records(entries: Array, counts: Mapping[int, int]) -> Iterator[bytes]:
    """One record for each connection; ``counts`` by connection, in the order wanted."""
    raw = np.empty(len(entries), INDEX_ENTRY)
    raw["s"], raw["ns"] = np.divmod(entries["time_ns"], 1_000_000_000)
    raw["offset"] = entries["offset"]
    raw = raw[np.argsort(entries["connection"], kind="stable")]
    start = 0
    for connection, count in counts.items():
        yield index_header(connection, count) + raw[start : start + count].tobytes()
        start += count


def index_header(connection: int, count: int) -> bytes:
    """Head of an index record, before its entries."""
    fields = record_header(OP_INDEX, ver=U32.pack(1), conn=U32.pack(connection), count=U32.pack(count))
    return fields + U32.pack(count * INDEX_ENTRY.itemsize)


def chunk_header(compression: str, size_bytes: int, data_bytes: int) -> bytes:
    """Head of a chunk, before its data."""
    fields = record_header(OP_CHUNK, compression=compression.encode(), size=U32.pack(size_bytes))
    return fields + U32.pack(data_bytes)


def record_header(operation: int, **fields: bytes) -> bytes:
    """A record's header with its length in front; the record's data and their length follow it."""
    parts = [b"op=" + bytes([operation]), *(name.encode() + b"=" + value for name, value in fields.items())]
    body = b"".join(U32.pack(len(part)) + part for part in parts)
    return U32.pack(len(body)) + body


_HEADER_BYTES = 4096
"""The bag header's record, padded so that it can be written again when the numbers in it are known."""
_BLOCK_BYTES = 1 << 18
"""Written and hashed at a time: little enough to stay in the processor's cache."""
_PARTS = 512
"""Most that are written at a time; the kernel takes 1024 (IOV_MAX)."""
_COPY_BYTES = 1 << 14
"""From this size on it is cheaper to let the kernel copy than to read and write."""
_TIME = struct.Struct("<LL")


@dataclass(frozen=True, slots=True)
class BagExtent:
    """Receive times of a bag's first and last message, None if it holds none."""

    start_ns: int | None
    end_ns: int | None


class Ros1Output:
    """A bag being written; use as a context manager, and call :meth:`finish` at the end.

    A bag begins with the position of its index. Where that is foretold rightly the checksum is computed while writing,
    in a thread of its own; otherwise the result is read once more, from memory as a rule.

    Args:
        path: A file that does not exist yet.
        connections: All connections.
        chunks: The number of chunks to come, as far as is known.
        chunks_bytes: Their size with their index records; None if nothing is known.
    """

    def __init__(
        self, path: Path, connections: Sequence[Ros1Connection], chunks: int, chunks_bytes: int | None
    ) -> None:
        self._path = path
        self._connections = connections
        self._summaries: list[ChunkSummary] = []
        self._position = 0
        self._file = _HashedFile(path, digest=chunks_bytes is not None)
        self._header = self._bag_header(len(MAGIC) + _HEADER_BYTES + (chunks_bytes or 0), chunks)
        self._put(self._header)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def write(self, chunks: NewChunks, source: Ros1File) -> None:
        """Append chunks; what they take from ``source`` is copied by the kernel."""
        self._summaries += [replace(entry, position=self._position + entry.position) for entry in chunks.summaries]
        for part in chunks.parts:
            if isinstance(part, range):
                self._file.copy(source, part)
                self._position += len(part)
            else:
                self._put(part)

    def finish(self) -> tuple[str, BagExtent]:
        """Write the index; the checksum and the times of the whole bag."""
        header = self._bag_header(self._position, len(self._summaries))
        records = [connection.record for connection in self._connections]
        for summary in self._summaries:
            head = record_header(
                OP_CHUNK_INFO,
                ver=U32.pack(1),
                chunk_pos=struct.pack("<Q", summary.position),
                start_time=_time(summary.start_ns),
                end_time=_time(summary.end_ns),
                count=U32.pack(len(summary.counts)),
            )
            data = b"".join(U32.pack(connection) + U32.pack(count) for connection, count in summary.counts.items())
            records += [head, U32.pack(len(data)), data]
        self._put(b"".join(records))
        extent = BagExtent(
            min((summary.start_ns for summary in self._summaries), default=None),
            max((summary.end_ns for summary in self._summaries), default=None),
        )
        digest = self._file.finish()
        if digest is not None and header == self._header:
            return digest, extent
        with self._path.open("r+b") as stream:
            stream.write(header)
        return checksum(self._path), extent

    def _put(self, data: Buffer) -> None:
        self._file.add(data)
        self._position += len(data)

    def _bag_header(self, index_position: int, chunks: int) -> bytes:
        head = record_header(
            OP_BAG,
            index_pos=struct.pack("<Q", index_position),
            conn_count=U32.pack(len(self._connections)),
            chunk_count=U32.pack(chunks),
        )
        padding = _HEADER_BYTES - len(head) - U32.size
        return MAGIC + head + U32.pack(padding) + b" " * padding


class _HashedFile:
    """A file written from its start to its end; a thread hashes what is written, reading it again from memory.

    Bytes are gathered and written many at a time. What comes from another file is copied by the kernel.
    """

    def __init__(self, path: Path, *, digest: bool) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        self._waiting: list[Buffer] = []
        self._waiting_bytes = 0
        self._written = 0
        self._hash = hashlib.sha256() if digest else None
        self._hashed = 0
        self._block = memoryview(bytearray(_BLOCK_BYTES))
        self._pool = ThreadPoolExecutor(1, "checksum")
        self._hashing: Future[None] | None = None

    def add(self, data: Buffer) -> None:
        """Append bytes."""
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        if self._waiting_bytes >= _BLOCK_BYTES or len(self._waiting) >= _PARTS:
            self._flush()

    def copy(self, file: Ros1File, extent: range) -> None:
        """Append an extent of another file."""
        if len(extent) < _COPY_BYTES:
            self.add(file.read(extent.start, len(extent)))
            return
        self._flush()
        file.copy_to(self._descriptor, extent)
        self._grown(len(extent))

    def finish(self) -> str | None:
        """Write what is left; ``sha256:<hex>`` of everything, if that was asked for."""
        self._flush()
        if self._hash is None:
            return None
        if self._hashing is not None:
            self._hashing.result()
        self._hash_to(self._written)
        return f"sha256:{self._hash.hexdigest()}"

    def close(self) -> None:
        """Let go of the file and the thread."""
        self._pool.shutdown(cancel_futures=True)
        os.close(self._descriptor)

    def _flush(self) -> None:
        parts, size_bytes = self._waiting, self._waiting_bytes
        self._waiting, self._waiting_bytes = [], 0
        written = os.writev(self._descriptor, parts) if parts else 0
        if written < size_bytes:
            rest = memoryview(b"".join(parts))[written:]
            while len(rest):
                rest = rest[os.write(self._descriptor, rest) :]
        self._grown(size_bytes)

    def _grown(self, size_bytes: int) -> None:
        self._written += size_bytes
        if self._hash is not None and (self._hashing is None or self._hashing.done()):
            if self._hashing is not None:
                self._hashing.result()
            self._hashing = self._pool.submit(self._hash_to, self._written)

    def _hash_to(self, position: int) -> None:
        assert self._hash is not None, "called only where there is a hash"
        while self._hashed < position:
            block = self._block[: min(_BLOCK_BYTES, position - self._hashed)]
            count = os.preadv(self._descriptor, [block], self._hashed)
            if count == 0:
                raise OSError(errno.EIO, "what was written is not there")
            self._hash.update(block[:count])
            self._hashed += count


def _time(time_ns: int) -> bytes:
    return _TIME.pack(*divmod(time_ns, 1_000_000_000))
