"""Reads the text files of a KITTI odometry sequence, and lists its frames.

Layout: https://www.cvlibs.net/datasets/kitti/eval_odometry.php and the readme of its development kit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.bags.detection import Detection
from slamhive.bags.geometry import Array
from slamhive.domain.lidar_layout import LidarLayout, PointOrder, Rotation
from slamhive.errors import InvalidInput
from slamhive.runtime.point_times import PointTimes, SweepInstant
from slamhive.trajectory.table import parse_table, read_bounded

TIMES_FILE, CALIBRATION_FILE, SCANS_FOLDER = "times.txt", "calib.txt", "velodyne"
POSE_FILES = ("poses.txt", "poses_kitti.txt", "poses_kitti_cam0.txt")
CAMERAS = (0, 1, 2, 3)
_ORTHONORMAL_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class KittiSequence:
    """One sequence: its text is read and checked, its frames are listed but not opened.

    ``projections`` holds P0..P3 (3, 4) of the cameras present, and ``images`` their frames. ``T_cam0_lidar`` (4, 4) is
    None without scans. ``poses`` (n, 3, 4) of camera 0 are None without ground truth.
    """

    source: Path
    times_s: Array
    projections: dict[int, Array]
    images: dict[int, list[Path]]
    scans: list[Path]
    T_cam0_lidar: Array | None
    poses: Array | None


def detect_kitti(path: Path) -> Detection:
    """The parts of a KITTI odometry sequence in ``path``."""
    present = [name for name in (TIMES_FILE, CALIBRATION_FILE) if (path / name).is_file()]
    missing = [name for name in (TIMES_FILE, CALIBRATION_FILE) if name not in present]
    folders = [name for name in _sensor_folders() if (path / name).is_dir()]
    if not folders:
        missing.append("image_0 to image_3 or velodyne")
    return Detection(tuple(present + folders), tuple(missing))


def read_sequence(source: Path) -> KittiSequence:
    """Read and check everything but the frames themselves; raises InvalidInput naming file, line, value and remedy."""
    detection = detect_kitti(source)
    if detection.missing:
        raise InvalidInput(
            f"{source} is no KITTI odometry sequence: it lacks {', '.join(detection.missing)}",
            "give the folder that holds times.txt, calib.txt and image_0 (or velodyne)",
        )
    times_s = _read_times(source / TIMES_FILE)
    images = {camera: _frames(source / f"image_{camera}", "*.png", times_s) for camera in CAMERAS}
    images = {camera: frames for camera, frames in images.items() if frames}
    scans = _frames(source / SCANS_FOLDER, "*.bin", times_s)
    calibration = _read_calibration(source / CALIBRATION_FILE)
    T_cam0_lidar = None
    if scans:
        T_cam0_lidar = np.vstack([_entry(calibration, "Tr", source), [0.0, 0.0, 0.0, 1.0]])
    projections = {camera: _projection(calibration, camera, source) for camera in images}
    return KittiSequence(source, times_s, projections, images, scans, T_cam0_lidar, _read_poses(source, len(times_s)))


def velodyne_layout() -> LidarLayout:
    """The points of KITTI's Velodyne HDL-64E: their timestamp is the instant at which it faced forward.

    It turns counter-clockwise (Geiger et al., IJRR 2013). The elevations are those of the 64 rows of points in the
    scans of sequence 00. They are 0.4 to 0.6 degrees above those of the data sheet.
    """
    return LidarLayout(
        PointTimes(scan_duration_s=0.1, stamp=SweepInstant.MIDDLE),
        point_order=PointOrder.ROWS,
        beams=64,
        minimum_range_m=0.9,
        maximum_range_m=120.0,
        vertical_angles_deg=(*_evenly(-23.75, -8.4), *_evenly(-7.76, 2.6)),
        rotation=Rotation.COUNTER_CLOCKWISE,
    )


def _evenly(lowest_deg: float, highest_deg: float) -> tuple[float, ...]:
    """The elevations of a block of 32 lasers, the lowest first."""
    return tuple(np.linspace(lowest_deg, highest_deg, 32).round(2).tolist())


def _sensor_folders() -> tuple[str, ...]:
    return (*(f"image_{camera}" for camera in CAMERAS), SCANS_FOLDER)


def _read_times(path: Path) -> Array:
    table = parse_table(read_bounded(path), str(path), 1, "seconds since the start, one a line")
    times_s: Array = table.values[:, 0]
    bad = np.flatnonzero(~np.isfinite(times_s) | (times_s < 0))
    if len(bad):
        raise table.error(int(bad[0]), f"time {times_s[bad[0]]} s", "expected seconds since the start, 0 or more")
    late = np.flatnonzero(np.diff(times_s) <= 0)
    if len(late):
        row = int(late[0]) + 1
        raise table.error(
            row, f"time {times_s[row]} s is not after the one before, {times_s[row - 1]} s", "times must increase"
        )
    if len(times_s) < 2:
        raise InvalidInput(f"{path} holds {len(times_s)} time", "at least two frames are needed")
    return times_s


def _frames(folder: Path, pattern: str, times_s: Array) -> list[Path]:
    """The frames in ``folder``, as many as there are times, or none if there is no such folder."""
    if not folder.is_dir():
        return []
    frames = sorted(folder.glob(pattern))
    if len(frames) != len(times_s):
        raise InvalidInput(
            f"{folder} holds {len(frames)} frames ({pattern}), {TIMES_FILE} {len(times_s)} times",
            f"every frame needs its line in {TIMES_FILE}: cut the longer one, or complete the shorter",
        )
    return frames


def _read_calibration(path: Path) -> dict[str, Array]:
    entries: dict[str, Array] = {}
    text = read_bounded(path).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        key, colon, rest = line.partition(":")
        if not line.strip():
            continue
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            raise InvalidInput(f"{path}, line {number}: {rest.strip()[:40]!r} are no numbers") from None
        if not colon or len(values) != 12 or not np.isfinite(values).all():
            raise InvalidInput(
                f"{path}, line {number}: found {len(values)} numbers for {key.strip()[:20]!r}",
                "expected 'P0: ' to 'P3: ' and 'Tr: ', each with 12 finite numbers, a 3x4 matrix by rows",
            )
        entries[key.strip()] = values.reshape(3, 4)
    return entries


def _entry(calibration: dict[str, Array], key: str, source: Path) -> Array:
    try:
        return calibration[key]
    except KeyError:
        raise InvalidInput(
            f"{source / CALIBRATION_FILE} lacks {key} (found {', '.join(calibration) or 'nothing'})",
            f"add the line '{key}: ' with the 12 numbers from the sequence's calibration",
        ) from None


def _projection(calibration: dict[str, Array], camera: int, source: Path) -> Array:
    P = _entry(calibration, f"P{camera}", source)
    if P[0, 0] <= 0 or P[1, 1] <= 0:
        raise InvalidInput(f"{source / CALIBRATION_FILE}: focal length of P{camera} is {P[0, 0]}, {P[1, 1]}")
    return P


def _read_poses(source: Path, count: int) -> Array | None:
    path = _pose_file(source)
    if path is None:
        return None
    table = parse_table(read_bounded(path), str(path), 12, "a 3x4 pose matrix by rows")
    poses = table.values.reshape(-1, 3, 4)
    if len(poses) != count:
        raise InvalidInput(
            f"{path} holds {len(poses)} poses, {TIMES_FILE} {count} times", "every frame needs its pose, in order"
        )
    broken = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if len(broken):
        raise table.error(int(broken[0]), "a number that is not finite", "remove the poses file, or repair the line")
    R = poses[:, :, :3]
    deviation = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    skewed = np.flatnonzero((deviation > _ORTHONORMAL_TOLERANCE) | (np.linalg.det(R) < 0))
    if len(skewed):
        row = int(skewed[0])
        raise table.error(
            row, f"no rotation matrix (R Rᵀ differs from 1 by {deviation[row]:.3g})", "expected 3x4 poses [R|t] by rows"
        )
    return poses


def _pose_file(source: Path) -> Path | None:
    """In the sequence's folder, or in ``poses/<sequence>.txt`` beside it or beside ``sequences/``."""
    resolved = source.resolve()
    beside = [folder / "poses" / f"{resolved.name}.txt" for folder in resolved.parents[:2]]
    candidates = [*(source / name for name in POSE_FILES), *beside]
    return next((path for path in candidates if path.is_file()), None)
