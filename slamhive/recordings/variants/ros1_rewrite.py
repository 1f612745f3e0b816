"""Rewriting a ROS 1 bag: decided from its index, then piece by piece, with untouched bytes as they are."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.recordings.geometry import Array
from slamhive.recordings.staging import Pending, Progress, Ready, in_order, one_thread_in_opencv
from slamhive.recordings.variants.payloads import EQUAL_SIZES, Edit
from slamhive.recordings.variants.ros1_index import (
    INDEX_ENTRY,
    NO_COMPRESSION,
    U32,
    Chunk,
    Ros1File,
    Ros1Index,
    message_offset,
    read_index,
)
from slamhive.recordings.variants.ros1_output import (
    BagExtent,
    Buffer,
    NewChunks,
    Ros1Output,
    chunk_header,
    index_header,
    new_chunk,
    summarise,
)
from slamhive.recordings.variants.streams import TopicStream, Treatment, make_edit
from slamhive.runtime.recording import DAMAGE, damaged

_STAMP = struct.Struct("<LL")
_STAMP_OFFSET = 4
"""Of the timestamp in a message that begins with a ``std_msgs/Header``: behind its sequence number."""
_LATEST_NS = 2**32 * 1_000_000_000
"""Seconds of ROS 1 are numbers of 32 bits."""
_PEEK_BYTES = 4096
"""Enough for a message record's header and the start of its data, even behind a connection record."""


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """For each row of the index: whether it is kept or changed, its number on its topic, its new timestamp.

    ``edits`` says by connection how the content changes. Messages of other connections get a new timestamp at most;
    ``stamps_ns`` is 0 where the timestamp stays.
    """

    kept: Array
    changed: Array
    numbers: Array
    stamps_ns: Array
    edits: dict[int, Edit]


def decide(file: Ros1File, index: Ros1Index, topics: dict[str, Treatment]) -> Decisions:
    """Run the steps' filters and timestamps over all messages of ``topics``; raises InvalidInput."""
    count = len(index.entries)
    decisions = Decisions(
        kept=np.ones(count, bool),
        changed=np.zeros(count, bool),
        numbers=np.zeros(count, np.uint32),
        stamps_ns=np.zeros(count, np.int64),
        edits={},
    )
    for topic, treatment in topics.items():
        connections = [connection for connection in index.connections.values() if connection.topic == topic]
        message_type = one_type(topic, {connection.type for connection in connections})
        rows = np.flatnonzero(np.isin(index.entries["connection"], [connection.id for connection in connections]))
        rows = rows[np.argsort(index.entries["time_ns"][rows], kind="stable")]
        stream = TopicStream(treatment, len(rows))
        edit = make_edit(topic, message_type, stream)
        stamps_ns = index.entries["time_ns"][rows]
        if edit is not None or stream.uses_stamps:
            # Another definition may share the name of a standard one.
            store = get_typestore(Stores.ROS1_NOETIC)
            for connection in connections:
                if message_type not in store.types or store.generate_msgdef(message_type)[1] != connection.md5:
                    raise InvalidInput(
                        f"{topic} carries {connection.type} in a definition of its own (md5 {connection.md5})",
                        "steps that look into messages need the standard ones of ROS Noetic",
                    )
        if stream.uses_stamps:
            stamps_ns = header_stamps(file, index, rows)
        decisions.numbers[rows] = np.arange(len(rows))
        for row, stamp_ns in zip(rows.tolist(), stamps_ns.tolist(), strict=True):
            decided_ns = stream.decide(stamp_ns)
            if decided_ns is None:
                decisions.kept[row] = False
            elif decided_ns != stamp_ns:
                decisions.stamps_ns[row] = check_timestamp(decided_ns, topic, _LATEST_NS)
                decisions.changed[row] = True
        if edit is not None:
            decisions.changed[rows] = True
            decisions.edits.update({connection.id: edit for connection in connections})
    return decisions


def one_type(topic: str, types: set[str]) -> str:
    """The type of a topic; raises InvalidInput if there are several."""
    if len(types) != 1:
        raise InvalidInput(f"topic {topic} carries messages of several types: {', '.join(sorted(types))}")
    return next(iter(types))


def header_stamps(file: Ros1File, index: Ros1Index, rows: Array) -> Array:
    """The header timestamps (ns) of the messages in ``rows``, in their order; decompresses chunks, decodes nothing."""
    stamps_ns = np.zeros(len(index.entries), np.int64)
    for row, raw in _records(file, index, rows):
        try:
            start = message_offset(raw)
            (header_bytes,) = U32.unpack_from(raw, start)
            seconds, nanoseconds = _STAMP.unpack_from(raw, start + 8 + header_bytes + _STAMP_OFFSET)
        except (struct.error, ValueError, KeyError) as error:
            raise damaged(file.path, error) from None
        stamps_ns[row] = seconds * 1_000_000_000 + nanoseconds
    return stamps_ns[rows]


def _records(file: Ros1File, index: Ros1Index, rows: Array) -> Iterator[tuple[int, bytes]]:
    """The beginnings of the records in ``rows``, chunk by chunk."""
    wanted = np.zeros(len(index.entries), bool)
    wanted[rows] = True
    offsets = index.entries["offset"]
    for chunk in index.chunks:
        here = [row for row in chunk.rows if wanted[row]]
        if not here:
            continue
        data = None if chunk.compression == NO_COMPRESSION else file.chunk_data(chunk)
        for row in here:
            offset = int(offsets[row])
            size = min(_PEEK_BYTES, chunk.size_bytes - offset)
            yield row, file.read(chunk.data_position + offset, size) if data is None else data[offset : offset + size]


def check_timestamp(stamp_ns: int, topic: str, latest_ns: int) -> int:
    """``stamp_ns``, if a message can hold it; raises InvalidInput otherwise."""
    if not 0 < stamp_ns < latest_ns:
        raise InvalidInput(
            f"{topic}: a step moves a timestamp to {stamp_ns * 1e-9:.3f} s",
            f"this recording knows times from 0 s to {latest_ns // 1_000_000_000} s",
        )
    return stamp_ns


# The rewriting, piece by piece: untouched chunks as they are, untouched messages as raw bytes.


PIECE_BYTES = 4 << 20
"""Of source data that one piece covers where the source can be cut anywhere (chunks without compression)."""


@dataclass(frozen=True, slots=True)
class CopyPiece:
    """Chunks that follow each other and stay as they are, index records included."""

    chunks: list[Chunk]


@dataclass(frozen=True, slots=True)
class RewritePiece:
    """Messages of one chunk that become a chunk of their own; ``declared`` are connections it introduces."""

    chunk: Chunk
    rows: range
    declared: tuple[int, ...]

    @property
    def held_bytes(self) -> int:
        """Part of the source that is in memory while it is made, at most."""
        if self.chunk.compression == NO_COMPRESSION:
            return self.chunk.size_bytes * len(self.rows) // len(self.chunk.rows)
        return self.chunk.size_bytes + self.chunk.data_bytes


Piece = CopyPiece | RewritePiece


def cut(index: Ros1Index, decisions: Decisions) -> list[Piece]:
    """The pieces of the result, in order. Chunks of which nothing is kept are in none."""
    pieces: list[Piece] = []
    # Connections that a chunk so far has messages of, be it a dropped one.
    seen: set[int] = set()
    # Those of them that no piece declares yet.
    waiting: set[int] = set()
    for chunk in index.chunks:
        rows = slice(chunk.rows.start, chunk.rows.stop)
        first = set(np.unique(index.entries["connection"][rows]).tolist()) - seen
        seen |= first
        # A dropped chunk held the declaration of these, so a copy of this chunk would lack it.
        late, waiting = waiting, waiting | first
        kept = decisions.kept[rows]
        if not kept.any():
            continue
        if kept.all() and not decisions.changed[rows].any() and not late:
            last = pieces[-1] if pieces else None
            if isinstance(last, CopyPiece) and last.chunks[-1].end == chunk.position:
                last.chunks.append(chunk)
            else:
                pieces.append(CopyPiece([chunk]))
        else:
            # A large chunk that is not compressed becomes several pieces: each is held in memory as a whole.
            limits = [chunk.rows.start, chunk.rows.stop]
            if chunk.compression == NO_COMPRESSION and chunk.size_bytes > 2 * PIECE_BYTES:
                offsets = index.entries["offset"][rows]
                cuts = np.searchsorted(offsets, np.arange(PIECE_BYTES, chunk.size_bytes, PIECE_BYTES)) + rows.start
                limits = sorted({*limits, *cuts.tolist()})
            # The first piece declares the connections that are new, before any message of theirs.
            declared = tuple(sorted(waiting))
            for start, stop in pairwise(limits):
                if decisions.kept[start:stop].any():
                    pieces.append(RewritePiece(chunk, range(start, stop), declared))
                    declared = ()
        waiting = set()
    return pieces


class Rewriter:
    """Makes new chunks; may be called from several threads.

    Args:
        file: The open source.
        index: Of the source.
        decisions: For every message in it.
    """

    def __init__(self, file: Ros1File, index: Ros1Index, decisions: Decisions) -> None:
        self._file = file
        self._index = index
        self._decisions = decisions
        self._store = get_typestore(Stores.ROS1_NOETIC)
        self._types = {id_: connection.type for id_, connection in index.connections.items()}

    def foretell_bytes(self, pieces: Sequence[Piece]) -> int | None:
        """The size of all results before they are made, None if only making them can tell.

        Images, IMU samples and the like are taken to be as large as the first of their topic is afterwards; so this may
        be wrong where recordings are irregular.
        """
        touched = [piece for piece in pieces if isinstance(piece, RewritePiece)]
        if any(piece.chunk.compression != NO_COMPRESSION for piece in touched):
            return None
        sizes = self._record_sizes()
        if sizes is None:
            return None
        total_bytes = sum(
            piece.chunks[-1].end - piece.chunks[0].position for piece in pieces if isinstance(piece, CopyPiece)
        )
        index_header_bytes, chunk_header_bytes = len(index_header(0, 0)), len(chunk_header(NO_COMPRESSION, 0, 0))
        for piece in touched:
            rows = slice(piece.rows.start, piece.rows.stop)
            kept = self._decisions.kept[rows]
            connections = np.unique(self._index.entries["connection"][rows][kept])
            total_bytes += chunk_header_bytes + index_header_bytes * len(connections)
            total_bytes += INDEX_ENTRY.itemsize * int(kept.sum()) + int(sizes[rows][kept].sum())
            total_bytes += sum(len(self._index.connections[id_].record) for id_ in piece.declared)
        return total_bytes

    def _record_sizes(self) -> Array | None:
        """The size of each message's new record, None if messages of a topic differ in size."""
        offsets = self._index.entries["offset"].astype(np.int64)
        sizes: Array = np.diff(offsets, append=0)
        for chunk in self._index.chunks:
            if chunk.rows:
                sizes[chunk.rows.stop - 1] = chunk.size_bytes - offsets[chunk.rows.stop - 1]
        for connection in self._decisions.edits:
            own = self._index.entries["connection"] == connection
            kept = np.flatnonzero(own & self._decisions.kept)
            if len(kept) == 0:
                continue
            if self._types[connection] not in EQUAL_SIZES:
                return None
            # Records of one size: the first one that is kept has it.
            row = int(kept[0])
            chunk = next(chunk for chunk in self._index.chunks if row in chunk.rows)
            starts, ends = self._extents(RewritePiece(chunk, range(row, row + 1), ()))
            record = _Records(self._file, chunk).read(int(starts[0]), int(ends[0]))
            sizes[own] = sum(len(part) for part in self._changed(row, record))
        return sizes

    def lay_out(self, piece: Piece) -> NewChunks | None:
        """The result of a piece that needs no message in memory; None where :meth:`rewrite` has work to do."""
        if isinstance(piece, CopyPiece):
            first, last = piece.chunks[0], piece.chunks[-1]
            summaries = [
                summarise(chunk.position - first.position, self._index.entries[chunk.rows.start : chunk.rows.stop])
                for chunk in piece.chunks
            ]
            return NewChunks([range(first.position, last.end)], summaries)
        rows = slice(piece.rows.start, piece.rows.stop)
        changed = (self._decisions.changed[rows] & self._decisions.kept[rows]).any()
        if changed or piece.chunk.compression != NO_COMPRESSION:
            return None
        return self._assemble(piece)

    def rewrite(self, piece: RewritePiece) -> NewChunks:
        """The kept messages of ``piece`` as a chunk, compressed as in the source; raises InvalidInput."""
        return self._assemble(piece)

    def _assemble(self, piece: RewritePiece) -> NewChunks:
        parts: list[Buffer | range] = [self._index.connections[id_].record for id_ in piece.declared]
        position = sum(len(part) for part in parts)
        rows, offsets = [], []
        starts, ends = self._extents(piece)
        records = _Records(self._file, piece.chunk)
        for first, last in self._spans(piece):
            at = slice(first - piece.rows.start, last - piece.rows.start)
            start, end = int(starts[at][0]), int(ends[at][-1])
            changed = self._decisions.changed[first]
            new = self._changed(first, records.read(start, end)) if changed else [records.untouched(start, end)]
            parts += new
            rows.append(np.arange(first, last))
            offsets.append(starts[at].astype(np.int64) - start + position)
            position += sum(len(part) for part in new)
        entries = self._index.entries[np.concatenate(rows)]
        entries["offset"] = np.concatenate(offsets)
        return new_chunk(piece.chunk.compression, parts, position, entries)

    def _extents(self, piece: RewritePiece) -> tuple[Array, Array]:
        """Where the records of the piece start and end; connection records go with the message before them."""
        chunk = piece.chunk
        offsets = self._index.entries["offset"][chunk.rows.start : chunk.rows.stop]
        ends = np.append(offsets[1:], np.uint32(chunk.size_bytes))
        at = slice(piece.rows.start - chunk.rows.start, piece.rows.stop - chunk.rows.start)
        return offsets[at], ends[at]

    def _spans(self, piece: RewritePiece) -> Iterator[tuple[int, int]]:
        """Runs of kept rows that are untouched, and kept rows that change one by one."""
        rows = slice(piece.rows.start, piece.rows.stop)
        kinds = np.where(self._decisions.kept[rows], 1 + self._decisions.changed[rows], 0).tolist()
        start = 0
        for stop in range(1, len(kinds) + 1):
            if stop < len(kinds) and kinds[stop] == kinds[start] == 1:
                continue
            if kinds[start]:
                yield piece.rows.start + start, piece.rows.start + stop
            start = stop

    def _changed(self, row: int, record: Buffer) -> list[Buffer | range]:
        """A message's record with another timestamp or content; its header, with the receive time, stays."""
        try:
            start = message_offset(record)
            (header_bytes,) = U32.unpack_from(record, start)
            data_start = start + 8 + header_bytes
            (data_bytes,) = U32.unpack_from(record, data_start - 4)
        except (struct.error, ValueError, KeyError) as error:
            raise damaged(self._file.path, error) from None
        data: Any = memoryview(record)[data_start : data_start + data_bytes]
        if len(data) != data_bytes:
            raise damaged(self._file.path, ValueError("a message is longer than its record"))
        connection = int(self._index.entries["connection"][row])
        edit = self._decisions.edits.get(connection)
        if edit is not None:
            kind = self._types[connection]
            message = edit(
                self._decode(data, kind), int(self._decisions.numbers[row]), int(self._index.entries["time_ns"][row])
            )
            data = self._store.serialize_ros1(message, kind)
        stamp_ns = int(self._decisions.stamps_ns[row])
        if stamp_ns:
            data = bytearray(data)
            if len(data) < 12:
                raise damaged(self._file.path, ValueError("a message without a header"))
            struct.pack_into("<LL", data, 4, stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
        return [bytes(record[: data_start - 4]), U32.pack(len(data)), memoryview(data)]

    def _decode(self, data: Buffer, kind: str) -> Any:
        try:
            return self._store.deserialize_ros1(data, kind)
        except DAMAGE as error:
            raise damaged(self._file.path, error) from None


class _Records:
    """Records of one chunk, by offsets in its uncompressed data."""

    def __init__(self, file: Ros1File, chunk: Chunk) -> None:
        self._file = file
        self._base = chunk.data_position
        self._data = None if chunk.compression == NO_COMPRESSION else memoryview(file.chunk_data(chunk))

    def read(self, start: int, end: int) -> Buffer:
        """The bytes."""
        if self._data is not None:
            return self._data[start:end]
        return self._file.read(self._base + start, end - start)

    def untouched(self, start: int, end: int) -> Buffer | range:
        """The bytes, or where they are in the file if they are there as such."""
        return range(self._base + start, self._base + end) if self._data is None else self._data[start:end]


# Keeps the C library from returning memory to the kernel between two messages.


_ARENA_MAX, _TRIM_THRESHOLD, _MMAP_THRESHOLD = -8, -1, -3
"""Parameters of glibc's ``mallopt`` (malloc.h)."""
_LARGE_BYTES = 32 << 20
"""The largest threshold that glibc accepts; it reaches this value by itself after a block of that size was freed."""


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Let freed blocks of up to 32 MB be used again at once, by all threads; given back at the end.

    Each chunk and image takes some blocks of a megabyte. In threads glibc returns those to the kernel whenever they are
    freed. Getting them again costs a page fault for every 4 KB, which is half the time of treating LZ4 chunks. Without
    glibc this does nothing.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):
        yield
        return
    library.mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
    library.mallopt(_TRIM_THRESHOLD, 4 * _LARGE_BYTES)
    library.mallopt(_ARENA_MAX, 1)
    try:
        yield
    finally:
        library.mallopt(_ARENA_MAX, 0)
        library.mallopt(_TRIM_THRESHOLD, 2 * _LARGE_BYTES)
        library.malloc_trim(0)


# The recording of a variant, from a ROS 1 bag: planned from the index, made in threads, written in order.


TopicChoice = Callable[[dict[str, str]], dict[str, Treatment]]
"""From the topics of a recording with their types to those that are treated."""


def make_ros1(source: Path, target: Path, choose: TopicChoice, progress: Progress) -> tuple[str, BagExtent, BagExtent]:
    """Write the recording ``target``; its checksum, and the extents of the source and of the result.

    Raises:
        InvalidInput: the source is damaged, or does not hold what the steps need.
        OSError: the target cannot be written.
    """
    with Ros1File(source) as file:
        index = read_index(file)
        types = {connection.topic: connection.type for connection in index.connections.values()}
        decisions = decide(file, index, choose(types))
        pieces = cut(index, decisions)
        rewriter = Rewriter(file, index, decisions)
        chunks = sum(len(piece.chunks) if isinstance(piece, CopyPiece) else 1 for piece in pieces)
        with (
            freed_memory_kept(),
            one_thread_in_opencv(),
            Ros1Output(target, list(index.connections.values()), chunks, rewriter.foretell_bytes(pieces)) as output,
        ):
            for done, made in enumerate(in_order(_tasks(rewriter, pieces)), start=1):
                output.write(made, file)
                progress(done / len(pieces), "making the variant")
            digest, extent = output.finish()
    return digest, _extent(index), extent


def _tasks(rewriter: Rewriter, pieces: Sequence[Piece]) -> Iterator[Ready[NewChunks] | Pending[NewChunks]]:
    for piece in pieces:
        laid_out = rewriter.lay_out(piece)
        if laid_out is not None:
            yield Ready(laid_out)
        elif isinstance(piece, RewritePiece):
            yield Pending(partial(rewriter.rewrite, piece), piece.held_bytes)


def _extent(index: Ros1Index) -> BagExtent:
    times_ns = index.entries["time_ns"]
    return BagExtent(int(times_ns.min()), int(times_ns.max())) if len(times_ns) else BagExtent(None, None)
