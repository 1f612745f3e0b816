"""Chunks of a ROS 1 bag as they are written: their records, their index records and what the bag's end says of them."""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import lz4.frame
import numpy as np

from slamhive.bags.geometry import Array
from slamhive.bags.variants.ros1_index import INDEX_ENTRY, NO_COMPRESSION, OP_CHUNK, OP_INDEX, U32

Buffer = bytes | memoryview


@dataclass(frozen=True, slots=True)
class ChunkSummary:
    """What the end of a bag says about one of its chunks; ``position`` counts from the start of its piece."""

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
        """What they take in the file."""
        return sum(len(part) for part in self.parts)


def new_chunk(compression: str, parts: list[Buffer | range], size_bytes: int, entries: Array) -> NewChunks:
    """One chunk of records; ``size_bytes`` before compression, ``entries`` of :data:`ENTRY` say where messages are."""
    if compression != NO_COMPRESSION:
        parts = [_compress(b"".join(part for part in parts if not isinstance(part, range)), compression)]
    head = chunk_header(compression, size_bytes, sum(len(part) for part in parts))
    summary = summarise(0, entries)
    return NewChunks([head, *parts, *_index_records(entries, summary.counts)], [summary])


def _compress(data: bytes, compression: str) -> bytes:
    """With the settings of ``rosbag``; its LZ4 reads frames of independent blocks with a checksum and no size only."""
    if compression == "bz2":
        return bz2.compress(data, 9)
    packed: bytes = lz4.frame.compress(
        data, block_size=lz4.frame.BLOCKSIZE_MAX1MB, block_linked=False, content_checksum=True, store_size=False
    )
    return packed


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
    """What precedes the entries of an index record."""
    fields = record_header(OP_INDEX, ver=U32.pack(1), conn=U32.pack(connection), count=U32.pack(count))
    return fields + U32.pack(count * INDEX_ENTRY.itemsize)


def chunk_header(compression: str, size_bytes: int, data_bytes: int) -> bytes:
    """What precedes the data of a chunk."""
    fields = record_header(OP_CHUNK, compression=compression.encode(), size=U32.pack(size_bytes))
    return fields + U32.pack(data_bytes)


def record_header(operation: int, **fields: bytes) -> bytes:
    """A record's header with its length in front; the record's data and their length follow it."""
    parts = [b"op=" + bytes([operation]), *(name.encode() + b"=" + value for name, value in fields.items())]
    body = b"".join(U32.pack(len(part)) + part for part in parts)
    return U32.pack(len(body)) + body
