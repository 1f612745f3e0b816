"""Which topic of a recording is which sensor."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from slamhive.bags.formats.source_bag import SourceBag, SourceTopic
from slamhive.domain.sensors import SensorKind
from slamhive.errors import InvalidInput, nearest
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, IMAGE_ENCODINGS, IMU, POINTS

LIVOX = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
KINDS: dict[str, SensorKind] = {
    IMAGE: SensorKind.CAMERA,
    COMPRESSED_IMAGE: SensorKind.CAMERA,
    IMU: SensorKind.IMU,
    POINTS: SensorKind.LIDAR,
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
"""The last part of an image topic, the one that is preferred first; ``/compressed`` may follow."""
_SIDES = (("left", "right"), ("infra1", "infra2"))


@dataclass(frozen=True, slots=True)
class Matching:
    """Which topic is which sensor: by name of the sensor; and what users should know."""

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
    found, notes = _by_kind(bag, without)
    named = _chosen(bag, chosen)
    topics: dict[str, SourceTopic] = {}
    for kind, prefix in PREFIXES.items():
        own = {name: topic for name, topic in named.items() if kind_of_name(name) is kind}
        if not own:
            own = {f"{prefix}{number}": topic for number, topic in enumerate(found.get(kind, ()))}
        topics.update(own)
    for name, topic in chosen.items():
        if topic == NO_TOPIC and topics.pop(name, None) is None:
            raise InvalidInput(f"--topic {name}=none: there is no such sensor; {nearest(name, list(topics))}")
    if not topics:
        kinds = ", ".join(sorted({topic.type for topic in bag.topics.values()}))
        raise InvalidInput(f"{bag.path} has no topic of a sensor: it holds {kinds}", "name them with --topic")
    return Matching(topics, tuple(notes))


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


def _by_kind(bag: SourceBag, without: str | None) -> tuple[dict[SensorKind, list[SourceTopic]], list[str]]:
    """The topics of each kind in the order of their numbers, and notes."""
    found: dict[SensorKind, list[SourceTopic]] = {}
    notes: list[str] = []
    for topic in bag.of_type(*KINDS):
        if topic.name == without:
            continue
        reason, kind = _look(bag, topic)
        if reason:
            notes.append(f"{topic.name} is left out: {reason}")
        else:
            found.setdefault(kind, []).append(topic)
    for kind in _IMAGES & found.keys():
        found[kind], more = _one_topic_each(found[kind])
        notes += more
    return {kind: _in_order(topics) for kind, topics in found.items()}, notes


def _look(bag: SourceBag, topic: SourceTopic) -> tuple[str, SensorKind]:
    """Why a topic cannot be read, empty if it can; and its kind."""
    kind = KINDS[topic.type]
    if topic.count < 2:
        return "it has a single message", kind
    if _TOPIC.fullmatch(topic.name) is None:
        return "its name has other characters than letters, digits, '_' and '/'", kind
    if topic.type == COMPRESSED_IMAGE:
        text = str(bag.first(topic.name).format)
        return ("compressed depth is not read" if "compressedDepth" in text else ""), kind
    if topic.type == IMAGE:
        encoding = str(bag.first(topic.name).encoding)
        is_depth = encoding in _DEPTH_ENCODINGS or (encoding == "mono16" and "depth" in topic.name)
        reason = "" if encoding in IMAGE_ENCODINGS else f"image encoding {encoding!r} is not read"
        return reason, SensorKind.DEPTH if is_depth else kind
    return "", kind


def _one_topic_each(topics: Iterable[SourceTopic]) -> tuple[list[SourceTopic], list[str]]:
    """One topic for each camera: its raw images rather than rectified or compressed ones, and what was left out."""
    cameras: dict[str, list[tuple[int, SourceTopic]]] = {}
    for topic in topics:
        camera, rank = camera_of(topic.name)
        cameras.setdefault(camera, []).append((rank, topic))
    kept: list[SourceTopic] = []
    notes: list[str] = []
    for entries in cameras.values():
        entries.sort(key=lambda entry: (entry[0], entry[1].name))
        kept.append(entries[0][1])
        notes += [f"{topic.name} shows the same camera as {entries[0][1].name}" for _, topic in entries[1:]]
    return kept, notes


def camera_of(topic: str) -> tuple[str, int]:
    """The part of an image topic that names its camera, and how well the topic is liked: 0 is best."""
    plain = topic.removesuffix("/compressed")
    camera, _, last = plain.rpartition("/")
    rank = 2 * _IMAGE_NAMES.index(last) if last in _IMAGE_NAMES else 0
    return (camera if last in _IMAGE_NAMES else plain), rank + (plain != topic)


def _in_order(topics: list[SourceTopic]) -> list[SourceTopic]:
    """Stereo pairs first, left before right; then by name, numbers by value."""
    names = {topic.name for topic in topics}
    return sorted(topics, key=lambda topic: (not _has_partner(topic.name, names), _natural(topic.name)))


def _has_partner(name: str, names: set[str]) -> bool:
    swaps = [*_SIDES, *(pair[::-1] for pair in _SIDES)]
    return any(own in name and name.replace(own, other) in names for own, other in swaps)


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
