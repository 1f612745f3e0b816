"""Writing a ROS 1 bag from ready-made chunks, with its checksum computed on the way where that can be."""

from __future__ import annotations

import hashlib
import os
import struct
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

from slamhive.bags.staging import checksum
from slamhive.bags.variants.ros1_chunk import Buffer, ChunkSummary, NewChunks, record_header
from slamhive.bags.variants.ros1_index import MAGIC, OP_BAG, OP_CHUNK_INFO, U32, Ros1Connection, Ros1File

_HEADER_BYTES = 4096
"""The bag header's record, padded so that it can be written again when the numbers in it are known."""
_BLOCK_BYTES = 1 << 20
_BLOCKS = 4
"""One is filled, the others may wait for the checksum."""
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
        self._blocks = _BlockWriter(path, digest=chunks_bytes is not None)
        self._header = self._bag_header(len(MAGIC) + _HEADER_BYTES + (chunks_bytes or 0), chunks)
        self._put(self._header)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._blocks.close()

    def write(self, chunks: NewChunks, source: Ros1File) -> None:
        """Append chunks; what they take from ``source`` is read here, block by block."""
        self._summaries += [replace(entry, position=self._position + entry.position) for entry in chunks.summaries]
        for part in chunks.parts:
            if isinstance(part, range):
                self._blocks.copy(source, part)
                self._position += len(part)
            else:
                self._put(part)

    def finish(self) -> tuple[str, BagExtent]:
        """Write the index; the checksum and the times of the whole bag."""
        header = self._bag_header(self._position, len(self._summaries))
        records = [connection.record for connection in self._connections]
        self._put(b"".join([*records, *(_chunk_info(summary) for summary in self._summaries)]))
        extent = BagExtent(
            min((summary.start_ns for summary in self._summaries), default=None),
            max((summary.end_ns for summary in self._summaries), default=None),
        )
        digest = self._blocks.finish()
        if digest is not None and header == self._header:
            return digest, extent
        with self._path.open("r+b") as stream:
            stream.write(header)
        return checksum(self._path), extent

    def _put(self, data: Buffer) -> None:
        self._blocks.add(data)
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


class _BlockWriter:
    """Writes in blocks of one size out of a few buffers, which are used again and again; a thread hashes them."""

    def __init__(self, path: Path, *, digest: bool) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._hash = hashlib.sha256() if digest else None
        self._pool = ThreadPoolExecutor(1, "checksum")
        self._blocks = deque(memoryview(bytearray(_BLOCK_BYTES)) for _ in range(_BLOCKS))
        self._hashing: deque[Future[None]] = deque()
        self._filled = 0

    def add(self, data: Buffer) -> None:
        """Append bytes."""
        source = memoryview(data).cast("B")
        while len(source):
            target = self._room(len(source))
            target[:] = source[: len(target)]
            source = source[len(target) :]

    def copy(self, file: Ros1File, extent: range) -> None:
        """Append an extent of another file."""
        position = extent.start
        while position < extent.stop:
            target = self._room(extent.stop - position)
            file.read_into(target, position)
            position += len(target)

    def finish(self) -> str | None:
        """Write what is left; ``sha256:<hex>`` of everything, if that was asked for."""
        self._flush()
        while self._hashing:
            self._hashing.popleft().result()
        return None if self._hash is None else f"sha256:{self._hash.hexdigest()}"

    def close(self) -> None:
        """Let go of the file and the thread."""
        self._pool.shutdown(cancel_futures=True)
        os.close(self._descriptor)

    def _room(self, wanted_bytes: int) -> memoryview:
        """Up to that much of the present block, counted as filled."""
        if self._filled == _BLOCK_BYTES:
            self._flush()
        start = self._filled
        self._filled = min(_BLOCK_BYTES, start + wanted_bytes)
        return self._blocks[0][start : self._filled]

    def _flush(self) -> None:
        block = self._blocks[0][: self._filled]
        written = 0
        while written < len(block):
            written += os.write(self._descriptor, block[written:])
        if self._hash is not None:
            self._hashing.append(self._pool.submit(self._hash.update, block))
            if len(self._hashing) == _BLOCKS:
                self._hashing.popleft().result()
        self._blocks.rotate(-1)
        self._filled = 0


def _chunk_info(summary: ChunkSummary) -> bytes:
    head = record_header(
        OP_CHUNK_INFO,
        ver=U32.pack(1),
        chunk_pos=struct.pack("<Q", summary.position),
        start_time=_time(summary.start_ns),
        end_time=_time(summary.end_ns),
        count=U32.pack(len(summary.counts)),
    )
    data = b"".join(U32.pack(connection) + U32.pack(count) for connection, count in summary.counts.items())
    return head + U32.pack(len(data)) + data


def _time(time_ns: int) -> bytes:
    return _TIME.pack(*divmod(time_ns, 1_000_000_000))
