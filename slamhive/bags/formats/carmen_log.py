"""Reads logs of the robot navigation toolkit CARMEN line by line, so that memory does not grow with the log.

The messages and their fields are those of CARMEN's ``logger/readlog.c``. Each line ends with the time at which the
message was sent, the host, and the time at which the logger received it, relative to its start.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamhive.bags.geometry import Array
from slamhive.bags.text_lines import Line, Track, lines
from slamhive.domain.calibration import LaserLayout

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
    """What a log holds besides ranges: of scans the time and the odometry, x y yaw, in m and rad."""

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
            _add_scan(log, line)
    return log


def scan_ranges(path: Path) -> Iterator[Array]:
    """The ranges in m of all scans, one after the other."""
    for line in lines(path):
        if line.words[0] in LASER_WORDS:
            scan = read_scan(line)
            ranges_m: Array = np.array(line.numbers(scan.first, scan.count, "the ranges"))
            yield ranges_m


def read_scan(line: Line) -> Scan:
    """The scan of a laser message without its ranges; raises InvalidInput naming the line."""
    return _old_scan(line) if line.words[0] == "FLASER" else _new_scan(line)


def _old_scan(line: Line) -> Scan:
    """FLASER: number of ranges, ranges, pose of the laser, odometry; ``readlog.c`` guesses the geometry."""
    count = line.count(1, _MOST_RANGES)
    poses = line.numbers(2 + count, 6, "the poses")
    layout = LaserLayout(-math.pi / 2, _guessed_increment_rad(count), 0.0, _OLD_MAXIMUM_RANGE_M)
    return Scan(line.time_s(8 + count), 2, count, layout, poses[:3], poses[3:])


def _new_scan(line: Line) -> Scan:
    """ROBOTLASER1: type, start, field of view, resolution, range, accuracy, mode, ranges, remissions, poses, ..."""
    start_rad, _, increment_rad, maximum_m = line.numbers(2, 4, "the geometry")
    count = line.count(8, _MOST_RANGES)
    remissions = line.count(9 + count, _MOST_RANGES)
    place = 10 + count + remissions
    poses = line.numbers(place, 6, "the poses")
    layout = LaserLayout(start_rad, increment_rad, 0.0, maximum_m)
    return Scan(line.time_s(place + 11), 9, count, layout, poses[:3], poses[3:])


def _add_scan(log: Log, line: Line) -> None:
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


def _guessed_increment_rad(count: int) -> float:
    """As ``carmen_laser_guess_angle_increment``."""
    for degrees, counts in ((1.0, (180, 181)), (0.5, (360, 361)), (0.25, (400, 401))):
        if count in counts:
            return math.radians(degrees)
    return math.pi / max(count - 1, 1)
