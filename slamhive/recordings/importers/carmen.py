"""Importer of CARMEN logs, the format of the 2D laser datasets of the Radish repository and of Freiburg.

Kümmerle et al., "On measuring the accuracy of SLAM algorithms" (Autonomous Robots 2009), publish relations for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import LaserLayout
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    rate_hz,
    refuse_losses,
)
from slamhive.recordings.streams import laser_stream, odometry_stream, planar_transform, pose_quats_xyzw
from slamhive.recordings.text_lists import TextLine, Track, lines
from slamhive.trajectory.table import parse_table, read_bounded

# Reads logs of the robot navigation toolkit CARMEN line by line, so that memory does not grow with the log.
#
# The messages and their fields are those of CARMEN's ``logger/readlog.c``. Each line ends with the time at which the
# message was sent, the host, and the time at which the logger received it, relative to its start.


LASER_WORDS = ("FLASER", "ROBOTLASER1")
_MOST_RANGES = 20_000
_OLD_MAXIMUM_RANGE_M = 80.0
"""What ``carmen_string_to_robot_laser_message_orig`` assumes of the scanner of a FLASER message."""


@dataclass(frozen=True, slots=True)
class Scan:
    """A laser message: where its ranges stand in the line, what its scanner is, and where it and the robot were."""

    time_s: float
    first: int
    count: int
    layout: LaserLayout
    laser_pose: Sequence[float]
    robot_pose: Sequence[float]


@dataclass(eq=False)
class Log:
    """Content of a log besides ranges: of scans the time and the odometry, x y yaw, in m and rad."""

    path: Path
    scans: Track = field(default_factory=lambda: Track(3))
    first_scan: Scan | None = None
    odometry: Track = field(default_factory=lambda: Track(5))
    true_poses: Track = field(default_factory=lambda: Track(3))
    parameters: dict[str, str] = field(default_factory=dict)


def read_log(path: Path) -> Log:
    """Read everything but the ranges; raises InvalidInput naming the line."""
    log = Log(path)
    for line in lines(path):
        word = line.words[0]
        if word == "PARAM" and len(line.words) > 2:
            log.parameters[line.words[1]] = line.words[2]
        elif word == "ODOM":
            log.odometry.add(line.time_s(7), line.numbers(1, 5, "the odometry"))
        elif word == "TRUEPOS":
            log.true_poses.add(line.time_s(7), line.numbers(1, 3, "the true pose"))
        elif word in LASER_WORDS:
            scan = read_scan(line)
            line.numbers(scan.first, scan.count, "the ranges")
            first = log.first_scan
            if first is None:
                log.first_scan = first = scan
            if (scan.count, scan.layout) != (first.count, first.layout):
                raise line.error(
                    f"a scan of {scan.count} ranges after scans of {first.count}, or of another geometry",
                    "split the log: the scans of a scanner must be alike",
                )
            log.scans.add(scan.time_s, scan.robot_pose)
    return log


def scan_ranges(path: Path) -> Iterator[Array]:
    """The ranges in m of all scans, one after the other."""
    for line in lines(path):
        if line.words[0] in LASER_WORDS:
            scan = read_scan(line)
            ranges_m: Array = np.array(line.numbers(scan.first, scan.count, "the ranges"))
            yield ranges_m


def read_scan(line: TextLine) -> Scan:
    """The scan of a laser message without its ranges; raises InvalidInput naming the line."""
    if line.words[0] == "FLASER":
        # Number of ranges, ranges, pose of the laser, odometry; ``readlog.c`` guesses the geometry.
        count = line.count(1, _MOST_RANGES)
        poses = line.numbers(2 + count, 6, "the poses")
        layout = LaserLayout(-math.pi / 2, _guessed_increment_rad(count), 0.0, _OLD_MAXIMUM_RANGE_M)
        return Scan(line.time_s(8 + count), 2, count, layout, poses[:3], poses[3:])
    # ROBOTLASER1: type, start, field of view, resolution, range, accuracy, mode, ranges, remissions, poses, ...
    start_rad, _, increment_rad, maximum_m = line.numbers(2, 4, "the geometry")
    count = line.count(8, _MOST_RANGES)
    remissions = line.count(9 + count, _MOST_RANGES)
    place = 10 + count + remissions
    poses = line.numbers(place, 6, "the poses")
    layout = LaserLayout(start_rad, increment_rad, 0.0, maximum_m)
    return Scan(line.time_s(place + 11), 9, count, layout, poses[:3], poses[3:])


def _guessed_increment_rad(count: int) -> float:
    """Guess the increment like ``carmen_laser_guess_angle_increment``."""
    for degrees, counts in ((1.0, (180, 181)), (0.5, (360, 361)), (0.25, (400, 401))):
        if count in counts:
            return math.radians(degrees)
    return math.pi / max(count - 1, 1)


_SUFFIXES = (".clf", ".log", ".clf.bz2", ".log.bz2", ".clf.gz", ".log.gz")
_LINES_TO_DETECT = 200
_RELATION = "timestamp1 timestamp2 x y z roll pitch yaw"


class CarmenImporter:
    """Scans of the front laser and wheel odometry to a dataset. The body is the robot's base.

    ``<log>.relations`` beside the log becomes the relations of the dataset, and TRUEPOS messages of simulated robots
    become its ground truth.
    """

    title = "CARMEN log: 2D laser (FLASER or ROBOTLASER1), odometry, optionally <log>.relations"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The laser messages in the first lines of a log."""
        logs = _logs(path)
        if len(logs) != 1:
            return Detection((), ("a CARMEN log (.clf or .log, also .bz2 or .gz)",))
        try:
            words = {line.words[0] for line, _ in zip(lines(logs[0]), range(_LINES_TO_DETECT), strict=False)}
        except InvalidInput:
            return Detection((), ("a log that can be read",))
        found = sorted(words.intersection((*LASER_WORDS, "ODOM")))
        evidence = tuple(f"{word} in {logs[0].name}" for word in found)
        lacking = () if words.intersection(LASER_WORDS) else (f"{' or '.join(LASER_WORDS)} in the first lines",)
        return Detection(evidence, lacking)

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the log; raises InvalidInput naming the line and the remedy."""
        logs = _logs(source)
        if len(logs) != 1:
            raise InvalidInput(f"{source} has {len(logs)} CARMEN logs", "give one log")
        log = read_log(logs[0])
        if log.first_scan is None or not log.first_scan.count:
            raise InvalidInput(f"{log.path} has no laser scan", f"expected messages {' or '.join(LASER_WORDS)}")
        relations = _relations(log.path)
        notes = _notes(log, relations)
        # Too few scans have no rate. The reason why the others are missing says more than that.
        refuse_losses(notes, accepted=options.accept_loss)
        return ImportPlan(
            (_laser(log, log.first_scan), _odometry(log)),
            _truth(log),
            _text(log),
            relations=relations,
            notes=notes,
        )


def _logs(path: Path) -> list[Path]:
    files = [path] if path.is_file() else visible_files(path)
    return [file for file in files if file.name.lower().endswith(_SUFFIXES) and file.is_file()]


def _laser(log: Log, scan: Scan) -> PlannedStream:
    layout = scan.layout
    if "robot_front_laser_max" in log.parameters:
        layout = replace(layout, maximum_range_m=_parameter(log, "robot_front_laser_max"))
    if layout.angle_increment_rad <= 0 or layout.maximum_range_m <= 0:
        raise InvalidInput(f"{log.path}: the scanner has no angle between ranges or no range", "correct the first scan")
    times_ns = log.scans.times_ns
    # Old logs state the mount as parameters, new ones as the poses of laser and robot at the time of a scan.
    names = ("robot_frontlaser_offset", "robot_frontlaser_side_offset", "robot_frontlaser_angular_offset")
    x_m, y_m, yaw_rad = (_parameter(log, name) if name in log.parameters else 0.0 for name in names)
    if not any(name in log.parameters for name in names):
        (laser_x, laser_y, laser_yaw), (robot_x, robot_y, robot_yaw) = scan.laser_pose, scan.robot_pose
        yaw_rad = math.remainder(laser_yaw - robot_yaw, 2 * math.pi)
        c, s = math.cos(robot_yaw), math.sin(robot_yaw)
        x_m = c * (laser_x - robot_x) + s * (laser_y - robot_y)
        y_m = c * (laser_y - robot_y) - s * (laser_x - robot_x)
    T_body_laser = planar_transform(x_m, y_m, yaw_rad)
    sensor = Sensor(
        "laser0",
        SensorKind.LASER,
        "/scan",
        rate_hz(times_ns),
        T_body_laser,
        {"beams": scan.count, **layout.calibration()},
    )
    return laser_stream(sensor, log.scans, lambda: scan_ranges(log.path), scan.count)


def _parameter(log: Log, name: str) -> float:
    try:
        value = float(log.parameters[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidInput(f"{log.path}: PARAM {name} {log.parameters[name][:40]!r} is no number", "correct it")
    return value


def _odometry(log: Log) -> PlannedStream:
    """From ODOM messages; from the poses in the laser messages where there are none."""
    own = len(log.odometry) > 1
    track = log.odometry if own else log.scans
    sensor = Sensor("odom0", SensorKind.ODOMETRY, "/odom", rate_hz(track.times_ns))
    values = track.values
    return odometry_stream(sensor, track.times_ns, values[:, :3], values[:, 3:5] if own else None)


def _truth(log: Log) -> PlannedTruth | None:
    poses = log.true_poses.values
    if not len(poses):
        return None
    positions_m = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    return PlannedTruth(
        log.true_poses.times_s, positions_m, pose_quats_xyzw(poses[:, 2]), gravity_aligned=True, source="simulator"
    )


def _relations(log: Path) -> str | None:
    stem = log.name
    for suffix in (".bz2", ".gz", ".clf", ".log"):
        stem = stem.removesuffix(suffix)
    path = log.with_name(f"{stem}.relations")
    if not path.is_file():
        return None
    data = read_bounded(path)
    table = parse_table(data, str(path), 8, _RELATION)
    bad = np.flatnonzero(~np.isfinite(table.values).all(axis=1))
    if len(bad):
        raise table.error(int(bad[0]), "a number is not finite", "leave the relation out")
    return data.decode("utf-8")


def _notes(log: Log, relations: str | None) -> tuple[str, ...]:
    notes = [*log.scans.notes("scans"), *log.odometry.notes("odometry messages"), *log.true_poses.notes("true poses")]
    if relations is None and not len(log.true_poses):
        notes.append("there is neither ground truth nor a file of relations: runs get no accuracy")
    return tuple(notes)


def _text(log: Log) -> DatasetText:
    return DatasetText(
        title=f"CARMEN log {log.path.name}",
        description=f"{len(log.scans)} scans of a 2D laser with wheel odometry; the body is the robot's base.",
        attributes=("real", "2d") if not len(log.true_poses) else ("synthetic", "2d"),
    )
