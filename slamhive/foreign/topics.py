"""Which sensor a topic or its name means, by the words in it."""

from __future__ import annotations

import itertools
import re

from slamhive.domain.sensors import SensorKind, SensorSetup

Role = tuple[str, SensorKind]

_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_NO_SENSOR = frozenset({"odom", "odometry", "path", "map", "gps", "gnss", "pose", "output", "tf", "cmd"})
_ROLES: tuple[tuple[Role, frozenset[str]], ...] = (
    (("imu", SensorKind.IMU), frozenset({"imu"})),
    (("depth", SensorKind.DEPTH), frozenset({"depth", "dep"})),
    (("points", SensorKind.LIDAR), frozenset({"points", "pointcloud", "cloud", "velodyne", "lidar", "pointclouds"})),
    (("scan", SensorKind.LASER), frozenset({"scan", "laserscan"})),
    (("right", SensorKind.CAMERA), frozenset({"right", "image1", "cam1", "img1", "camera1"})),
    (
        ("left", SensorKind.CAMERA),
        frozenset(
            {
                "left",
                "image0",
                "cam0",
                "img0",
                "camera0",
                "image",
                "img",
                "cam",
                "camera",
                "rgb",
                "mono",
                "color",
                "colour",
            }
        ),
    ),
)
_TOPIC = re.compile(r"/?[A-Za-z]\w*(?:/\w+){0,8}")
_FOLDERS = ("/home/", "/root/", "/slamhive/", "/opt/", "/usr/", "/tmp/", "/media/", "/data/", "/mnt/")  # noqa: S108

SETUPS: dict[SensorSetup, tuple[Role, ...]] = {
    SensorSetup.MONO: (("left", SensorKind.CAMERA),),
    SensorSetup.STEREO: (("left", SensorKind.CAMERA), ("right", SensorKind.CAMERA)),
    SensorSetup.RGBD: (("left", SensorKind.CAMERA), ("depth", SensorKind.DEPTH)),
    SensorSetup.MONO_INERTIAL: (("left", SensorKind.CAMERA), ("imu", SensorKind.IMU)),
    SensorSetup.STEREO_INERTIAL: (("left", SensorKind.CAMERA), ("right", SensorKind.CAMERA), ("imu", SensorKind.IMU)),
    SensorSetup.LIDAR: (("points", SensorKind.LIDAR),),
    SensorSetup.LIDAR_INERTIAL: (("points", SensorKind.LIDAR), ("imu", SensorKind.IMU)),
}
_LIDAR_NAMES = frozenset({"loam", "aloam", "lidar", "velodyne", "laser", "ndt", "icp", "lio"})


def words_in(text: str) -> set[str]:
    """The words of a name in lower case, numbers joined to what stands before: ``image0_topic`` has ``image0``."""
    parts = [part.lower() for part in _WORDS.findall(text)]
    joined = {first + second for first, second in itertools.pairwise(parts) if second.isdigit()}
    return set(parts) | joined


def role_of(name: str) -> Role | None:
    """The role and kind of sensor that a name means; None if it names none, or an output."""
    words = words_in(name)
    if words & _NO_SENSOR:
        return None
    if {"point", "cloud"} <= words or {"laser", "cloud"} <= words:
        return "points", SensorKind.LIDAR
    return next((role for role, known in _ROLES if words & known), None)


def is_topic(text: str) -> bool:
    """Whether ``text`` looks like the name of a topic, and not like a path."""
    return _TOPIC.fullmatch(text) is not None and not text.startswith(_FOLDERS)


def setup_of_name(name: str) -> SensorSetup | None:
    """The set-up that the name of a folder says: ``orb-slam3-ros-stereo-inertial``."""
    words = words_in(name)
    inertial = bool(words & {"imu", "inertial", "vio", "lio"})
    if words & _LIDAR_NAMES:
        return SensorSetup.LIDAR_INERTIAL if inertial else SensorSetup.LIDAR
    if "rgbd" in words or {"rgb", "d"} <= words:
        return SensorSetup.RGBD
    if "stereo" in words:
        return SensorSetup.STEREO_INERTIAL if inertial else SensorSetup.STEREO
    if "mono" in words:
        return SensorSetup.MONO_INERTIAL if inertial or "vins" in words else SensorSetup.MONO
    return None


def setup_of_roles(roles: dict[str, SensorKind]) -> SensorSetup | None:
    """The set-up with just these kinds of sensors; None if there is none."""
    kinds = sorted(kind.value for kind in roles.values())
    return next(
        (setup for setup, known in SETUPS.items() if sorted(kind.value for _, kind in known) == kinds),
        None,
    )
