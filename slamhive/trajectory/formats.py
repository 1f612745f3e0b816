"""Formats of trajectories by name, with the systems and datasets that write them.

Rows with a time, a position and a quaternion are found by their columns (see :mod:`slamhive.trajectory.pose_file`). The
other formats have a reader here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.trajectory.kitti import pair_with_times
from slamhive.trajectory.layout import Convention, QuaternionOrder, RawPoses, TimeUnit, stated_in
from slamhive.trajectory.model import QUATERNION_TOLERANCE, FloatArray, find_problem
from slamhive.trajectory.table import (
    IntArray,
    NumberTable,
    parse_table,
    read_bounded,
    text_lines,
)
from slamhive.trajectory.transforms import quats_from_rotations

Reader = Callable[[bytes, str, Path | None], RawPoses]
"""Makes poses of the bytes of a file, what messages call it, and the file of the timestamps if there is one."""

_HEAD_BYTES = 100_000
_ROWS_LOOKED_AT = 20
_ORTHOGONAL = 1e-2
_FIRST_MICROSECONDS = 1e14
_FIRST_TIME = 1e9
"""Smaller numbers in the place of a time are numbers of frames, or keys of vertices."""
_SYMBOL_SHIFT = 56
"""GTSAM's ``Symbol``: a letter in the upper byte, and a number."""
_INDEX_MASK = (1 << _SYMBOL_SHIFT) - 1
_UP = np.diag([1.0, -1.0, -1.0])
"""From x forward, y right, z down to x forward, y left, z up."""
_POSE_FILE = re.compile(r"\D*(\d{1,9})\.pose\.txt")
_MOST_POSE_FILES = 200_000
_LARGEST_POSE_FILE = 10_000


@dataclass(frozen=True, slots=True)
class PoseFormat:
    """A format of trajectories.

    Attributes:
        name: What ``--format`` calls it, or what it is called here only.
        systems: Which systems and datasets write it.
        content: What a row, or the file, holds.
        columns: The numbers of columns of formats that are found by those; empty for the others.
        recognise: Whether the bytes of a file are in it; None for those that are found by their columns.
        read: Makes poses of it.
        own_times: The file has timestamps.
    """

    name: str
    systems: str
    content: str
    columns: tuple[int, ...] = ()
    recognise: Callable[[bytes], bool] | None = None
    read: Reader | None = None
    own_times: bool = True


def find_format(data: bytes) -> PoseFormat | None:
    """The format with its own reader that the bytes are in, None if there is none."""
    return next((entry for entry in FORMATS if entry.recognise is not None and entry.recognise(data)), None)


def format_named(name: str) -> PoseFormat | None:
    """The format with its own reader called ``name``."""
    return next((entry for entry in FORMATS if entry.name == name and entry.read is not None), None)


def systems_by_columns() -> dict[int, str]:
    """Systems that write rows of so many columns, for messages."""
    found: dict[int, list[str]] = {}
    for entry in FORMATS:
        for count in entry.columns:
            found.setdefault(count, []).append(entry.systems)
    return {count: "; ".join(systems) for count, systems in sorted(found.items())}


def refuse_keys(times: FloatArray, name: str) -> None:
    """Raise InvalidInput if the times are keys of GTSAM's, as pose graphs have them."""
    letters = times / float(1 << _SYMBOL_SHIFT)
    if len(times) and ((letters >= ord("A")) & (letters < ord("z") + 1)).all():
        raise InvalidInput(
            f"{name}: its timestamps are keys of a pose graph, such as {chr(int(letters[0]))}0, as GTSAM and g2o write "
            "them",
            "write the time of each pose in place of its key, or give the g2o file and the timestamps (--times)",
        )


def pose_files(folder: Path) -> list[tuple[int, Path]]:
    """The files ``frame-000000.pose.txt`` in a folder, by number, as BundleFusion and 7-Scenes write them."""
    found = ((_POSE_FILE.fullmatch(file.name), file) for file in visible_files(folder, "*.pose.txt"))
    return sorted((int(match[1]), file) for match, file in found if match is not None)


def read_pose_folder(folder: Path, times: Path | None) -> tuple[bytes, RawPoses]:
    """The text of all poses of a folder, and the poses; raises InvalidInput, also without timestamps.

    A frame whose pose is not finite is one that the system lost: it is left out.
    """
    files = pose_files(folder)
    if not 0 < len(files) <= _MOST_POSE_FILES:
        raise InvalidInput(
            f"{folder} holds {len(files)} files NAME-000000.pose.txt", "give the folder of one recording"
        )
    numbers, rows, texts = [], [], []
    for number, file in files:
        if file.stat().st_size > _LARGEST_POSE_FILE:
            raise InvalidInput(f"{file} has more than {_LARGEST_POSE_FILE:,} bytes", "a pose is a 4x4 matrix")
        data = read_bounded(file)
        matrix = parse_table(data, str(file), 4, "4 rows of 4 numbers").values
        if matrix.shape != (4, 4):
            raise InvalidInput(f"{file} holds {len(matrix)} rows", "expected 4 rows of 4 numbers")
        if np.isfinite(matrix).all():
            numbers.append(number)
            rows.append(matrix.reshape(-1))
            texts.append(data)
    if not rows:
        raise InvalidInput(f"{folder} holds no pose that is finite", "give a folder with poses")
    lines = b"\n".join(b" ".join(data.split()) for data in texts) + b"\n"
    table = NumberTable(str(folder), np.array(rows), lines)
    return b"\n".join(texts), _of_matrices(table, np.array(numbers), times, "BundleFusion")


def _of_matrices(table: NumberTable, places: IntArray, times: Path | None, system: str) -> RawPoses:
    """The poses of rows of 4x4 matrices, whose times are those of their places in the file of the timestamps."""
    matrices = table.values.reshape(-1, 4, 4)
    R = matrices[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = ~(errors < _ORTHOGONAL) | (np.linalg.det(R) < 0) | ~np.isfinite(matrices).all(axis=(1, 2))
    if wrong.any():
        raise table.error(int(wrong.argmax()), "the 3x3 part is not a rotation", "write orthonormal matrices")
    return _timed_by_places(table, places, times, system, (matrices[:, :3, 3], quats_from_rotations(R)))


def _timed_by_places(
    table: NumberTable, places: IntArray, times: Path | None, system: str, poses: tuple[FloatArray, FloatArray]
) -> RawPoses:
    """Poses, positions and quaternions x y z w, whose times are those of their places in the file of the timestamps."""
    positions_m, quats_xyzw = poses
    problem = find_problem(np.arange(len(places), dtype=np.float64), positions_m, quats_xyzw)
    if problem is not None:
        raise table.error(problem.index, problem.found, problem.remedy)
    kept, stamps, unit = pair_with_times(table.name, places, times, system)
    stated = Convention(unit, QuaternionOrder.XYZW)
    return RawPoses(stamps, stamps.values[:, 0], positions_m[kept], quats_xyzw[kept], stated=stated)


def _made(
    table: NumberTable, times: FloatArray, positions_m: FloatArray, R: FloatArray, unit: TimeUnit | None
) -> RawPoses:
    stated = Convention(unit, QuaternionOrder.XYZW)
    return RawPoses(table, times, positions_m, quats_from_rotations(R), stated=stated)


def _turn(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Rz(yaw) Ry(pitch) Rx(roll), shape (n, 3, 3)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - as in transforms.py

    return np.asarray(Rotation.from_euler("ZYX", np.column_stack((yaw, pitch, roll))).as_matrix())


def _numbers(data: bytes, columns: int) -> FloatArray:
    """The first rows (n, columns) of a table, without rows if it is none."""
    try:
        head = b"\n".join(data[:_HEAD_BYTES].splitlines()[: _ROWS_LOOKED_AT * 2])
        return parse_table(head, "", columns, "").values[:_ROWS_LOOKED_AT]
    except InvalidInput:
        return np.empty((0, columns))


def _finite(table: NumberTable) -> NumberTable:
    """The rows without NaN: loggers begin before there is a solution."""
    kept = np.flatnonzero(np.isfinite(table.values).all(axis=1))
    if not len(kept):
        raise InvalidInput(f"{table.name} has no finite row", "copy or download the file again")
    return table.take(kept)


def _is_colmap(data: bytes) -> bool:
    head = data[:_HEAD_BYTES]
    if re.search(rb"^#\s+IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", head, re.MULTILINE):
        return True
    lines = [line.split() for line in head.splitlines() if line.strip() and not line.lstrip().startswith(b"#")]
    return bool(lines) and len(lines[0]) >= 10 and _is_image(lines[0])


def _is_image(words: Sequence[bytes]) -> bool:
    """Return whether a line is ``id qw qx qy qz tx ty tz camera name``."""
    try:
        quat = np.array([float(word) for word in words[1:5]])
        int(words[0]), int(words[8])
        [float(word) for word in words[5:8]]
    except (ValueError, IndexError):
        return False
    named = re.fullmatch(rb".+\.[A-Za-z]{2,4}", words[-1]) is not None
    return named and abs(float(np.linalg.norm(quat)) - 1) <= QUATERNION_TOLERANCE


def _read_colmap(data: bytes, name: str, times: Path | None) -> RawPoses:
    """COLMAP's ``images.txt``: T_camera_world of each image, every second line holds its points."""
    rows, taken, names = [], [], []
    row, points = 0, False
    for line in text_lines(data, name, "two lines for each image"):
        text = line.strip()
        if text.startswith("#"):
            continue
        row += bool(text)
        if points or not text:
            points = False
            continue
        words = text.split(maxsplit=9)
        if len(words) < 10 or not _is_image([word.encode() for word in words]):
            where = NumberTable(name, np.empty((0, 0)), data, np.array([row - 1]))
            raise where.error(0, f"{text[:40]!r} is no image", "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        rows.append([float(word) for word in words[1:8]])
        taken.append(row - 1)
        names.append(words[9])
        points = True
    if not rows:
        raise InvalidInput(f"{name} holds no image", "give the images.txt of a COLMAP model")
    table = NumberTable(name, np.array(rows), data, np.array(taken))
    numbers = [re.findall(r"\d+(?:\.\d+)?", Path(text).stem) for text in names]
    lacking = next((text for text, found in zip(names, numbers, strict=True) if not found), None)
    if lacking is not None:
        raise InvalidInput(f"{name}: image {lacking[:80]!r} has no number in its name", "name images by their time")
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - as in transforms.py

    R_world_camera = Rotation.from_quat(np.roll(table.values[:, :4], -1, axis=1)).inv()
    poses = -R_world_camera.apply(table.values[:, 4:7]), np.asarray(R_world_camera.as_quat())
    return _timed_by_keys(table, [found[-1] for found in numbers], times, "COLMAP", poses)


def _timed_by_keys(
    table: NumberTable, keys: Sequence[str], times: Path | None, system: str, poses: tuple[FloatArray, FloatArray]
) -> RawPoses:
    """Poses whose keys are times, or numbers of frames, which are lines of the file of the timestamps."""
    values = np.array([float(key) for key in keys])
    order = np.argsort(values, kind="stable")
    table, values, poses = table.take(order), values[order], (poses[0][order], poses[1][order])
    if times is None and (values >= _FIRST_TIME).all() and (values < (ord("A") << _SYMBOL_SHIFT)).all():
        return RawPoses(table, values, *poses, stated=Convention(None, QuaternionOrder.XYZW))
    numbers = np.array([int(keys[index].partition(".")[0]) & _INDEX_MASK for index in order], dtype=np.int64)
    return _timed_by_places(table, numbers, times, system, poses)


def _is_g2o(data: bytes) -> bool:
    return re.search(rb"^(?:VERTEX|EDGE)_[A-Z0-9_:]+\s", data[:_HEAD_BYTES], re.MULTILINE) is not None


def _read_g2o(data: bytes, name: str, times: Path | None) -> RawPoses:
    """The vertices of a g2o file, SE(3) as ``id x y z qx qy qz qw`` or SE(2) as ``id x y theta``."""
    rows: list[list[float]] = []
    taken: list[int] = []
    keys: list[str] = []
    row = -1
    for line in text_lines(data, name, "VERTEX_SE3:QUAT id x y z qx qy qz qw"):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        row += 1
        wanted = {"VERTEX_SE3:QUAT": 9, "VERTEX_SE2": 5}.get(words[0])
        if wanted is None:
            continue
        try:
            numbers = [float(word) for word in words[2:wanted]]
            known = int(words[1]) >= 0 and len(numbers) == wanted - 2
        except (ValueError, IndexError):
            known = False
        if not known or len(words[1]) > len(str(1 << 64)):
            where = NumberTable(name, np.empty((0, 0)), data, np.array([row]))
            raise where.error(0, f"{line.strip()[:40]!r} is no vertex", f"expected {wanted - 1} numbers, the key first")
        if words[0] == "VERTEX_SE2":
            x, y, theta = numbers
            numbers = [x, y, 0.0, 0.0, 0.0, float(np.sin(theta / 2)), float(np.cos(theta / 2))]
        rows.append(numbers)
        taken.append(row)
        keys.append(words[1])
    if not rows:
        raise InvalidInput(
            f"{name} holds no vertex that is a pose", "give the g2o file with VERTEX_SE3:QUAT or VERTEX_SE2"
        )
    table = NumberTable(name, np.array(rows), data, np.array(taken))
    return _timed_by_keys(table, keys, times, "g2o", (table.values[:, :3], table.values[:, 3:]))


def _is_nclt(data: bytes) -> bool:
    rows = _numbers(data, 7)
    return bool(len(rows)) and bool((rows[:, 0] >= _FIRST_MICROSECONDS).all() and (rows[:, 0] < 1e17).all())


def _read_nclt(data: bytes, name: str, _times: Path | None) -> RawPoses:
    """NCLT: utime, x, y, z in m, roll, pitch, heading in rad; z down. As the importer of NCLT, z is turned up."""
    table = _finite(parse_table(data, name, 7, "utime, x, y, z, roll, pitch, heading"))
    values = table.values
    R = _UP @ _turn(*values[:, 4:7].T) @ _UP
    return _made(table, values[:, 0], values[:, 1:4] @ _UP, R, TimeUnit.US)


_BOREAS = ("easting", "northing", "altitude", "roll", "pitch", "heading")


def _is_boreas(data: bytes) -> bool:
    return all(name in _head_names(data) for name in _BOREAS)


def _head_names(data: bytes) -> list[str]:
    first = data[:_HEAD_BYTES].removeprefix(b"\xef\xbb\xbf").lstrip(b"# \t\r\n").partition(b"\n")[0]
    return [word.strip() for word in first.decode("utf-8", errors="replace").split(",")]


def _read_boreas(data: bytes, name: str, _times: Path | None) -> RawPoses:
    """Boreas: ``GPSTime,easting,northing,altitude,...,roll,pitch,heading,...``; rotations as its own tools make them.

    R_enu_sensor = Rx(-roll) Ry(-pitch) Rz(-heading): each factor of ``yawPitchRollToRot`` of pyboreas is transposed.
    """
    names = _head_names(data)
    if not all(column in names for column in _BOREAS):
        raise InvalidInput(f"{name} has no header with {', '.join(_BOREAS)}", "give the CSV of poses of Boreas")
    rows = data.partition(b"\n")[2] if not data.lstrip().startswith(b"#") else data
    # the header counts as a line of the file
    table = _finite(parse_table(b"#\n" + rows, name, len(names), ", ".join(names)))
    values = table.values
    place = {column: names.index(column) for column in _BOREAS}
    angles = [values[:, place[column]] for column in ("roll", "pitch", "heading")]
    R = _turn(*angles).transpose(0, 2, 1)
    # (Rz Ry Rx)^T = Rx^T Ry^T Rz^T
    positions_m = values[:, [place[column] for column in _BOREAS[:3]]]
    return _made(table, values[:, 0], positions_m, R, stated_in(data).time_unit)


def _is_nuscenes(data: bytes) -> bool:
    head = data[:_HEAD_BYTES].lstrip()
    return head[:1] == b"[" and all(key in head for key in (b'"timestamp"', b'"rotation"', b'"translation"'))


def _read_nuscenes(data: bytes, name: str, _times: Path | None) -> RawPoses:
    """``ego_pose.json`` of nuScenes: timestamp in us, rotation w x y z and translation of each record."""
    try:
        records = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InvalidInput(f"{name} is no JSON: {str(error)[:80]}", "give the ego_pose.json of nuScenes") from None
    rows: list[tuple[float, ...]] = []
    for number, record in enumerate(records if isinstance(records, list) else [records], start=1):
        try:
            numbers = [record["timestamp"], *record["translation"], *record["rotation"]]
            row = tuple(float(value) for value in numbers)
        except (TypeError, KeyError, ValueError, OverflowError):
            row = ()
        if len(row) != 8:
            raise InvalidInput(f"{name}: record {number} lacks timestamp, translation or rotation", "copy it again")
        rows.append(row)
    if not rows:
        raise InvalidInput(f"{name} holds no pose", "give the ego_pose.json of nuScenes")
    values = np.array(sorted(rows), dtype=np.float64)
    # several sensors share a timestamp, and then a pose
    kept = np.flatnonzero(np.diff(values[:, 0], prepend=-np.inf) > 0)
    values = values[kept]
    text = b"\n".join(b"-" for _ in values)
    table = NumberTable(f"{name}, records by time", values, text)
    quats_xyzw = np.roll(values[:, 4:8], -1, axis=1)
    stated = Convention(TimeUnit.US, QuaternionOrder.XYZW)
    return RawPoses(table, values[:, 0], values[:, 1:4], quats_xyzw, stated=stated)


def _is_replica(data: bytes) -> bool:
    rows = _numbers(data, 16)
    return bool(len(rows)) and bool((rows[:, 12:] == [0, 0, 0, 1]).all())


def _read_replica(data: bytes, name: str, times: Path | None) -> RawPoses:
    """Rows of 16 numbers, T_world_camera by rows."""
    table = parse_table(data, name, 16, "16 numbers, a 4x4 matrix by rows")
    return _of_matrices(table, table.places, times, "Replica")


def _is_tartanair(data: bytes) -> bool:
    rows = _numbers(data, 7)
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(len(rows)) and bool((np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1) <= QUATERNION_TOLERANCE).all())


def _read_tartanair(data: bytes, name: str, times: Path | None) -> RawPoses:
    """Rows of position and quaternion x y z w, one for each frame."""
    table = parse_table(data, name, 7, "x y z qx qy qz qw")
    return _timed_by_places(table, table.places, times, "TartanAir", (table.values[:, :3], table.values[:, 3:]))


def _is_fast_lio(data: bytes) -> bool:
    rows = _numbers(data, 25)
    # omega and acceleration are written as 0
    return len(rows) > 1 and not rows[:, [7, 8, 9, 13, 14, 15]].any() and bool((np.diff(rows[:, 0]) > 0).all())


def _read_fast_lio(data: bytes, name: str, _times: Path | None) -> RawPoses:
    """FAST-LIO's ``pos_log.txt``: time after the first scan, rotation vector, position, and what else its state has."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - as in transforms.py

    table = _finite(parse_table(data, name, 25, "time, rotation vector, position and 18 more"))
    R = np.asarray(Rotation.from_rotvec(table.values[:, 1:4]).as_matrix())
    return _made(table, table.values[:, 0], table.values[:, 4:7], R, TimeUnit.S)


FORMATS: tuple[PoseFormat, ...] = (
    PoseFormat("tum", "TUM files, Basalt, GLIM, ORB-SLAM3, KISS-ICP, LIO-SAM", "t x y z qx qy qz qw", (8,)),
    PoseFormat("kimera", "Kimera", "timestamp in ns, x y z, qw qx qy qz, and more, by names"),
    PoseFormat("rtab-map", "RTAB-Map with an id", "t x y z qx qy qz qw id", (9,)),
    PoseFormat("vins", "VINS-Mono and VINS-Fusion with velocities", "t x y z qw qx qy qz and a velocity", (11,)),
    PoseFormat("kitti-timed", "KITTI poses after a timestamp, MulRan", "t and 12 numbers of a matrix", (13,)),
    PoseFormat("openvins", "OpenVINS with standard deviations", "t x y z qx qy qz qw and 6 more", (14,)),
    PoseFormat("openvins-covariances", "OpenVINS with covariances", "t x y z qx qy qz qw and 12 more", (20,)),
    PoseFormat("euroc", "EuRoC, OKVIS2", "t in ns, x y z, qw qx qy qz, and 9 more", (17,)),
    PoseFormat("kitti", "KITTI", "12 numbers of a matrix, no time", own_times=False),
    PoseFormat("colmap", "COLMAP", "`images.txt`", recognise=_is_colmap, read=_read_colmap, own_times=False),
    PoseFormat(
        "g2o", "g2o, GTSAM, SE-Sync", "vertices, no time", recognise=_is_g2o, read=_read_g2o, own_times=False
    ),
    PoseFormat("boreas", "Boreas", "CSV with easting, northing, altitude", recognise=_is_boreas, read=_read_boreas),
    PoseFormat("nuscenes", "nuScenes", "`ego_pose.json`", recognise=_is_nuscenes, read=_read_nuscenes),
    PoseFormat("nclt", "NCLT", "t in us, x y z, roll pitch heading", recognise=_is_nclt, read=_read_nclt),
    PoseFormat(
        "tartanair", "TartanAir, DROID-SLAM", "x y z qx qy qz qw, no time",
        recognise=_is_tartanair, read=_read_tartanair, own_times=False,
    ),
    PoseFormat(
        "replica", "Replica, NICE-SLAM", "16 numbers of a matrix, no time",
        recognise=_is_replica, read=_read_replica, own_times=False,
    ),
    PoseFormat("fast-lio", "FAST-LIO", "`pos_log.txt`", recognise=_is_fast_lio, read=_read_fast_lio),
    PoseFormat(
        "pose-folder", "BundleFusion, 7-Scenes", "a folder of `frame-000000.pose.txt`, no time", own_times=False
    ),
)  # fmt: skip
"""All formats that are known."""
