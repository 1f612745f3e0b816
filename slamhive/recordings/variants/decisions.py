"""Decides from the index of a ROS 1 bag what happens to each message, before any is decoded."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.recordings.geometry import Array
from slamhive.recordings.variants.payloads import Edit
from slamhive.recordings.variants.ros1_index import (
    NO_COMPRESSION,
    U32,
    Ros1File,
    Ros1Index,
    message_offset,
)
from slamhive.recordings.variants.streams import TopicStream, Treatment, make_edit
from slamhive.runtime.recording import damaged

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
