"""A ROS or MCAP recording to import: its topics from the index, a few messages, and streams of single topics."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from slamhive.base.errors import InvalidInput, nearest
from slamhive.base.files import visible_files
from slamhive.domain.sensors import SensorKind
from slamhive.recordings.importers.lenient_reader import LenientReader, LenientRos1Reader, contradiction
from slamhive.recordings.importers.odd_images import ODD_ENCODINGS, depth_encoding, is_odd, plain_image
from slamhive.recordings.importers.video_messages import (
    VIDEO_DEFINITIONS,
    VIDEO_TYPES,
    VideoPacket,
    codec_of,
    first_picture,
)
from slamhive.recordings.importing import ImportOptions
from slamhive.recordings.reader import DAMAGE, damaged, reindexing
from slamhive.recordings.writers import NS_PER_S
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, IMAGE_ENCODINGS, IMU, POINTS, Array, stamp_ns

_WINDOWS_S = (2.0, 20.0, 200.0)
"""How long before the end the last message of a topic is looked for, before the whole topic is read."""
_OLD_MAGIC = re.compile(rb"#ROS(?:RECORD|BAG|LOG) V([01]\.\d+)\n")
_LONGEST_MAGIC = 30
_NO_TYPE = "__schemaless__"
"""What rosbags calls the type of an MCAP channel without one in the index."""
TO_VERSION_2 = "`rosbag reindex` of ROS 1 writes it as 2.0"
_LONGEST_DEFINITION_BYTES = 1_000_000
_BAD_METADATA = (TypeError, AttributeError)
"""What follows from values of another type in ``metadata.yaml``, which rosbags does not check."""


@dataclass(frozen=True, slots=True)
class SourceTopic:
    """A topic of the recording: name, message type such as ``sensor_msgs/msg/Imu``, and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class FirstPicture:
    """The first picture of an image topic, its encoding, and how many messages before it hold none (video)."""

    pixels: Array
    encoding: str
    skipped: int = 0


class SourceBag:
    """An open recording; use :func:`open_source`.

    Attributes:
        path: What messages call it.
        topics: By name, those with messages only.
        start_ns: When the first message was received.
        end_ns: When the last message was received.
        unreadable: Topics that cannot be read, with the reason.
        refused: Why rosbags refuses the recording, empty if it does not: then its messages have to be written again.
    """

    def __init__(self, path: Path, reader: AnyReader | LenientReader, spare: Typestore, refused: str = "") -> None:
        self.path = path
        self.reader = reader
        self.refused = refused
        self.unreadable: Mapping[str, str] = getattr(reader, "unreadable", {})
        self._spare = spare
        self.topics = {topic.name: topic for topic in self._listed() if topic.count}
        if not self.topics:
            raise InvalidInput(f"{path} holds no messages", "record or copy it again")
        self.start_ns = int(reader.start_time)
        self.end_ns = max(int(reader.end_time) - 1, self.start_ns)
        self._first: dict[str, Any] = {}
        self._pictures: dict[str, FirstPicture] = {}
        self._checked: set[str] = set()

    def topic(self, name: str, purpose: str) -> SourceTopic:
        """The topic called ``name``, which is wanted for ``purpose``; raises InvalidInput with the nearest name."""
        if name in self.unreadable and name not in self.topics:
            raise InvalidInput(f"topic {name!r} of {self.path} for {purpose} cannot be read: {self.unreadable[name]}")
        if name not in self.topics:
            raise InvalidInput(f"{self.path} has no topic {name!r} for {purpose}; {nearest(name, list(self.topics))}")
        return self.topics[name]

    def of_type(self, *types: str) -> list[SourceTopic]:
        """The topics of these message types."""
        return [topic for topic in self.topics.values() if topic.type in types]

    def first(self, topic: str) -> Any:
        """The first message of ``topic``."""
        if topic not in self._first:
            found = next(self.stream(topic), None)
            if found is None:
                raise InvalidInput(
                    f"{self.path}: the index has messages of {topic}, the recording none", reindexing(self.path)
                )
            self._first[topic] = found[1]
        return self._first[topic]

    def first_picture(self, topic: str) -> FirstPicture:
        """The first picture of an image topic; raises InvalidInput if it is damaged, or video that is not read."""
        if topic not in self._pictures:
            message, kind = self.first(topic), self.topics[topic].type
            codec = codec_of(message, kind)
            if codec is None:
                self._pictures[topic] = FirstPicture(*plain_image(message, kind))
            else:
                skipped, pixels = first_picture(codec, (packet for _, packet in self.stream(topic)))
                self._pictures[topic] = FirstPicture(pixels, "rgb8", skipped)
        return self._pictures[topic]

    def stamps_ns(self, topic: str) -> tuple[int, int]:
        """The timestamps in the headers of the first message of ``topic`` and of the last one."""
        return stamp_ns(self.first(topic)), stamp_ns(self._last(topic))

    def stream(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[int, Any]]:
        """Messages of ``topic`` with the time of receipt; raises InvalidInput where one is damaged."""
        for connection, received_ns, raw in self.raw(topic, start_ns=start_ns):
            yield received_ns, self.decode(connection, raw)

    def raw(self, *topics: str, start_ns: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """The messages of ``topics`` in order of time, not decoded; raises InvalidInput where one is damaged."""
        wanted = [entry for entry in self.reader.connections if entry.topic in topics]
        source = self.reader.messages(wanted, start_ns)
        number = 0
        while True:
            try:
                entry = next(source, None)
            except DAMAGE as error:
                raise self.damaged(error, f"message {number + 1} of {', '.join(topics)}{self._near()}") from None
            if entry is None:
                return
            number += 1
            yield entry

    def decode(self, connection: Connection, raw: bytes) -> Any:
        """The message in ``raw``; raises InvalidInput if its type is unknown or it is damaged."""
        self.define(connection)
        try:
            message = self.reader.deserialize(raw, connection.msgtype)
        except DAMAGE as error:
            raise self.damaged(error, f"a message of {connection.topic}") from None
        return VideoPacket.of(message, connection.msgtype) if connection.msgtype in VIDEO_TYPES else message

    def damaged(self, error: Exception, place: str) -> InvalidInput:
        """Fault that rosbags found at ``place``, in one line."""
        found = damaged(self.path, error)
        return InvalidInput(f"{found.message} ({place})", found.remedy)

    def _near(self) -> str:
        """Where reading stopped, for files of which that is known."""
        storages = [getattr(reader, "storage", reader) for reader in self.reader.readers]
        files = [getattr(part, "bio", None) for storage in storages for part in getattr(storage, "storages", [storage])]
        places = [file.tell() for file in files if file is not None]
        return f", before byte {places[0]}" if len(places) == 1 else ""

    def _last(self, topic: str) -> Any:
        for window_s in _WINDOWS_S:
            start_ns = self.end_ns - int(window_s * NS_PER_S)
            raw = _last_of(self.raw(topic, start_ns=start_ns))
            if raw is not None or start_ns <= self.start_ns:
                break
        else:
            raw = _last_of(self.raw(topic))
        return self.first(topic) if raw is None else self.decode(raw[0], raw[2])

    def _listed(self) -> Iterator[SourceTopic]:
        kinds: dict[str, set[str]] = {}
        counts: dict[str, int] = {}
        for entry in self.reader.connections:
            kinds.setdefault(entry.topic, set()).add(entry.msgtype)
            counts[entry.topic] = counts.get(entry.topic, 0) + entry.msgcount
        for name in sorted(kinds):
            yield SourceTopic(name, kinds[name].pop() if len(kinds[name]) == 1 else "various", counts[name])

    def define(self, connection: Connection) -> None:
        """Add the definition of a type that the recording lacks; raises InvalidInput if nobody knows it."""
        kind, known = connection.msgtype, self.reader.typestore
        if kind in known.fielddefs:
            self._check_definition(kind, known)
            return
        if kind not in self._spare.fielddefs:
            raise InvalidInput(
                f"{self.path}: type {kind} of topic {connection.topic} is not defined in the recording",
                "give a folder with its .msg file and those it uses (--msgs DIR), or name a --typestore that has it",
            )
        missing = {name: fields for name, fields in self._spare.fielddefs.items() if name not in known.fielddefs}
        known.register(missing)

    def _check_definition(self, kind: str, known: Typestore) -> None:
        """Raise InvalidInput if the recording defines a standard type without a part that everybody reads."""
        if kind in self._checked or kind not in self._spare.fielddefs:
            return
        self._checked.add(kind)
        lacking = sorted(_field_names(self._spare, kind) - _field_names(known, kind))
        if lacking:
            raise InvalidInput(
                f"{self.path}: its definition of {kind} lacks {', '.join(lacking[:3])}",
                "it may be damaged: copy it again",
            )


def _field_names(store: Typestore, kind: str) -> set[str]:
    """The names of all fields of a type and of those within them; ROS 1 has capitals for K, D, R and P."""
    names: set[str] = set()
    for own, (node, detail) in store.fielddefs[kind][1]:
        name = own.lower() if len(own) == 1 else own
        names.add(name)
        inner = detail[0] if node in {Nodetype.ARRAY, Nodetype.SEQUENCE} else (node, detail)
        if inner[0] is Nodetype.NAME and inner[1] in store.fielddefs:
            names |= {f"{name}.{part}" for part in _field_names(store, inner[1])}
    return names


@contextmanager
def open_source(
    paths: Sequence[Path], options: ImportOptions, name: Path | None = None, *, lenient: bool = False
) -> Iterator[SourceBag]:
    """Open a recording, or several ROS 1 bags as one.

    Args:
        paths: The file, the folder of a ROS 2 bag, or the parts of a ROS 1 recording.
        options: Where definitions of message types come from.
        name: What messages call it; the first path unless given.
        lenient: Read what is readable where rosbags refuses the recording, or reads less than it holds.

    Raises:
        InvalidInput: It is empty, damaged or none at all; a type store or definition is unknown.
    """
    # Recordings without definitions get those of ROS 2 Humble or of the named store, and those in files.
    stores = {store.value: store for store in Stores}
    wanted = options.typestore or Stores.ROS2_HUMBLE.value
    if wanted not in stores:
        raise InvalidInput(f"typestore {wanted!r} is unknown; {nearest(wanted, list(stores))}")
    spare = get_typestore(stores[wanted])
    spare.register(dict(VIDEO_DEFINITIONS))
    if options.message_definitions is not None:
        found = _definitions(options.message_definitions)
        spare.register({kind: fields for kind, fields in found.items() if kind not in spare.fielddefs})
    path = name or paths[0]
    for part in paths:
        if part.is_file() and part.stat().st_size == 0:
            raise InvalidInput(f"{part} is empty (0 bytes)", "copy or download it again")
        old = old_version(part) if part.suffix == ".bag" and part.is_file() else ""
        if old:
            raise InvalidInput(f"{part} is a ROS bag of version {old}, and 2.0 is read", TO_VERSION_2)
    reader, refused = _reader(paths, spare, path, lenient=lenient)
    try:
        yield SourceBag(path, reader, spare, refused)
    except _BAD_METADATA:
        if not path.is_dir() or isinstance(reader, LenientReader):
            raise
        raise InvalidInput(
            f"{path}: metadata.yaml lacks a number or a name, or has another value there", reindexing(path)
        ) from None
    finally:
        reader.close()


def old_version(path: Path) -> str:
    """Version of a ROS 1 bag from before 2.0, such as ``1.2``; empty for all other files."""
    with path.open("rb") as file:
        found = _OLD_MAGIC.match(file.read(_LONGEST_MAGIC))
    return "" if found is None else found[1].decode()


def _reader(
    paths: Sequence[Path], spare: Typestore, path: Path, *, lenient: bool
) -> tuple[AnyReader | LenientReader, str]:
    """Open that of rosbags, or the lenient one with the reason where rosbags refuses, or reads less than there is."""
    reader = None
    try:
        reader = AnyReader(paths, default_typestore=spare)
        reader.open()
        refused = contradiction(reader) if reader.is2 else ""
        if (
            reader.is2
            and not refused
            and sum(entry.msgcount for entry in reader.connections) < max(reader.message_count, 1)
        ):
            refused = "its index lacks channels or messages"
        if reader.is2 and not refused and any(entry.msgtype == _NO_TYPE for entry in reader.connections):
            refused = "its index lacks the types of channels"
        if not refused or not lenient:
            return reader, ""
        reader.close()
    except (*DAMAGE, *_BAD_METADATA) as error:
        problem = damaged(path, error)
        reason = textwrap.shorten(str(error), 100, placeholder=" ...") or "its bytes make no sense"
        refused = f"{reason} is not known" if isinstance(error, KeyError) else reason
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            refused = "it has no metadata.yaml"
        if not lenient:
            raise problem from None
    else:
        problem = InvalidInput(f"{path} holds no messages", "record or copy it again")
    try:
        if reader is not None and not reader.is2:
            bags = AnyReader(paths, default_typestore=spare)
            bags.readers = [LenientRos1Reader(part) for part in paths]
            bags.open()
            return bags, "its index states lengths that it does not have"
        found = LenientReader(paths[0], spare)
    except (*DAMAGE, *_BAD_METADATA):
        raise problem from None
    if not found.message_count:
        found.close()
        raise problem
    return found, refused


def _definitions(folder: Path) -> dict[str, Any]:
    """The types of all ``.msg`` files below ``folder``; ``PACKAGE/msg/Name.msg`` names the package."""
    files = visible_files(folder, "**/*.msg")
    if not files:
        raise InvalidInput(f"{folder} holds no .msg file", "give the folder of PACKAGE/msg/Name.msg")
    found: dict[str, Any] = {}
    for file in files:
        package = file.parent.parent.name if file.parent.name == "msg" else file.parent.name
        try:
            text = file.read_bytes()[:_LONGEST_DEFINITION_BYTES].decode()
            found.update(get_types_from_msg(text, f"{package}/msg/{file.stem}"))
        except DAMAGE as error:
            raise InvalidInput(f"{file} is no message definition: {error}", "compare it with the package's") from None
    return found


def _last_of(messages: Iterator[tuple[Connection, int, bytes]]) -> tuple[Connection, int, bytes] | None:
    last = None
    for last in messages:  # noqa: B007 - the last one is what is wanted
        pass
    return last


# Which topic of a recording is which sensor.


LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
KINDS: dict[str, SensorKind] = {
    IMAGE: SensorKind.CAMERA,
    COMPRESSED_IMAGE: SensorKind.CAMERA,
    IMU: SensorKind.IMU,
    POINTS: SensorKind.LIDAR,
    **dict.fromkeys(VIDEO_TYPES, SensorKind.CAMERA),
    **dict.fromkeys(LIVOX, SensorKind.LIDAR),
    LASER_SCAN: SensorKind.LASER,
    ODOMETRY: SensorKind.ODOMETRY,
    NAV_SAT_FIX: SensorKind.GNSS,
}
PREFIXES: dict[SensorKind, str] = {
    SensorKind.CAMERA: "cam",
    SensorKind.DEPTH: "depth",
    SensorKind.IMU: "imu",
    SensorKind.LIDAR: "lidar",
    SensorKind.LASER: "laser",
    SensorKind.ODOMETRY: "odom",
    SensorKind.GNSS: "gnss",
}
"""The first part of a sensor's name; a number follows."""
NO_TOPIC = "none"
"""``--topic cam0=none`` leaves a sensor out."""

_DEPTH_ENCODINGS = {"16UC1", "32FC1"}
_SENSOR_NAME = re.compile(rf"({'|'.join(PREFIXES.values())})(0|[1-9]\d?)")
_TOPIC = re.compile(r"/?[A-Za-z0-9_/]{1,200}")
_IMAGE_NAMES = ("image_raw", "image", "image_color", "image_mono", "image_rect_color", "image_rect", "image_rect_raw")
"""The last part of an image topic, the one that is preferred first; ``/compressed`` or the like may follow."""
_MOST_LISTED = 10
_SIDES = (("left", "right"), ("infra1", "infra2"))


@dataclass(frozen=True, slots=True)
class Matching:
    """Assign topics to sensors: {name of the sensor: topic}, and notes for users."""

    topics: dict[str, SourceTopic]
    notes: tuple[str, ...]

    def kind(self, name: str) -> SensorKind:
        """The kind of the sensor called ``name``."""
        return kind_of_name(name)


def kind_of_name(name: str) -> SensorKind:
    """The kind of sensor that a name such as ``cam0`` stands for; raises InvalidInput."""
    found = _SENSOR_NAME.fullmatch(name)
    if found is None:
        known = ", ".join(f"{prefix}0" for prefix in PREFIXES.values())
        raise InvalidInput(f"--topic: {name!r} is no name of a sensor", f"use {known}, or another number")
    return next(kind for kind, prefix in PREFIXES.items() if prefix == found[1])


def match_topics(bag: SourceBag, chosen: Mapping[str, str], *, without: str | None = None) -> Matching:
    """Match topics to sensors by type, name and the encoding of images.

    Args:
        bag: The recording.
        chosen: Topics by name of sensor. Sensors of a kind that is named here are only those that are named; a sensor
            whose topic is ``none`` is left out.
        without: A topic that is no sensor: the ground truth.

    Raises InvalidInput for a topic that does not exist or does not fit, or that two sensors share.
    """
    taken = {without or "", *chosen.values()}
    found: dict[SensorKind, list[SourceTopic]] = {}
    reasons: dict[str, str] = {}
    notes: list[str] = []
    for topic in bag.of_type(*KINDS):
        if topic.name in taken:
            continue
        reason, kind = _look(bag, topic)
        if reason:
            reasons[topic.name] = reason
        else:
            found.setdefault(kind, []).append(topic)
    for kind in _IMAGES & found.keys():
        found[kind], left_out = _one_topic_each(bag, found[kind])
        notes += left_out
    # In the order of their numbers, by which they are named.
    found = {kind: _in_order(entries) for kind, entries in found.items()}

    named = _chosen(bag, chosen)
    topics: dict[str, SourceTopic] = {}
    for kind, prefix in PREFIXES.items():
        own = {name: topic for name, topic in named.items() if kind_of_name(name) is kind}
        if not own:
            own = {f"{prefix}{number}": topic for number, topic in enumerate(found.get(kind, ()))}
        topics.update(own)
    for name, wanted in chosen.items():
        if wanted == NO_TOPIC and topics.pop(name, None) is None:
            raise InvalidInput(f"--topic {name}=none: there is no such sensor; {nearest(name, list(topics))}")
    if not topics:
        others = {topic.name: f"it holds {topic.type}" for topic in bag.topics.values() if topic.type not in KINDS}
        listed = [f"{name}: {why}" for name, why in {**reasons, **bag.unreadable, **others}.items()]
        more = f", and {len(listed) - _MOST_LISTED} more" if len(listed) > _MOST_LISTED else ""
        raise InvalidInput(
            f"{bag.path} has no topic of a sensor that can be read ({'; '.join(listed[:_MOST_LISTED])}{more})",
            "name a topic with --topic SENSOR=TOPIC, or record one that is read",
        )
    return Matching(topics, (*(f"{name} is left out: {reason}" for name, reason in reasons.items()), *notes))


def _chosen(bag: SourceBag, chosen: Mapping[str, str]) -> dict[str, SourceTopic]:
    named: dict[str, SourceTopic] = {}
    for name, wanted in sorted(chosen.items()):
        kind = kind_of_name(name)
        if wanted == NO_TOPIC:
            continue
        topic = bag.topic(wanted, f"sensor {name}")
        allowed = [entry for entry in KINDS if KINDS[entry] is (SensorKind.CAMERA if kind in _IMAGES else kind)]
        if topic.type not in allowed:
            raise InvalidInput(
                f"topic {wanted!r} for sensor {name} holds {topic.type}", f"expected {' or '.join(allowed)}"
            )
        other = next((other for other, entry in named.items() if entry == topic), None)
        if other is not None:
            raise InvalidInput(f"topic {wanted!r} is named for {other} and for {name}", "name it once")
        named[name] = topic
    return named


_IMAGES = {SensorKind.CAMERA, SensorKind.DEPTH}


def _look(bag: SourceBag, topic: SourceTopic) -> tuple[str, SensorKind]:
    """Why a topic cannot be read, empty if it can; and its kind."""
    kind = KINDS[topic.type]
    if topic.count < 2:
        return "it has a single message", kind
    if _TOPIC.fullmatch(topic.name) is None:
        return "its name has other characters than letters, digits, '_' and '/'", kind
    if topic.type in {COMPRESSED_IMAGE, *VIDEO_TYPES} and codec_of(bag.first(topic.name), topic.type) is not None:
        return _why_no_video(bag, topic), kind
    if topic.type == COMPRESSED_IMAGE and is_odd(bag.first(topic.name), topic.type):
        message = bag.first(topic.name)
        reason = "" if depth_encoding(message) else f"compressed depth of format {str(message.format)!r} is not read"
        return reason, SensorKind.DEPTH
    if topic.type == IMAGE:
        encoding = str(bag.first(topic.name).encoding)
        is_depth = encoding in _DEPTH_ENCODINGS or (encoding == "mono16" and "depth" in topic.name)
        known = encoding in IMAGE_ENCODINGS | ODD_ENCODINGS
        reason = "" if known else f"image encoding {encoding!r} is not read"
        return reason, SensorKind.DEPTH if is_depth else kind
    return "", kind


def _why_no_video(bag: SourceBag, topic: SourceTopic) -> str:
    """Why a topic of video cannot be decoded, empty if it can."""
    message = bag.first(topic.name)
    if not codec_of(message, topic.type):
        return f"video of format {message.format[:80]!r} is not read"
    try:
        bag.first_picture(topic.name)
    except InvalidInput as error:
        return str(error)
    return ""


def _one_topic_each(bag: SourceBag, topics: Iterable[SourceTopic]) -> tuple[list[SourceTopic], list[str]]:
    """One topic for each camera: its raw images rather than rectified or compressed ones, and what was left out.

    Images that would have to be converted come last.
    """
    cameras: dict[str, list[tuple[tuple[bool, int], SourceTopic]]] = {}
    for topic in topics:
        camera, rank = camera_of(topic.name)
        odd = is_odd(bag.first(topic.name), topic.type)
        cameras.setdefault(camera, []).append(((odd, rank), topic))
    kept: list[SourceTopic] = []
    notes: list[str] = []
    for entries in cameras.values():
        entries.sort(key=lambda entry: (entry[0], entry[1].name))
        kept.append(entries[0][1])
        notes += [f"{topic.name} shows the same camera as {entries[0][1].name}" for _, topic in entries[1:]]
    return kept, notes


def camera_of(topic: str) -> tuple[str, int]:
    """The part of an image topic that names its camera, and how well the topic is liked: 0 is best."""
    plain = topic.removesuffix("/compressed").removesuffix("/compressedDepth")
    camera, _, last = plain.rpartition("/")
    rank = 2 * _IMAGE_NAMES.index(last) if last in _IMAGE_NAMES else 0
    return (camera if last in _IMAGE_NAMES else plain), rank + (plain != topic)


def _in_order(topics: list[SourceTopic]) -> list[SourceTopic]:
    """Stereo pairs first, left before right; then by name, numbers by value."""
    names = {topic.name for topic in topics}
    return sorted(
        topics,
        key=lambda topic: (
            not _has_partner(topic.name, names),
            [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", topic.name)],
        ),
    )


def _has_partner(name: str, names: set[str]) -> bool:
    swaps = [*_SIDES, *(pair[::-1] for pair in _SIDES)]
    return any(own in name and name.replace(own, other) in names for own, other in swaps)
