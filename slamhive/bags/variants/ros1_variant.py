"""The recording of a variant, from a ROS 1 bag: planned from the index, made in threads, written in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2

from slamhive.bags.staging import Progress
from slamhive.bags.variants.allocator import freed_memory_kept
from slamhive.bags.variants.decisions import decide
from slamhive.bags.variants.ros1_chunk import NewChunks
from slamhive.bags.variants.ros1_index import Ros1File, Ros1Index, read_index
from slamhive.bags.variants.ros1_output import BagExtent, Ros1Output
from slamhive.bags.variants.ros1_rewrite import CopyPiece, Piece, RewritePiece, Rewriter, cut
from slamhive.bags.variants.streams import Treatment

_IN_FLIGHT_BYTES = 12 << 20
"""Of source data being worked on; what is made of it takes about as much again."""

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
            _one_thread_in_opencv(),
            Ros1Output(target, list(index.connections.values()), chunks, rewriter.foretell_bytes(pieces)) as output,
        ):
            for done, made in enumerate(_made(rewriter, pieces), start=1):
                output.write(made, file)
                progress(done / len(pieces), "making the variant")
            digest, extent = output.finish()
    return digest, _extent(index), extent


def _made(rewriter: Rewriter, pieces: Sequence[Piece]) -> Iterator[NewChunks]:
    """The results in order, made by threads where need be; a bounded amount is under way at a time."""
    waiting: deque[tuple[Future[NewChunks] | NewChunks, int]] = deque()
    held_bytes = 0
    with ThreadPoolExecutor(_workers(), "variant") as pool:
        try:
            for piece in pieces:
                laid_out = rewriter.lay_out(piece)
                if laid_out is not None:
                    waiting.append((laid_out, 0))
                elif isinstance(piece, RewritePiece):
                    waiting.append((pool.submit(rewriter.rewrite, piece), piece.held_bytes))
                    held_bytes += piece.held_bytes
                while waiting and (held_bytes > _IN_FLIGHT_BYTES or _is_ready(waiting[0][0])):
                    result, result_bytes = waiting.popleft()
                    yield _take(result)
                    held_bytes -= result_bytes
            while waiting:
                yield _take(waiting.popleft()[0])
        finally:
            pool.shutdown(cancel_futures=True)


def _is_ready(result: Future[NewChunks] | NewChunks) -> bool:
    return isinstance(result, NewChunks) or result.done()


def _take(result: Future[NewChunks] | NewChunks) -> NewChunks:
    return result if isinstance(result, NewChunks) else result.result()


def _workers() -> int:
    return max(2, len(os.sched_getaffinity(0)))


@contextmanager
def _one_thread_in_opencv() -> Iterator[None]:
    """The threads here share out whole messages; OpenCV's own would only get in their way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _extent(index: Ros1Index) -> BagExtent:
    times_ns = index.entries["time_ns"]
    return BagExtent(int(times_ns.min()), int(times_ns.max())) if len(times_ns) else BagExtent(None, None)
