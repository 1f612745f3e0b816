"""Writes ROS 2 recordings: a folder (SQLite or MCAP), or a single ``.mcap`` or ``.db3`` file.

A recording that is made from another one keeps its storage, compression, type definitions and quality of service.
"""

from __future__ import annotations

import errno
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapReader

from slamhive.base.errors import InvalidInput

MCAP_SUFFIX, SQLITE_SUFFIX = ".mcap", ".db3"
_SUFFIXES = {StoragePlugin.MCAP: MCAP_SUFFIX, StoragePlugin.SQLITE3: SQLITE_SUFFIX}
_VERSION: Literal[8] = 8
"""Of the metadata. Version 9 writes quality of service in another form, which older readers do not know."""
_UNKNOWN_HASH = "unknown"


@dataclass(frozen=True, slots=True)
class Rosbag2Storage:
    """Storage of a ROS 2 recording; ``plain`` is a single file without the folder around it."""

    plugin: StoragePlugin
    compression: CompressionMode = CompressionMode.NONE
    plain: bool = False


PLAIN_MCAP = Rosbag2Storage(StoragePlugin.MCAP, plain=True)
SQLITE_FOLDER = Rosbag2Storage(StoragePlugin.SQLITE3)


def storage_of(path: Path, reader: AnyReader) -> Rosbag2Storage:
    """Storage of the open recording at ``path``."""
    (recording,) = reader.readers
    assert isinstance(recording, Reader)
    files = mcap_files(reader)
    mode = CompressionMode[(recording.compression_mode or "none").upper()]
    if mode is CompressionMode.NONE and any(chunk.compression for file in files for chunk in file.chunks):
        mode = CompressionMode.STORAGE
    return Rosbag2Storage(StoragePlugin.MCAP if files else StoragePlugin.SQLITE3, mode, plain=not path.is_dir())


def mcap_files(reader: AnyReader) -> list[McapReader]:
    """The open MCAP files of a recording."""
    (recording,) = reader.readers
    assert isinstance(recording, Reader)
    files = getattr(recording.storage, "storages", [recording.storage])
    return [file for file in files if isinstance(file, McapReader)]


@contextmanager
def rosbag2_writer(target: Path, storage: Rosbag2Storage) -> Iterator[Writer]:
    """An open writer of the recording ``target``, which must not exist; the name of a plain one has the right suffix.

    Equal messages and connections make equal bytes. Raises OSError where ``target`` cannot be written.
    """
    folder = target
    if storage.plain:
        around = target.with_name(f".{target.name}.partial")
        folder = around / target.stem
    writer = Writer(folder, version=_VERSION, storage_plugin=storage.plugin)
    writer.set_compression(storage.compression, CompressionFormat.ZSTD)
    try:
        with writer:
            yield writer
        if storage.plain:
            (folder / f"{target.stem}{_SUFFIXES[storage.plugin]}").replace(target)
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error), str(target)) from error
    finally:
        if storage.plain:
            shutil.rmtree(around, ignore_errors=True)


def copy_connection(writer: Writer, connection: Connection, reader: AnyReader) -> Connection:
    """Add a connection of ``reader``, a ROS 2 recording, with its definition and quality of service.

    A definition that the recording lacks is added if the standard types contain it. Messages of other types are
    copied without one. Raises InvalidInput where MCAP cannot hold that.
    """
    definition, digest = _definition(connection, reader)
    if definition is None:
        if writer.storage_plugin is StoragePlugin.MCAP:
            raise InvalidInput(
                f"{connection.topic} carries {connection.msgtype}, and the recording does not define this type",
                "record the definition, or remove the topic",
            )
        writer.added_types.add(connection.msgtype)
    extension = connection.ext
    assert isinstance(extension, ConnectionExtRosbag2)
    return writer.add_connection(
        connection.topic,
        connection.msgtype,
        msgdef=definition or "",
        rihs01=digest,
        serialization_format=extension.serialization_format,
        offered_qos_profiles=extension.offered_qos_profiles,
    )


def _definition(connection: Connection, reader: AnyReader) -> tuple[str | None, str]:
    """The text of a type's definition, None if nobody knows it, and its hash."""
    kind = connection.msgtype
    if kind not in reader.typestore.fielddefs:
        return None, connection.digest or _UNKNOWN_HASH
    digest = connection.digest or reader.typestore.hash_rihs01(kind)
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        return connection.msgdef.data, digest
    return reader.typestore.generate_msgdef(kind, ros_version=2)[0], digest
