"""Importers of KITTI: odometry sequences (Geiger, Lenz, Urtasun 2012), and its raw data, synchronised (IJRR 2013)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import CameraIntrinsics, LidarLayout, PointOrder, Rotation
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind, is_rigid
from slamhive.recordings.frame_files import read_image, read_velodyne
from slamhive.recordings.geometry import Array, flat, quaternions_from_rotations, rotation_xyz, transform
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    Loss,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    rate_hz,
)
from slamhive.recordings.rgbd import Frames, camera_stream, numbered, read_pose_table, rectified_intrinsics
from slamhive.recordings.streams import OVERHEAD_BYTES, gnss_stream, image_stream, imu_stream, point_stream
from slamhive.recordings.text_lists import read_lines
from slamhive.recordings.writers import NS_PER_S, BagWriter, nanoseconds
from slamhive.runtime.point_times import PointTimes, SweepInstant
from slamhive.trajectory.table import parse_table, read_bounded

# Reads the text files of a KITTI odometry sequence, and lists its frames.
#
# Layout: https://www.cvlibs.net/datasets/kitti/eval_odometry.php and the readme of its development kit.


TIMES_FILE, CALIBRATION_FILE, SCANS_FOLDER = "times.txt", "calib.txt", "velodyne"
POSE_FILES = ("poses.txt", "poses_kitti.txt", "poses_kitti_cam0.txt")
CAMERAS = (0, 1, 2, 3)
_ORTHONORMAL_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class KittiSequence:
    """One sequence: its text is read and checked, its frames are listed but not opened.

    ``projections`` holds P0..P3 (3, 4) of the cameras present, and ``images`` their frames. ``T_cam0_lidar`` (4, 4) is
    None without scans. ``poses`` (m, 3, 4) of camera 0 and ``pose_times_s`` (m,) are None without ground truth.
    """

    source: Path
    times_s: Array
    projections: dict[int, Array]
    images: dict[int, list[Path]]
    scans: list[Path]
    T_cam0_lidar: Array | None
    poses: Array | None
    pose_times_s: Array | None
    notes: tuple[str, ...] = ()


def detect_kitti(path: Path) -> Detection:
    """The parts of a KITTI odometry sequence in ``path``."""
    present = [name for name in (TIMES_FILE, CALIBRATION_FILE) if (path / name).is_file()]
    missing = [name for name in (TIMES_FILE, CALIBRATION_FILE) if name not in present]
    folders = [name for name in (*(f"image_{camera}" for camera in CAMERAS), SCANS_FOLDER) if (path / name).is_dir()]
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
    times_s, places = _read_times(source / TIMES_FILE)
    images = {camera: _frames(source / f"image_{camera}", "*.png", places) for camera in CAMERAS}
    images = {camera: frames for camera, frames in images.items() if frames}
    scans = _frames(source / SCANS_FOLDER, "*.bin", places)
    # Sensors with as many frames, but not the same ones, would share wrong times.
    sensors = [*images.values(), *([scans] if scans else [])]
    for other in sensors[1:]:
        for one, two in zip(sensors[0], other, strict=True):
            if one.stem.isdigit() and two.stem.isdigit() and int(one.stem) != int(two.stem):
                raise InvalidInput(
                    f"{one} and {two} would have the same line of {TIMES_FILE}",
                    "frames of all sensors must have the same numbers: complete the folders",
                )
    calibration = _read_calibration(source / CALIBRATION_FILE)
    T_cam0_lidar = None
    if scans:
        T_cam0_lidar = np.vstack([_entry(calibration, "Tr", source), [0.0, 0.0, 0.0, 1.0]])
    projections: dict[int, Array] = {}
    for camera in images:
        P = projections[camera] = _entry(calibration, f"P{camera}", source)
        if P[0, 0] <= 0 or P[1, 1] <= 0:
            raise InvalidInput(f"{source / CALIBRATION_FILE}: focal length of P{camera} is {P[0, 0]}, {P[1, 1]}")
    pose_places, poses = _read_poses(source, places) or (None, None)
    pose_times_s = None if pose_places is None else times_s[np.searchsorted(places, pose_places)]
    blank = int(places[-1]) + 1 - len(places)
    notes = (f"{blank} lines of {TIMES_FILE} are blank: these frames have no time and are left out",) if blank else ()
    return KittiSequence(source, times_s, projections, images, scans, T_cam0_lidar, poses, pose_times_s, notes)


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


def _read_times(path: Path) -> tuple[Array, Array]:
    """The times (n,) in s, and the frame of each, (n,): line n + 1 is that of frame n, blank lines too."""
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
    return times_s, table.places


def _frames(folder: Path, pattern: str, places: Array) -> list[Path]:
    """The frames in ``folder``, one of each of ``places`` (n,), or none if there is no such folder."""
    if not folder.is_dir():
        return []
    frames = visible_files(folder, pattern)
    if places[-1] + 1 != len(places):
        # Blank lines of the times leave frames out: the numbers of the files tell which.
        files = numbered(folder, pattern)
        missing = [place for place in places.tolist() if place not in files]
        if missing:
            raise InvalidInput(
                f"{folder} has no frame {missing[0]} ({pattern}), "
                f"but {TIMES_FILE} has its time in line {missing[0] + 1}",
                "line n + 1 is the time of frame n, from 0: complete the folder, or empty the line",
            )
        return [files[place] for place in places.tolist()]
    if len(frames) != len(places):
        raise InvalidInput(
            f"{folder} holds {len(frames)} frames ({pattern}), {TIMES_FILE} {len(places)} times",
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


def _read_poses(source: Path, places: Array) -> tuple[Array, Array] | None:
    """The poses (m, 3, 4) of frames that have a time, and these frames (m,), of ``places`` (n,); None without."""
    # In the sequence's folder, or in poses/<sequence>.txt beside it or beside sequences/.
    resolved = source.resolve()
    beside = [folder / "poses" / f"{resolved.name}.txt" for folder in resolved.parents[:2]]
    candidates = [*(source / name for name in POSE_FILES), *beside]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        return None
    table = parse_table(read_bounded(path), str(path), 12, "a 3x4 pose matrix by rows")
    poses = table.values.reshape(-1, 3, 4)
    if table.places[-1] != places[-1]:
        raise InvalidInput(
            f"{path} holds {len(poses)} poses in {table.places[-1] + 1} lines, {TIMES_FILE} {len(places)} times in "
            f"{places[-1] + 1}",
            "every frame needs its pose, in order",
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
    timed = np.isin(table.places, places)
    return table.places[timed], poses[timed]


_FIRST_COLOUR_CAMERA = 2


class KittiOdometryImporter:
    """Rectified grey and colour images, Velodyne scans, times, calibration and poses of camera 0 to a dataset.

    The body frame is that of camera 0. Scans of this benchmark are corrected for motion already and carry no time per
    point. Colour images (``image_2``, ``image_3``) become ``bgr8``, grey ones ``mono8``.
    """

    title = "KITTI odometry sequence: PNG images, Velodyne scans, calib.txt, times.txt, poses"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The parts of a sequence in ``path``."""
        return detect_kitti(path)

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """Plan the import of the sequence; raises InvalidInput naming the file, the line or frame, and the remedy."""
        sequence = read_sequence(source)
        streams = [_camera_stream(sequence, number) for number in sequence.images]
        lidar = _lidar(sequence)
        if lidar is not None:
            times_ns, scans = _times_ns(sequence), sequence.scans

            def write(bag: BagWriter, index: int) -> None:
                stamp_ns = int(times_ns[index])
                bag.points(lidar, stamp_ns, stamp_ns, read_velodyne(scans[index]))

            streams.append(
                PlannedStream(
                    lidar, times_ns, write, sum(path.stat().st_size for path in scans) // len(scans) + OVERHEAD_BYTES
                )
            )
        return ImportPlan(tuple(streams), _truth(sequence), _text(sequence), notes=sequence.notes)


def _camera_stream(sequence: KittiSequence, number: int) -> PlannedStream:
    """Intrinsics from P = K [I | t]; camera 0 sees x + t where camera ``number`` sees x, so it sits at -t."""
    P, paths = sequence.projections[number], sequence.images[number]
    encoding = "bgr8" if number >= _FIRST_COLOUR_CAMERA else "mono8"
    height, width = read_image(paths[0], encoding).shape[:2]
    intrinsics = CameraIntrinsics(
        width=int(width),
        height=int(height),
        fx=float(P[0, 0]),
        fy=float(P[1, 1]),
        cx=float(P[0, 2]),
        cy=float(P[1, 2]),
        distortion=(0.0, 0.0, 0.0, 0.0),
        rectified=True,
    )
    position_m = 0.0 - np.linalg.solve(P[:, :3], P[:, 3])
    sensor = Sensor(
        f"cam{number}",
        SensorKind.CAMERA,
        f"/cam{number}/image_raw",
        rate_hz(_times_ns(sequence)),
        tuple(float(value) for value in transform(np.eye(3), position_m).reshape(-1)),
        intrinsics.calibration(encoding),
    )
    return image_stream(sensor, _times_ns(sequence), paths, baseline_m=float(position_m[0]))


def _times_ns(sequence: KittiSequence) -> Array:
    return np.array([nanoseconds(float(time_s)) for time_s in sequence.times_s], dtype=np.int64)


def _lidar(sequence: KittiSequence) -> Sensor | None:
    """The Velodyne HDL-64E, its timestamp the instant it faced forward, when the cameras were triggered."""
    if sequence.T_cam0_lidar is None:
        return None
    return Sensor(
        "lidar0",
        SensorKind.LIDAR,
        "/points",
        rate_hz(_times_ns(sequence)),
        tuple(float(value) for value in sequence.T_cam0_lidar.reshape(-1)),
        velodyne_layout().calibration(),
    )


def _truth(sequence: KittiSequence) -> PlannedTruth | None:
    poses = sequence.poses
    if poses is None or sequence.pose_times_s is None:
        return None
    quats_xyzw = quaternions_from_rotations(poses[:, :, :3])
    return PlannedTruth(
        sequence.pose_times_s, poses[:, :, 3], quats_xyzw, gravity_aligned=False, source="GNSS and IMU (RTK)"
    )


def _text(sequence: KittiSequence) -> DatasetText:
    return DatasetText(
        title=f"KITTI odometry, {sequence.source.resolve().name}",
        description=f"{len(sequence.times_s)} frames of the KITTI odometry benchmark; the body is camera 0.",
        licence="CC BY-NC-SA 3.0",
        citation="Geiger, Lenz, Urtasun: Are we ready for autonomous driving? The KITTI benchmark suite. CVPR 2012",
        source="https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
        attributes=("real", "outdoor", "car"),
    )


# Importer of KITTI's raw data, synchronised (Geiger et al., "Vision meets robotics: The KITTI dataset", IJRR 2013).
#
# Layout and formulas: https://www.cvlibs.net/datasets/kitti/raw_data.php and the raw-data development kit.


_CAMERAS, _VELODYNE, _OXTS = ("image_00", "image_01", "image_02", "image_03"), "velodyne_points", "oxts"
_CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
_EARTH_RADIUS_M = 6378137.0
"""That of the development kit's Mercator projection (``latlonToMercator.m``)."""
_OXTS_COLUMNS = 30
_LAT, _LON, _ALT, _ROLL, _PITCH, _YAW = range(6)
_FORCE, _RATE = slice(11, 14), slice(17, 20)
"""``ax ay az`` and ``wx wy wz``: x forward, y left, z up."""


class KittiRawImporter:
    """Rectified images, Velodyne scans, IMU samples and poses from GNSS and IMU to a dataset; the body is the IMU.

    The IMU of the synchronised recordings has one sample a frame, 10 Hz. Scans carry no time per point.
    """

    title = "KITTI raw drive, synchronised: image_00 to image_03, velodyne_points, oxts, calib_*.txt"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The folders of the drive; calibration lies in it or beside it."""
        found = [name for name in (*_CAMERAS, _VELODYNE, _OXTS) if (path / name / "data").is_dir()]
        found += [name for name in _CALIBRATION if _calibration_file(path, name).is_file()]
        needed = (_OXTS, *_CALIBRATION)
        return Detection(tuple(found), tuple(name for name in needed if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """Plan the import of the drive; raises InvalidInput naming the file, the line or key, and the remedy."""
        notes: list[str] = ["timestamps are taken as UTC: the recordings do not say their time zone"]
        # From the IMU to the rectified camera 0: R_rect_00 · velo_to_cam · imu_to_velo.
        rectifying = transform(_calibration(source, _CALIBRATION[0])("R_rect_00", 9).reshape(3, 3), np.zeros(3))
        if not is_rigid(flat(rectifying)):
            raise InvalidInput(f"{_calibration_file(source, _CALIBRATION[0])}: R_rect_00 is no rotation")
        rectified_imu = np.asarray(rectifying @ _rigid(source, _CALIBRATION[1]) @ _rigid(source, _CALIBRATION[2]))
        streams: list[PlannedStream] = []
        for number, name in enumerate(_CAMERAS):
            if (source / name / "data").is_dir():
                streams.append(_camera(source, number, rectified_imu, notes))
        if (source / _VELODYNE / "data").is_dir():
            scan_times_ns, scans = clocked_files(source / _VELODYNE, "*.bin", notes)
            T_body_lidar = flat(np.linalg.inv(_rigid(source, _CALIBRATION[2])))
            layout = velodyne_layout().calibration()
            lidar = Sensor("lidar0", SensorKind.LIDAR, "/points", rate_hz(scan_times_ns), T_body_lidar, layout)
            streams.append(point_stream(lidar, scan_times_ns, scans, read_velodyne, 1.0))
        times_ns, files = clocked_files(source / _OXTS, "*.txt", notes)
        rows = np.array([read_packet(path) for path in files])
        streams.append(packet_imu(times_ns, rows))
        streams.append(packet_gnss(times_ns, rows))
        # Positions by Mercator projection scaled at the first latitude, relative to the first; z points up.
        scale = math.cos(math.radians(rows[0, _LAT]))
        x_m = scale * _EARTH_RADIUS_M * np.radians(rows[:, _LON])
        y_m = scale * _EARTH_RADIUS_M * np.log(np.tan(np.radians(90 + rows[:, _LAT]) / 2))
        positions_m = np.column_stack((x_m, y_m, rows[:, _ALT]))
        quats_xyzw = quaternions_from_rotations(rotation_xyz(rows[:, _ROLL], rows[:, _PITCH], rows[:, _YAW]))
        truth = PlannedTruth(
            times_ns / NS_PER_S,
            positions_m - positions_m[0],
            quats_xyzw,
            gravity_aligned=True,
            source="GNSS and IMU (RTK)",
        )
        notes.extend(matched_truth(truth, streams))
        return ImportPlan(
            tuple(streams),
            truth,
            DatasetText(
                title=f"KITTI raw, {source.resolve().name}",
                description="A synchronised drive of the KITTI raw data; the body is the IMU.",
                licence="CC BY-NC-SA 3.0",
                citation="Geiger, Lenz, Stiller, Urtasun: Vision meets robotics: The KITTI dataset. IJRR 2013",
                source="https://www.cvlibs.net/datasets/kitti/raw_data.php",
                attributes=("real", "outdoor", "car"),
            ),
            notes=tuple(notes),
        )


def _calibration_file(source: Path, name: str) -> Path:
    own = source / name
    return own if own.is_file() else source.resolve().parent / name


def _calibration(source: Path, name: str) -> Callable[[str, int], Array]:
    """A reader of a calibration file of the drive."""
    return keyed_numbers(_calibration_file(source, name))


def keyed_numbers(path: Path) -> Callable[[str, int], Array]:
    """A reader of ``KEY: numbers`` lines: the finite numbers (n,) of a key; it raises InvalidInput."""
    entries = dict(line.split(":", 1) for line in read_lines(path) if ":" in line)

    def numbers(key: str, count: int) -> Array:
        if key not in entries:
            raise InvalidInput(f"{path} lacks {key}", "take the file from the calibration of the same day")
        try:
            values = np.array(entries[key].split(), dtype=np.float64)
        except ValueError:
            raise InvalidInput(f"{path}: {key} is {entries[key].strip()[:60]!r}, no numbers") from None
        if values.shape != (count,) or not np.isfinite(values).all():
            raise InvalidInput(f"{path}: {key} has {values.size} numbers", f"expected {count} finite numbers")
        return values

    return numbers


def _rigid(source: Path, name: str) -> Array:
    numbers = _calibration(source, name)
    T = transform(numbers("R", 9).reshape(3, 3), numbers("T", 3))
    if not is_rigid(flat(T)):
        raise InvalidInput(f"{_calibration_file(source, name)}: R is no rotation", "copy the file again")
    return T


def _camera(source: Path, number: int, T_rectified_imu: Array, notes: list[str]) -> PlannedStream:
    """A rectified camera: P = K [I | t] sees x + t where camera 0 sees x, so it sits at -t."""
    P = _calibration(source, _CALIBRATION[0])(f"P_rect_{number:02d}", 12).reshape(3, 4)
    if not (0 < P[0, 0] < 1e6 and 0 < P[1, 1] < 1e6) or abs(np.linalg.det(P[:, :3])) < 1e-9:
        raise InvalidInput(f"P_rect_{number:02d} has focal lengths {P[0, 0]:g}, {P[1, 1]:g}", "copy the file again")
    times_ns, paths = clocked_files(source / f"image_{number:02d}", "*.png", notes)
    intrinsics = rectified_intrinsics(P, paths[0])
    position_m = 0.0 - np.linalg.solve(P[:, :3], P[:, 3])
    T_body_camera = np.linalg.inv(T_rectified_imu) @ transform(np.eye(3), position_m)
    frames = Frames(times_ns, paths)
    baseline_m = float(position_m[0])
    return camera_stream(f"cam{number}", frames, intrinsics, flat(T_body_camera), baseline_m=baseline_m)


def read_clock(path: Path) -> dict[int, int]:
    """{Number of a frame: its timestamp in ns since 1970}; line n + 1 of ``timestamps.txt`` is that of frame n.

    A blank line stands for a frame that was not recorded; the lines after it belong to the frames after it.
    """
    return {
        number: _clock_ns(line, f"{path}, line {number + 1}")
        for number, line in enumerate(read_lines(path))
        if line.strip()
    }


def clocked_files(folder: Path, pattern: str, notes: list[str], data: str = "data") -> tuple[Array, list[Path]]:
    """The files of a sensor in the folder ``data`` below ``folder``, with the timestamps (n,) in ns beside it.

    Files without a timestamp, and timestamps without a file, become losses in ``notes``.
    """
    path = folder / "timestamps.txt"
    times_ns = read_clock(path)
    there = numbered(folder / data, pattern)
    files = {number: file for number, file in there.items() if number in times_ns}
    if not files:
        raise InvalidInput(f"{folder / data} has no {pattern} with a line in {path.name}", "complete the folder")
    if len(files) < len(times_ns):
        missing = len(times_ns) - len(files)
        note = f"{missing} of the {len(times_ns)} files of {folder.name} are missing and left out"
        notes.append(Loss(missing, len(times_ns), note))
    if len(files) < len(there):
        untimed = len(there) - len(files)
        note = f"{untimed} files of {folder.name} have no time in {path.name} and are left out"
        notes.append(Loss(untimed, len(there), note))
    chosen = np.array([times_ns[number] for number in files], dtype=np.int64)
    late = np.flatnonzero(np.diff(chosen) <= 0)
    if len(late):
        line = list(files)[int(late[0]) + 1] + 1
        raise InvalidInput(f"{path}, line {line}: the timestamp is not after the one before", "times must increase")
    return chosen, list(files.values())


def _clock_ns(line: str, place: str) -> int:
    """``2011-09-26 13:02:25.951199337`` in ns since 1970."""
    clock, _, fraction = line.strip().partition(".")
    try:
        moment = datetime.strptime(clock, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        time_ns = int(moment.timestamp()) * NS_PER_S + int(fraction[:9].ljust(9, "0"))
    except ValueError:
        time_ns = -1
    if not 0 <= time_ns < 2**31 * NS_PER_S:
        raise InvalidInput(f"{place}: {line[:40]!r} is no time", "expected 2011-09-26 13:02:25.951199337") from None
    return time_ns


def read_packet(path: Path) -> Array:
    """The 30 numbers of a packet of the GNSS and IMU unit; raises InvalidInput."""
    values: Array = read_pose_table(path, _OXTS_COLUMNS, "30 numbers of a GNSS and IMU packet")[0]
    if not np.isfinite(values).all() or abs(values[_LAT]) >= 89 or np.abs(values[:20]).max() > 1e6:
        raise InvalidInput(f"{path}: its numbers make no sense", "copy the file again")
    return values


def packet_imu(times_ns: Array, rows: Array, T_body_imu: Matrix4 = IDENTITY4) -> PlannedStream:
    """Angular rates and accelerations of the packets."""
    sensor = Sensor("imu0", SensorKind.IMU, "/imu0", rate_hz(times_ns), T_body_imu)
    return imu_stream(sensor, times_ns, np.column_stack((rows[:, _RATE], rows[:, _FORCE])))


def packet_gnss(times_ns: Array, rows: Array) -> PlannedStream:
    """Latitude, longitude and altitude of the IMU, to which the receiver's positions are reduced."""
    sensor = Sensor("gnss0", SensorKind.GNSS, "/gnss0", rate_hz(times_ns))
    return gnss_stream(sensor, times_ns, rows[:, _LAT : _ALT + 1])
