"""Exports to ROS 1 bags, ROS 2 bags and MCAP files, with ``dataset.yaml`` and the ground truth beside them.

Nothing is lost on the way: what other formats cannot hold, a recording of ROS can.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.convert.converter import create_connections_converters
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.base.files import size_bytes
from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.exporters.base import ExportPlan
from slamhive.recordings.reader import messages, open_bag
from slamhive.recordings.staging import Progress, checksum, copy_recording
from slamhive.recordings.variants.ros1_index import Ros1File, read_index
from slamhive.recordings.writers import (
    PLAIN_MCAP,
    SQLITE_FOLDER,
    Rosbag2Storage,
    copy_connection,
    mcap_files,
    playable_ns,
    rosbag2_writer,
    storage_of,
)
from slamhive.runtime.recording import DAMAGE, damaged

_RECORDED = 0.95
"""The fraction of an export after which the recording is written."""
_MARGIN = 1.2
_PACKED = 4
"""How many times smaller Zstandard makes recordings, at most as a rule."""
_Convert = Callable[[bytes], Any]


class Ros1Exporter:
    """A ROS 1 bag, version 2.0."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Everything fits; messages of ROS 2 are converted."""
        return _plan(dataset, f"{dataset.name}.bag", _write_ros1, keep=dataset.bag_path.suffix == ".bag")


class Ros2Exporter:
    """A folder of ROS 2 with SQLite, its oldest storage; a recording that is a folder already is copied."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Everything fits; messages of ROS 1 are converted."""
        write = partial(_write_rosbag2, storage=SQLITE_FOLDER)
        return _plan(dataset, dataset.name, write, keep=dataset.bag_path.is_dir())


class McapExporter:
    """A single MCAP file with messages of ROS 2."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Everything fits; messages of ROS 1 are converted."""
        write = partial(_write_rosbag2, storage=PLAIN_MCAP)
        return _plan(dataset, f"{dataset.name}.mcap", write, keep=dataset.bag_path.suffix == ".mcap")


_WriteBag = Callable[[Path, Path, Progress], None]


def _plan(dataset: Dataset, bag: str, write_bag: _WriteBag, *, keep: bool) -> ExportPlan:
    def write(folder: Path, progress: Progress) -> None:
        write_recording = copy_recording if keep else write_bag
        write_recording(dataset.bag_path, folder / bag, _part(progress, 0.0, _RECORDED))
        truth = dataset.groundtruth
        beside = [dataset.reference_map, dataset.relations]
        beside += [] if truth is None else truth.files
        for file in beside:
            if file is not None and (dataset.folder / file).is_file():
                shutil.copyfile(dataset.folder / file, folder / file)
        made = replace(dataset, bag=bag, checksum=checksum(folder / bag, _part(progress, _RECORDED, 1.0)))
        (folder / DATASET_FILE).write_text(dataset_to_yaml(made), encoding="utf-8")

    path = dataset.bag_path
    return ExportPlan(write, size_bytes(path) if keep else round(_MARGIN * _expanded_bytes(path)))


def _expanded_bytes(path: Path) -> int:
    """The size of a recording without compression; where only reading it would tell, a multiple of its size."""
    if path.suffix == ".bag":
        with Ros1File(path) as file:
            return sum(chunk.size_bytes for chunk in read_index(file).chunks)
    with open_bag(path) as reader:
        compression = storage_of(path, reader).compression
        if compression is CompressionMode.STORAGE:
            return sum(chunk.uncompressed_size for file in mcap_files(reader) for chunk in file.chunks)
    return size_bytes(path) * (1 if compression is CompressionMode.NONE else _PACKED)


def _part(progress: Progress, start: float, end: float) -> Progress:
    return lambda fraction, text: progress(start + (end - start) * fraction, text)


def _write_ros1(source: Path, target: Path, progress: Progress) -> None:
    with open_bag(source) as reader, Ros1Writer(target) as writer:
        connections, converters = _converters(source, reader, writer, Stores.ROS1_NOETIC)

        def write(entry: Connection, time_ns: int, raw: bytes) -> None:
            writer.write(connections[entry.id], playable_ns(time_ns), converters[entry.msgtype](raw))

        _write(source, reader, write, progress)


def _write_rosbag2(source: Path, target: Path, progress: Progress, storage: Rosbag2Storage) -> None:
    with open_bag(source) as reader, rosbag2_writer(target, storage) as writer:
        if reader.is2:
            connections = {entry.id: copy_connection(writer, entry, reader) for entry in reader.connections}
            converters: dict[str, _Convert] = {entry.msgtype: bytes for entry in reader.connections}
        else:
            connections, converters = _converters(source, reader, writer, Stores.ROS2_HUMBLE)
        _write(
            source,
            reader,
            lambda entry, time_ns, raw: writer.write(connections[entry.id], time_ns, converters[entry.msgtype](raw)),
            progress,
        )


def _write(
    source: Path, reader: AnyReader, write: Callable[[Connection, int, bytes], None], progress: Progress
) -> None:
    total = reader.message_count
    for number, (connection, time_ns, raw) in enumerate(messages(reader, source), start=1):
        try:
            write(connection, time_ns, raw)
        except DAMAGE as error:
            if isinstance(error, OSError):
                raise
            raise damaged(source, error) from None
        progress(number / total, f"writing message {number} of {total}")


def _converters(
    source: Path, reader: AnyReader, writer: Ros1Writer | Ros2Writer, store: Stores
) -> tuple[dict[int, Connection], dict[str, _Convert]]:
    """The connections of the result by id, and how the messages of each type are converted between ROS 1 and ROS 2.

    Standard types get the definitions of ``store``, others those of the source.
    """
    try:
        with redirect_stdout(io.StringIO()):
            connections, converters = create_connections_converters(
                reader.connections, get_typestore(store), reader, writer
            )
    except DAMAGE as error:
        raise damaged(source, error) from None
    return {id_: connection for (id_, _), connection in connections.items()}, dict(converters.items())
