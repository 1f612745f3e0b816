"""Importer of sequences of the RAWSEEDS project as CSV files (Ceriani et al., Autonomous Robots 2009).

The columns are those of the project's description of its files, as ``procgraph_rawseeds`` quotes it:

- ``SICK_*``: timestamp in s, number of ranges, angular offset in quarters of a degree, 181 ranges in m;
- ``ODOMETRY_XYT``: timestamp in s, counter, counts of both wheels, x and y in m, theta in rad, y pointing to the front;
- ``GROUNDTRUTH`` and ``GT-extended``: timestamp in s, x and y in m, theta in rad, x pointing to the front.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
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
    matched_truth,
    rate_hz,
)
from slamhive.recordings.streams import laser_stream, odometry_stream, planar_transform, pose_quats_xyzw
from slamhive.recordings.text_lists import Track, lines

_SUFFIXES = (".csv", ".csv.bz2", ".csv.gz")
_ODOMETRY, _TRUTHS = "ODOMETRY_XYT", ("GT-extended", "GROUNDTRUTH")
_T_BODY_LASER = {
    "SICK_FRONT": planar_transform(0.08, 0.0, 0.0, 0.45),
    "SICK_REAR": planar_transform(-0.463, 0.001, math.pi, 0.454),
}
"""The mounting that converters of these files to ROS publish; the body is the robot's base, x to the front."""
_RANGES = 181
_INCREMENT_RAD = math.radians(1.0)
_MAXIMUM_RANGE_M = 80.0
"""Of the scanners of SICK's LMS 200 series; they report more where nothing returns."""


class RawseedsImporter:
    """The front and rear SICK scanners, wheel odometry and ground truth in the plane to a dataset."""

    title = "RAWSEEDS sequence: *-SICK_FRONT.csv, *-ODOMETRY_XYT.csv, optionally *-GROUNDTRUTH.csv (also .bz2)"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The files of a sequence."""
        found = [part for part in (*_T_BODY_LASER, _ODOMETRY, *_TRUTHS) if _file(path, part) is not None]
        missing = () if any(part in _T_BODY_LASER for part in found) else ("*-SICK_FRONT.csv or *-SICK_REAR.csv",)
        return Detection(tuple(f"*-{part}.csv" for part in found), missing)

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """Plan the import of the sequence; raises InvalidInput naming the line and the remedy."""
        notes: list[str] = []
        streams = [
            _laser(f"laser{number}", part, path, notes)
            for number, (part, path) in enumerate((part, _file(source, part)) for part in _T_BODY_LASER)
            if path is not None
        ]
        if not streams:
            raise InvalidInput(f"{source} has no *-SICK_FRONT.csv", "give the folder of a sequence")
        odometry = _file(source, _ODOMETRY)
        truths = [path for path in (_file(source, part) for part in _TRUTHS) if path is not None]
        truth = _truth(truths[0], notes) if truths else None
        notes += [*matched_truth(truth, streams), "images, the IMU, sonars and Hokuyo scanners are not imported"]
        streams += [] if odometry is None else [_odometry(odometry, notes)]
        return ImportPlan(tuple(streams), truth, _text(source), notes=tuple(notes))


def _file(folder: Path, part: str) -> Path | None:
    if not folder.is_dir():
        return None
    names = sorted(path for suffix in _SUFFIXES for path in visible_files(folder, f"*{part}{suffix}"))
    return names[0] if names else None


def _laser(name: str, part: str, path: Path, notes: list[str]) -> PlannedStream:
    track, offset_rad = Track(0), None
    for line in lines(path):
        line.count(1, _RANGES)
        (quarters,) = line.numbers(2, 1, "the angular offset")
        line.numbers(3, _RANGES, "the ranges")
        found_rad = math.radians(quarters / 4)
        if offset_rad not in {None, found_rad}:
            raise line.error("another angular offset than in the first scan", "split the file: scans must be alike")
        offset_rad = found_rad
        track.add(line.time_s(0), ())
    layout = LaserLayout(-math.pi / 2 + (offset_rad or 0.0), _INCREMENT_RAD, 0.0, _MAXIMUM_RANGE_M)
    sensor = Sensor(
        name,
        SensorKind.LASER,
        f"/{part.lower()}/scan",
        rate_hz(track.times_ns),
        _T_BODY_LASER[part],
        {"beams": _RANGES, **layout.calibration()},
    )
    notes += track.notes(f"scans of {path.name}")
    return laser_stream(sensor, track, lambda: _ranges(path), _RANGES)


def _ranges(path: Path) -> Iterator[Array]:
    for line in lines(path):
        count = line.count(1, _RANGES)
        ranges_m: Array = np.array(line.numbers(3, _RANGES, "the ranges"))
        ranges_m[count:] = np.nan
        yield ranges_m


def _odometry(path: Path, notes: list[str]) -> PlannedStream:
    """Odometry whose x axis points to the front, too: x and y become y and -x."""
    track = Track(3)
    for line in lines(path):
        right_m, front_m, yaw_rad = line.numbers(4, 3, "the pose")
        track.add(line.time_s(0), (front_m, -right_m, yaw_rad))
    sensor = Sensor("odom0", SensorKind.ODOMETRY, "/odom", rate_hz(track.times_ns))
    notes += track.notes(f"rows of {path.name}")
    return odometry_stream(sensor, track.times_ns, track.values)


def _truth(path: Path, notes: list[str]) -> PlannedTruth:
    track = Track(3)
    for line in lines(path):
        track.add(line.time_s(0), line.numbers(1, 3, "the pose"))
    if not len(track):
        raise InvalidInput(f"{path} has no poses", "expected lines of timestamp, x, y, theta")
    notes += track.notes(f"poses of {path.name}")
    poses = track.values
    positions_m = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    quats_xyzw = pose_quats_xyzw(poses[:, 2])
    source = "cameras and laser scanners in the building" if "GROUND" in path.name else "cameras, lasers and SLAM"
    return PlannedTruth(track.times_s, positions_m, quats_xyzw, gravity_aligned=True, source=source)


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"RAWSEEDS, {source.resolve().name}",
        description="2D laser scanners and wheel odometry of a RAWSEEDS sequence; the body is the robot's base.",
        citation="Ceriani et al.: Rawseeds ground truth collection systems for indoor self-localization and mapping. "
        "Autonomous Robots 27(4), 2009",
        source="http://www.rawseeds.org",
        attributes=("real", "2d"),
    )
