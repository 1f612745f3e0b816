"""Importer of CARMEN logs, the format of the 2D laser datasets of the Radish repository and of Freiburg.

Kümmerle et al., "On measuring the accuracy of SLAM algorithms" (Autonomous Robots 2009), publish relations for them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamhive.bags.detection import Detection
from slamhive.bags.formats.carmen_log import LASER_WORDS, Log, Scan, read_log, scan_ranges
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan, PlannedTruth, Stream, rate_hz
from slamhive.bags.losses import refuse_losses
from slamhive.bags.plane import laser_stream, odometry_stream, planar_transform, pose_quats_xyzw
from slamhive.bags.text_lines import lines
from slamhive.domain.sensors import Matrix4, Sensor, SensorKind
from slamhive.errors import InvalidInput
from slamhive.files import visible_files
from slamhive.trajectory.table import parse_table, read_bounded

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
        """What the log becomes; raises InvalidInput naming the line and the remedy."""
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


def _laser(log: Log, scan: Scan) -> Stream:
    layout = scan.layout
    if "robot_front_laser_max" in log.parameters:
        layout = replace(layout, maximum_range_m=_parameter(log, "robot_front_laser_max"))
    if layout.angle_increment_rad <= 0 or layout.maximum_range_m <= 0:
        raise InvalidInput(f"{log.path}: the scanner has no angle between ranges or no range", "correct the first scan")
    times_ns = log.scans.times_ns
    sensor = Sensor(
        "laser0",
        SensorKind.LASER,
        "/scan",
        rate_hz(times_ns),
        _T_body_laser(log, scan),
        {"beams": scan.count, **layout.calibration()},
    )
    return laser_stream(sensor, log.scans, lambda: scan_ranges(log.path), scan.count)


def _T_body_laser(log: Log, scan: Scan) -> Matrix4:
    """Old logs state it as parameters, new ones as the poses of laser and robot at the time of a scan."""
    names = ("robot_frontlaser_offset", "robot_frontlaser_side_offset", "robot_frontlaser_angular_offset")
    x_m, y_m, yaw_rad = (_parameter(log, name) if name in log.parameters else 0.0 for name in names)
    if not any(name in log.parameters for name in names):
        (laser_x, laser_y, laser_yaw), (robot_x, robot_y, robot_yaw) = scan.laser_pose, scan.robot_pose
        yaw_rad = math.remainder(laser_yaw - robot_yaw, 2 * math.pi)
        c, s = math.cos(robot_yaw), math.sin(robot_yaw)
        x_m = c * (laser_x - robot_x) + s * (laser_y - robot_y)
        y_m = c * (laser_y - robot_y) - s * (laser_x - robot_x)
    return planar_transform(x_m, y_m, yaw_rad)


def _parameter(log: Log, name: str) -> float:
    try:
        value = float(log.parameters[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidInput(f"{log.path}: PARAM {name} {log.parameters[name][:40]!r} is no number", "correct it")
    return value


def _odometry(log: Log) -> Stream:
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
