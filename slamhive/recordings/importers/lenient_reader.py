"""Reads recordings that rosbags refuses, or reads in part: what is readable of each file, whatever the metadata says.

It has what the importers use of rosbags' ``AnyReader``. What is read so is written again, since the player of a run
refuses the recording as rosbags does.
"""

from __future__ import annotations

import heapq
import os
import re
import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, Protocol
from urllib.parse import quote

import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1.reader import Header, IndexData, RecordType, read_bytes, read_uint32
from rosbags.rosbag1.reader import Reader as Ros1Reader
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from slamhive.base.files import visible_files
from slamhive.recordings.reader import DAMAGE

MCAP_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    OSError,
    ValueError,
    KeyError,
    RuntimeError,
    OverflowError,
    MemoryError,
)
"""What the mcap library and its codecs raise on damaged bytes. RuntimeError is that of lz4; ValueError includes wrong
checksums and text that is not UTF-8."""

_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
_RUN_BYTES = 4_000_000
"""Messages outside of chunks are read in runs of so many bytes."""

Entry = tuple[Connection, int, bytes]


@dataclass(frozen=True, slots=True)
class _Span:
    """A chunk, or messages without one that follow each other: when they were received, and where they lie."""

    start_ns: int
    end_ns: int
    offset: int
    size: int


class McapStorage:
    """An open MCAP file.

    Attributes:
        connections: The channels of ROS messages, with the number of messages of each that can be read.
        unreadable: By topic, the reason why its messages cannot be read.
        start_ns: When the first message was received.
        end_ns: When the last message was received.
        damage: Where and why reading ended early, in words; empty for a whole file.
        lost: How many messages the file says that it has, and that cannot be read; None if it does not say that.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unreadable: dict[str, str] = {}
        self.damage = ""
        self.lost: int | None = None
        self._file: IO[bytes] = path.open("rb")
        self._size = os.fstat(self._file.fileno()).st_size
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._counts: Counter[int] = Counter()
        self._spans: list[_Span] = []
        try:
            if not self._read_index():
                self._scan()
        except BaseException:
            self.close()
            raise
        self.start_ns = min((span.start_ns for span in self._spans), default=0)
        self.end_ns = max((span.end_ns for span in self._spans), default=0)
        self.connections = self._connections()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, connections: Collection[Connection], start_ns: int | None = None) -> Iterator[Entry]:
        """The messages of ``connections`` in order of time; raises rosbags' ReaderError where the file is damaged."""
        wanted = {entry.id: entry for entry in connections}
        spans = [span for span in self._spans if start_ns is None or span.end_ns >= start_ns]
        for entry in heapq.merge(*(self._sorted(span, wanted) for span in spans), key=lambda entry: entry[1]):
            if entry[0] is not None and (start_ns is None or entry[1] >= start_ns):
                yield entry[0], entry[1], entry[2]

    def _sorted(self, span: _Span, wanted: dict[int, Connection]) -> Iterator[tuple[Connection | None, int, bytes]]:
        # a chunk is read when its time has come: many of them do not fit into memory
        yield None, span.start_ns, b""
        self._file.seek(span.offset)
        data = self._file.read(span.size)
        found: list[Entry] = []
        try:
            for record in self._records(BytesIO(data), skip_magic=True):
                # no comprehension: what was read stays when the reader finds the end of the span
                if isinstance(record, Message) and record.channel_id in wanted:
                    found.append((wanted[record.channel_id], record.log_time, record.data))  # noqa: PERF401
        except EndOfFile:
            pass
        except MCAP_DAMAGE as error:
            raise ReaderError(f"{error} in {span.size} bytes from byte {span.offset} on") from None
        yield from sorted(found, key=lambda entry: entry[1])

    def _records(self, stream: IO[bytes], **how: bool) -> Iterator[object]:
        reader = StreamReader(stream, validate_crcs=True, record_size_limit=self._size, **how)
        return iter(reader.records)

    def _read_index(self) -> bool:
        """Take spans, channels and counts from the summary; whether it has them all."""
        try:
            summary = SeekingReader(self._file, record_size_limit=self._size).get_summary()
        except MCAP_DAMAGE:
            return False
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return False
        counts = summary.statistics.channel_message_counts
        schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
        whole = counts.keys() <= summary.channels.keys() and schemas <= summary.schemas.keys()
        if not whole or summary.statistics.chunk_count != len(summary.chunk_indexes):
            return False
        self._channels, self._schemas = dict(summary.channels), dict(summary.schemas)
        self._counts.update(counts)
        self._spans = [
            _Span(chunk.message_start_time, chunk.message_end_time, chunk.chunk_start_offset, chunk.chunk_length)
            for chunk in summary.chunk_indexes
        ]
        return True

    def _scan(self) -> None:
        """Go through the whole file in order, until its end or to where its bytes make no sense."""
        self._file.seek(0)
        place, stated, reason = 0, None, ""
        try:
            # checksums of the whole data are not asked for: a file that was cut has none
            reader = StreamReader(self._file, emit_chunks=True, record_size_limit=self._size)
            for record in reader.records:
                end = self._file.tell()
                if isinstance(record, Statistics):
                    stated = record.message_count
                elif isinstance(record, Chunk):
                    reason = self._add_chunk(record, place, end - place) or reason
                else:
                    self._add(record, place, end - place)
                place = end
        except EndOfFile:
            reason = "it ends within a record"
        except MCAP_DAMAGE as error:
            reason = " ".join(str(error).split())[:200] or "its bytes make no sense"
        read = sum(self._counts.values())
        if stated is not None:
            self.lost = max(stated - read, 0)
        if reason:
            of = "" if stated is None else f" of {stated}"
            self.damage = f"{self.path.name}: {read}{of} messages can be read; from byte {place} on, {reason}"

    def _add_chunk(self, chunk: Chunk, offset: int, size: int) -> str:
        """Note what is in a chunk; the reason if it cannot be read."""
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except MCAP_DAMAGE as error:
            return f"a chunk is damaged ({' '.join(str(error).split())[:200]})"
        times_ns = [record.log_time for record in records if isinstance(record, Message)]
        for record in records:
            self._note(record)
        if times_ns:
            self._spans.append(_Span(min(times_ns), max(times_ns), offset, size))
        return ""

    def _add(self, record: object, offset: int, size: int) -> None:
        self._note(record)
        if not isinstance(record, Message):
            return
        time_ns, last = record.log_time, self._spans[-1] if self._spans else None
        if last is not None and last.offset + last.size == offset and last.size < _RUN_BYTES:
            self._spans[-1] = _Span(
                min(last.start_ns, time_ns), max(last.end_ns, time_ns), last.offset, last.size + size
            )
        else:
            self._spans.append(_Span(time_ns, time_ns, offset, size))

    def _note(self, record: object) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message):
            self._counts[record.channel_id] += 1

    def _connections(self) -> list[Connection]:
        found = []
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            kind = "" if schema is None else schema.name
            # ROS 1 says ``sensor_msgs/Imu`` for the ``sensor_msgs/msg/Imu`` of ROS 2.
            if kind.count("/") == 1 and not kind.endswith("/"):
                kind = kind.replace("/", "/msg/")
            if channel.message_encoding not in {"cdr", "ros1"}:
                self.unreadable[channel.topic] = f"its messages are {channel.message_encoding or 'of no encoding'}"
                continue
            if not kind:
                self.unreadable[channel.topic] = "the file does not say of which type its messages are"
                continue
            format_ = _FORMATS.get("" if schema is None else schema.encoding, MessageDefinitionFormat.NONE)
            text = "" if schema is None or format_ is MessageDefinitionFormat.NONE else _text(schema.data)
            found.append(
                Connection(
                    number,
                    channel.topic,
                    kind,
                    MessageDefinition(format_ if text else MessageDefinitionFormat.NONE, text),
                    channel.metadata.get("md5sum", ""),
                    self._counts[number],
                    ConnectionExtRosbag2(channel.message_encoding, []),
                    self,
                )
            )
        return found


def _text(data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        return ""


# Reads recordings that rosbags refuses, or reads in part: what is readable of each file, whatever the metadata says.
#
# It has what the importers use of rosbags' ``AnyReader``. What is read so is written again, since the player of a run
# refuses the recording as rosbags does.


ZSTD = b"\x28\xb5\x2f\xfd"
"""The first bytes of data that is compressed; those of a CDR message are 0 and a number."""
STORAGE_SUFFIXES = (".mcap", ".db3")
_INDEX = np.dtype([("time_ns", "i8"), ("row", "i8"), ("topic", "i8")])
_IDL_RULE = "=" * 80 + "\n"
_ROS1_INDEX_ENTRY_BYTES = 12


class Storage(Protocol):
    """One file of a recording; ``McapStorage`` explains the attributes."""

    path: Path
    connections: list[Connection]
    unreadable: dict[str, str]
    start_ns: int
    end_ns: int
    damage: str
    lost: int | None

    def messages(self, connections: Collection[Connection], start_ns: int | None = None) -> Iterator[Entry]:
        """The messages of ``connections`` in order of time."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class SqliteStorage:
    """An open SQLite file of rosbag2."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unreadable: dict[str, str] = {}
        self.damage = ""
        self.lost: int | None = None
        self._database = sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)
        try:
            topics = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            definitions = self._definitions()
            self._index = np.fromiter(self._rows(), _INDEX)
        except sqlite3.Error as error:
            self.close()
            raise ReaderError(f"{path.name}: {error}") from None
        self._index.sort(order=["time_ns", "row"])
        self.start_ns = int(self._index["time_ns"][0]) if len(self._index) else 0
        self.end_ns = int(self._index["time_ns"][-1]) if len(self._index) else 0
        if self.damage:
            self.damage = f"{path.name}: {len(self._index)} messages can be read, then {self.damage}"
        self.connections = []
        for number, name, kind, encoding in topics:
            if encoding != "cdr":
                self.unreadable[str(name)] = f"its messages are {encoding or 'of no encoding'}"
                continue
            definition = definitions.get(kind, MessageDefinition(MessageDefinitionFormat.NONE, ""))
            count = int((self._index["topic"] == number).sum())
            extension = ConnectionExtRosbag2("cdr", [])
            self.connections.append(Connection(number, str(name), str(kind), definition, "", count, extension, self))

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def messages(self, connections: Collection[Connection], start_ns: int | None = None) -> Iterator[Entry]:
        """The messages of ``connections`` in order of time; raises rosbags' ReaderError where the file is damaged."""
        wanted = {entry.id: entry for entry in connections}
        kept = self._index[np.isin(self._index["topic"], list(wanted))]
        if start_ns is not None:
            kept = kept[kept["time_ns"] >= start_ns]
        for time_ns, row, topic in kept.tolist():
            try:
                found = self._database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
            except sqlite3.Error as error:
                raise ReaderError(f"{self.path.name}: {error} at message {row}") from None
            yield wanted[topic], time_ns, found[0]

    def _rows(self) -> Iterator[tuple[int, int, int]]:
        """Time, row and topic of each message, to the first page that is damaged."""
        try:
            # the data is asked for as well, since its pages may be those that are missing
            rows = self._database.execute("SELECT timestamp, id, topic_id, length(substr(data, -1)) FROM messages")
            for time_ns, row, topic, _ in rows:
                yield time_ns, row, topic
        except sqlite3.Error as error:
            self.damage = str(error)

    def _definitions(self) -> dict[str, MessageDefinition]:
        """The definitions of types, which rosbag2 stores since Jazzy."""
        formats = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
        try:
            rows = self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ).fetchall()
        except sqlite3.Error:
            return {}
        return {kind: MessageDefinition(formats[how], text) for kind, how, text in rows if how in formats and text}


class LenientReader:
    """Reads the files of one recording of ROS 2, or MCAP files with messages of ROS 1; opened by making it.

    Attributes:
        connections: The topics that can be read.
        unreadable: By topic, the reason why others cannot.
        typestore: The types that the files define, and for the others those of ``spare``.
        is2: Whether messages are those of ROS 2.
        notes: What users should know about files that are damaged.
        lost: How many messages are lost, as far as the files say that.
    """

    def __init__(self, path: Path, spare: Typestore) -> None:
        self.readers: Sequence[Any] = ()
        self._stack = ExitStack()
        self._storages: list[Storage] = []
        self._zstd = zstandard.ZstdDecompressor()
        try:
            for file in self._files(path):
                storage = McapStorage(file) if file.suffix == ".mcap" else SqliteStorage(file)
                self._stack.callback(storage.close)
                self._storages.append(storage)
        except BaseException:
            self.close()
            raise
        self.unreadable = {topic: reason for storage in self._storages for topic, reason in storage.unreadable.items()}
        found = [entry for storage in self._storages for entry in storage.connections]
        self.is2 = any(_encoding(entry) == "cdr" for entry in found) or not found
        own = [entry for entry in found if (_encoding(entry) == "cdr") == self.is2]
        self.typestore = get_typestore(Stores.EMPTY)
        self.connections = self._defined(own, spare)
        self.notes = [storage.damage for storage in self._storages if storage.damage]
        self.lost = sum(storage.lost or 0 for storage in self._storages)
        stated = _stated_messages(path) if self.notes else 0
        if stated > self.message_count:
            self.lost = stated - self.message_count
            self.notes[0] += f"; metadata.yaml states {stated} messages"
        spans = [storage for storage in self._storages if any(entry.msgcount for entry in storage.connections)]
        self.start_time = min((storage.start_ns for storage in spans), default=0)
        self.end_time = max((storage.end_ns for storage in spans), default=0) + 1

    @property
    def message_count(self) -> int:
        """The number of messages that can be read."""
        return sum(entry.msgcount for entry in self.connections)

    def close(self) -> None:
        """Close the files, and remove those that were unpacked."""
        self._stack.close()

    def messages(self, connections: Collection[Connection], start: int | None = None) -> Iterator[Entry]:
        """The messages of ``connections`` in order of time."""
        parts = [
            storage.messages([entry for entry in connections if entry.owner is storage], start)
            for storage in self._storages
        ]
        for connection, time_ns, raw in heapq.merge(*parts, key=lambda entry: entry[1]):
            try:
                # rosbag2 compresses single messages, and MCAP does not know of it
                plain = self._zstd.decompressobj().decompress(raw) if raw[: len(ZSTD)] == ZSTD else raw
            except zstandard.ZstdError as error:
                raise ReaderError(str(error)) from None
            yield connection, time_ns, plain

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """The message in ``raw``."""
        store = self.typestore
        return store.deserialize_cdr(raw, kind) if self.is2 else store.deserialize_ros1(raw, kind)

    def _defined(self, connections: Sequence[Connection], spare: Typestore) -> list[Connection]:
        """The connections whose types are known; the types go to the type store."""
        types: dict[str, Any] = {}
        undefined: dict[str, str] = {}
        for entry in connections:
            try:
                text, form = entry.msgdef.data, entry.msgdef.format
                if form is MessageDefinitionFormat.MSG:
                    types.update(get_types_from_msg(text, entry.msgtype))
                elif form is not MessageDefinitionFormat.NONE and not text.startswith(f"{_IDL_RULE}IDL: "):
                    types.update(get_types_from_idl(text))
                elif form is not MessageDefinitionFormat.NONE:
                    # rosbag2 joins the definitions of all types that a message needs, with a rule before each.
                    own: dict[str, Any] = {}
                    for part in text.split(_IDL_RULE)[1:]:
                        own.update(get_types_from_idl(part.partition("\n")[2]))
                    types.update(own)
            except DAMAGE as error:
                undefined[entry.msgtype] = f"the definition of {entry.msgtype} cannot be read ({error})"
        known = spare.fielddefs
        types.update({kind: fields for kind, fields in known.items() if kind not in types})
        self.typestore.register(types)
        kept = []
        for entry in connections:
            if entry.msgtype in undefined and entry.msgtype not in known:
                self.unreadable[entry.topic] = " ".join(undefined[entry.msgtype].split())[:200]
            elif self.is2:
                kept.append(entry)
            else:
                definition, digest = self.typestore.generate_msgdef(entry.msgtype, ros_version=1)
                plain = MessageDefinition(MessageDefinitionFormat.MSG, definition)
                kept.append(entry._replace(msgdef=plain, digest=entry.digest or digest))
        return kept

    def _files(self, path: Path) -> list[Path]:
        """The storage files of a recording in their order, those unpacked that are compressed as a whole."""
        files = [path] if path.is_file() else storage_files(path)
        unpacked = []
        for file in files:
            with file.open("rb") as stream:
                packed = stream.read(len(ZSTD)) == ZSTD
            unpacked.append(self._unpacked(file) if packed else file)
        return unpacked

    def _unpacked(self, file: Path) -> Path:
        folder = Path(self._stack.enter_context(TemporaryDirectory(prefix="slamhive-zstd-")))
        target = folder / (file.name.removesuffix(".zstd"))
        with file.open("rb") as packed, target.open("wb") as plain:
            try:
                # a recorder writes one frame; files that were put together have several
                reader = self._zstd.stream_reader(packed, read_across_frames=True)
                shutil.copyfileobj(reader, plain)
            except zstandard.ZstdError as error:
                raise ReaderError(f"{file.name}: {error}") from None
        return target


def storage_files(folder: Path) -> list[Path]:
    """The files in the folder of a ROS 2 recording that hold messages, in the order of their numbers."""
    found = visible_files(folder)
    plain = {file.name for file in found if file.suffix in STORAGE_SUFFIXES}
    packed = [file for file in found if file.suffix == ".zstd" and Path(file.stem).suffix in STORAGE_SUFFIXES]
    files = [file for file in found if file.name in plain] + [file for file in packed if file.stem not in plain]
    return sorted(files, key=lambda file: (len(file.name), file.name))


def unlisted(folder: Path, files: Sequence[Path]) -> list[str]:
    """The names of ``files`` that ``metadata.yaml`` in ``folder`` does not mention; all without it."""
    try:
        text = (folder / "metadata.yaml").read_bytes()
    except OSError:
        text = b""
    return [file.name for file in files if os.fsencode(file.name.removesuffix(".zstd")) not in text]


def _stated_messages(folder: Path) -> int:
    """The number of messages in ``metadata.yaml``, 0 where it has none that can be read."""
    try:
        text = (folder / "metadata.yaml").read_text()
    except (OSError, UnicodeDecodeError):
        return 0
    found = re.search(r"^  message_count: (\d{1,15})$", text, re.MULTILINE)
    return 0 if found is None else int(found[1])


def contradiction(reader: AnyReader) -> str:
    """Where ``metadata.yaml`` of an open ROS 2 folder and its storage say different things; empty if they agree."""
    for recording in reader.readers:
        folder = getattr(recording, "storage", None)
        if not isinstance(folder, DirectoryReader):
            continue
        path = Path(str(folder.path))
        left = unlisted(path, storage_files(path))
        if left:
            return f"metadata.yaml does not name {', '.join(left[:3])}"
        stated = {(entry.topic, entry.msgtype, _encoding(entry)): entry for entry in folder.connections}
        stored: dict[tuple[str, str, str], int] = {}
        for entry in (entry for storage in folder.storages for entry in storage.connections):
            key = entry.topic, entry.msgtype, _encoding(entry)
            stored[key] = stored.get(key, 0) + entry.msgcount
            if entry.msgcount and key not in stated:
                return f"metadata.yaml does not name topic {entry.topic}"
            if entry.msgcount and stated[key].ext != entry.ext:
                return f"metadata.yaml has another quality of service for topic {entry.topic}"
            if entry.msgcount and entry.digest and stated[key].digest not in {"", entry.digest}:
                return f"metadata.yaml has another version of {entry.msgtype} for topic {entry.topic}"
        for key, connection in stated.items():
            if connection.msgcount != stored.get(key, 0):
                count = f"{connection.msgcount} messages of {connection.topic}"
                return f"metadata.yaml states {count}, the storage has {stored.get(key, 0)}"
        total = sum(entry.msgcount for entry in folder.connections)
        if total and not folder.metadata.message_count:
            return "metadata.yaml states no messages"
    return ""


class LenientRos1Reader(Ros1Reader):
    """A ROS 1 bag whose index records state another length than they have, as ROS reads it: by the number of entries.

    Writers of ROS C Turtle and before stated 20 bytes for an entry of 12.
    """

    def read_index_data(self, pos: int, indexes: dict[int, list[Any]]) -> None:
        """Read the entries of one connection in a chunk."""
        assert self.bio
        header = Header.read(self.bio, RecordType.IDXDATA)
        read_uint32(self.bio)  # the stated length
        data = read_bytes(self.bio, header.get_uint32("count") * _ROS1_INDEX_ENTRY_BYTES)
        entries = np.frombuffer(data, "<u4").reshape(-1, 3).tolist()
        indexes[header.get_uint32("conn")] += [
            IndexData(seconds * 10**9 + nanoseconds, pos, offset) for seconds, nanoseconds, offset in entries
        ]


def _encoding(connection: Connection) -> str:
    """The serialisation of messages, such as ``cdr``."""
    return str(getattr(connection.ext, "serialization_format", ""))
