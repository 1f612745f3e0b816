"""The recording of a variant, from a ROS 1 bag: planned from the index, made in threads, written in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from slamhive.bags.in_order import Pending, Ready, in_order, one_thread_in_opencv
from slamhive.bags.staging import Progress
from slamhive.bags.variants.allocator import freed_memory_kept
from slamhive.bags.variants.decisions import decide
from slamhive.bags.variants.ros1_chunk import NewChunks
from slamhive.bags.variants.ros1_index import Ros1File, Ros1Index, read_index
from slamhive.bags.variants.ros1_output import BagExtent, Ros1Output
from slamhive.bags.variants.ros1_rewrite import CopyPiece, Piece, RewritePiece, Rewriter, cut
from slamhive.bags.variants.streams import Treatment

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
