"""Every injected fault is found by its own check, and nothing unrelated is called an error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.domain.dataset import CheckReport, Severity
from slamhive.recordings.geometry import rotation_xyz
from tests.checks.faulty_rooms import (
    CAM1,
    DEPTH,
    IMU,
    LIDAR,
    WIDTH,
    Room,
    altered,
    header_ns,
    on,
    pixels_of,
    render,
    stamped,
    turned_imu,
    with_pixels,
    with_points,
)

pytestmark = pytest.mark.integration

S = 10**9
QUARTER_TURN = rotation_xyz(0.0, 0.0, np.pi / 2)
UNTURNED = np.eye(3)


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    return render(tmp_path_factory.mktemp("checked"))


def test_a_sound_recording_has_no_findings(room: Room, tmp_path: Path):
    report = room.check(tmp_path)
    assert report.findings == ()
    assert report.not_checked == ()


# Each fault returns what is changed: a recording, a ground truth or a dataset.


def gap(room: Room) -> dict[str, Any]:
    start_ns = room.messages[0][1]
    return {"recording": on(room, IMU, lambda _, t, m: [] if 1.5 * S < t - start_ns < 1.8 * S else [(t, m)])}


def clock_jump(room: Room) -> dict[str, Any]:
    return {"recording": on(room, IMU, lambda i, t, m: [(t, stamped(m, header_ns(m) + (10 * S if i > 400 else 0)))])}


def clock_drift(room: Room) -> dict[str, Any]:
    return {"recording": on(room, LIDAR, lambda i, t, m: [(t, stamped(m, header_ns(m) - i * 10_000_000))])}


def clock_offset(room: Room) -> dict[str, Any]:
    return {"recording": on(room, CAM1, lambda _, t, m: [(t, stamped(m, header_ns(m) - 2 * S))])}


def out_of_order(room: Room) -> dict[str, Any]:
    return {
        "recording": on(room, IMU, lambda i, t, m: [(t, stamped(m, header_ns(m) - (12_000_000 if i == 300 else 0)))])
    }


def duplicate(room: Room) -> dict[str, Any]:
    return {"recording": on(room, IMU, lambda i, t, m: [(t, m)] * (2 if i % 100 == 50 else 1))}


def zero_stamps(room: Room) -> dict[str, Any]:
    return {"recording": on(room, LIDAR, lambda _, t, m: [(t, stamped(m, 0))])}


def early_end(room: Room) -> dict[str, Any]:
    return {"recording": on(room, LIDAR, lambda i, t, m: [(t, m)] if i < 20 else [])}


def wrong_rate(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "imu0", rate_hz=100.0)}


def absent_topic(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "lidar0", topic="/velodyne_points")}


def wrong_type(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "lidar0", topic="/cam0/camera_info")}


def late_stereo(room: Room) -> dict[str, Any]:
    return {"recording": on(room, CAM1, lambda _, t, m: [(t + 15_000_000, stamped(m, header_ns(m) + 15_000_000))])}


def lonely_images(room: Room) -> dict[str, Any]:
    return {"recording": on(room, CAM1, lambda i, t, m: [] if i % 4 == 1 else [(t, m)])}


def on_images(room: Room, topic: str, change: Callable[[Any], Any], first: int = 0) -> dict[str, Any]:
    def changed(i: int, t: int, m: Any) -> list[tuple[int, Any]]:
        return [(t, with_pixels(m, change(pixels_of(m))) if i >= first else m)]

    return {"recording": on(room, topic, changed)}


def dark(room: Room) -> dict[str, Any]:
    return on_images(room, CAM1, lambda pixels: pixels * 0.05, first=30)


def saturated(room: Room) -> dict[str, Any]:
    return on_images(room, CAM1, lambda pixels: np.clip(pixels * 4.0, 0, 255), first=30)


def blurred(room: Room) -> dict[str, Any]:
    return on_images(room, CAM1, lambda pixels: cv2.GaussianBlur(pixels, (0, 0), 3), first=30)


def frozen(room: Room) -> dict[str, Any]:
    held: list[Any] = []

    def change(i: int, t: int, m: Any) -> list[tuple[int, Any]]:
        if i == 15:
            held.append(pixels_of(m))
        return [(t, with_pixels(m, held[0]) if 15 <= i < 25 else m)]

    return {"recording": on(room, CAM1, change)}


def half_size(room: Room) -> dict[str, Any]:
    return on_images(room, CAM1, lambda pixels: cv2.resize(pixels, None, fx=0.5, fy=0.5))


def wrong_encoding(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "cam0", calibration={"encoding": "rgb8"})}


def centre_of_another_size(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "cam1", calibration={"cx": WIDTH - 1.0})}


def focal_length_in_mm(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "cam1", calibration={"fx": 4.0, "fy": 4.0})}


def unrectified(room: Room) -> dict[str, Any]:
    def turn(pixels: Any) -> Any:
        height, width = pixels.shape
        return cv2.warpAffine(pixels, cv2.getRotationMatrix2D((width / 2, height / 2), 4.0, 1.0), (width, height))

    return on_images(room, CAM1, turn)


def swapped_stereo(room: Room) -> dict[str, Any]:
    left, right = room.dataset.sensor("cam0"), room.dataset.sensor("cam1")
    swapped = altered(room, "cam0", T_body_sensor=right.T_body_sensor)
    return {"dataset": altered(dataclasses.replace(room, dataset=swapped), "cam1", T_body_sensor=left.T_body_sensor)}


def moved_cameras(room: Room, change: Callable[[Any], Any]) -> dict[str, Any]:
    """The cameras as a rig elsewhere on the body."""
    left = np.array(room.dataset.sensor("cam0").T_body_sensor).reshape(4, 4)
    moved = change(left) @ np.linalg.inv(left)
    dataset = room.dataset
    for name in ("cam0", "cam1", "depth0"):
        T = moved @ np.array(dataset.sensor(name).T_body_sensor).reshape(4, 4)
        dataset = altered(dataclasses.replace(room, dataset=dataset), name, T_body_sensor=tuple(T.reshape(-1)))
    return {"dataset": dataset}


def turned_cameras(room: Room) -> dict[str, Any]:
    turn = np.eye(4)
    turn[:3, :3] = rotation_xyz(0.0, 0.0, np.pi / 2)
    return moved_cameras(room, lambda T: turn @ T)


def inverted_extrinsics(room: Room) -> dict[str, Any]:
    return moved_cameras(room, np.linalg.inv)


def long_baseline(room: Room) -> dict[str, Any]:
    left = np.array(room.dataset.sensor("cam0").T_body_sensor).reshape(4, 4)
    right = np.array(room.dataset.sensor("cam1").T_body_sensor).reshape(4, 4)
    T_left_right = np.linalg.inv(left) @ right
    T_left_right[:3, 3] *= 10
    return {"dataset": altered(room, "cam1", T_body_sensor=tuple((left @ T_left_right).reshape(-1)))}


def wrong_depth_factor(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "depth0", calibration={"units_per_m": 5000})}


def depth_as_metres(room: Room) -> dict[str, Any]:
    return {"dataset": altered(room, "depth0", calibration={"units_per_m": 1})}


def no_depth(room: Room) -> dict[str, Any]:
    def change(i: int, t: int, m: Any) -> list[tuple[int, Any]]:
        return [(t, dataclasses.replace(m, data=np.zeros_like(m.data)) if i > 10 else m)]

    return {"recording": on(room, DEPTH, change)}


def on_truth(room: Room, change: Callable[[Any], Any]) -> dict[str, Any]:
    return {"truth": change(room.truth.copy())}


def scaled(column: slice | int, factor: float) -> Callable[[Room], dict[str, Any]]:
    def change(rows: Any) -> Any:
        rows[:, column] *= factor
        return rows

    return lambda room: on_truth(room, change)


def truth_jump(rows: Any) -> Any:
    rows[300:310, 1] += 2.0
    return rows


def wrong_norms(rows: Any) -> Any:
    rows[200:, 4:] *= 1.2
    return rows


def unordered(rows: Any) -> Any:
    rows[[400, 401]] = rows[[401, 400]]
    return rows


def without_orientation(rows: Any) -> Any:
    rows[:, 4:] = (0, 0, 0, 1)
    rows[:, 1] = np.cos(rows[:, 0])
    rows[:, 2] = np.sin(rows[:, 0])
    return rows


def wxyz(rows: Any) -> Any:
    rows[:, 4:] = np.roll(rows[:, 4:], 1, axis=1)
    return rows


def inverted(rows: Any) -> Any:
    rows[:, 4:7] *= -1
    return rows


def shifted(offset_s: float) -> Callable[[Room], dict[str, Any]]:
    def change(rows: Any) -> Any:
        rows[:, 0] += offset_s
        return rows

    return lambda room: on_truth(room, change)


def tilted_world(rows: Any) -> Any:
    """The world turned about x by a quarter: y is up."""
    turn = rotation_xyz(np.pi / 2, 0.0, 0.0)
    rows[:, 1:4] = rows[:, 1:4] @ turn.T
    half = np.sqrt(0.5)
    x, y, z, w = rows[:, 4:].T.copy()
    rows[:, 4:] = np.column_stack((half * (w + x), half * (y - z), half * (z + y), half * (w - x)))
    return rows


def imu(rates: Any, forces: Any) -> Callable[[Room], dict[str, Any]]:
    return lambda room: {"recording": on(room, IMU, lambda _, t, m: [(t, turned_imu(m, rates, forces))])}


def late_imu(room: Room) -> dict[str, Any]:
    return {"recording": on(room, IMU, lambda _, t, m: [(t + 80_000_000, stamped(m, header_ns(m) + 80_000_000))])}


def points(change: Callable[[Any], Any]) -> Callable[[Room], dict[str, Any]]:
    return lambda room: {"recording": on(room, LIDAR, lambda _, t, m: [(t, with_points(m, change))])}


def millimetres(table: Any) -> Any:
    for axis in "xyz":
        table[axis] *= 1000
    return table


def at_origin(table: Any) -> Any:
    for axis in "xyz":
        table[axis][::3] = 0
        table[axis][1::3] = 0
    return table


def backwards(table: Any) -> Any:
    table["time"] = table["time"].max() - table["time"]
    return table


def both_ways(room: Room) -> dict[str, Any]:
    def change(i: int, t: int, m: Any) -> list[tuple[int, Any]]:
        return [(t, with_points(m, backwards) if i % 2 else m)]

    return {"recording": on(room, LIDAR, change)}


def empty(room: Room) -> dict[str, Any]:
    def change(i: int, t: int, m: Any) -> list[tuple[int, Any]]:
        return [(t, with_points(m, lambda table: table[:0]) if i in {7, 8} else m)]

    return {"recording": on(room, LIDAR, change)}


def stamped_at_end(room: Room) -> dict[str, Any]:
    return {"recording": on(room, LIDAR, lambda _, t, m: [(t, stamped(m, t))])}


def turned_lidar(room: Room) -> dict[str, Any]:
    T = np.array(room.dataset.sensor("lidar0").T_body_sensor).reshape(4, 4)
    T[:3, :3] = QUARTER_TURN @ T[:3, :3]
    return {"dataset": altered(room, "lidar0", T_body_sensor=tuple(T.reshape(-1)))}


def declared(name: str, **calibration: Any) -> Callable[[Room], dict[str, Any]]:
    return lambda room: {"dataset": altered(room, name, calibration=calibration)}


Fault = Callable[[Room], dict[str, Any]]

FAULTS: dict[str, tuple[Fault, str, str]] = {
    "a gap of the IMU": (gap, "gaps", "imu0"),
    "a jump of a clock": (clock_jump, "clock-jumps", "imu0"),
    "a clock that drifts": (clock_drift, "clocks", "lidar0"),
    "a clock apart from the others": (clock_offset, "clocks", "cam1"),
    "messages out of order": (out_of_order, "order", "imu0"),
    "duplicate timestamps": (duplicate, "duplicates", "imu0"),
    "timestamps of zero": (zero_stamps, "order", "lidar0"),
    "a sensor that ends early": (early_end, "spans", "lidar0"),
    "a wrong rate": (wrong_rate, "rates", "imu0"),
    "an absent topic": (absent_topic, "topics", "lidar0"),
    "a topic of another type": (wrong_type, "topics", "lidar0"),
    "stereo images apart in time": (late_stereo, "stereo-sync", "cam1"),
    "stereo images without a partner": (lonely_images, "stereo-partners", "cam1"),
    "dark images": (dark, "image-dark", "cam1"),
    "saturated images": (saturated, "image-saturated", "cam1"),
    "blurred images": (blurred, "image-blur", "cam1"),
    "frozen images": (frozen, "image-frozen", "cam1"),
    "images of another size": (half_size, "image-size", "cam1"),
    "another encoding": (wrong_encoding, "image-encoding", "cam0"),
    "the principal point of another size": (centre_of_another_size, "intrinsics", "cam1"),
    "a focal length in mm": (focal_length_in_mm, "intrinsics", "cam1"),
    "unrectified stereo": (unrectified, "stereo-geometry", "cam1"),
    "left and right swapped": (swapped_stereo, "stereo-geometry", "cam1"),
    "turned cameras": (turned_cameras, "camera-motion", "cam0"),
    "inverted extrinsics": (inverted_extrinsics, "camera-motion", "cam0"),
    "a baseline in another unit": (long_baseline, "stereo-scale", "cam1"),
    "a wrong depth factor": (wrong_depth_factor, "depth-scale", "depth0"),
    "depth in mm taken for m": (depth_as_metres, "depth-scale", "depth0"),
    "depth images without values": (no_depth, "depth-values", "depth0"),
    "ground truth in mm": (scaled(slice(1, 4), 1000.0), "truth-scale", "groundtruth"),
    "ground truth in km": (scaled(slice(1, 4), 0.001), "truth-scale", "groundtruth"),
    "ground truth in ns": (scaled(0, 1e9), "truth-times", "groundtruth"),
    "ground truth in ms": (scaled(0, 1e3), "truth-times", "groundtruth"),
    "quaternions in the order w x y z": (lambda room: on_truth(room, wxyz), "truth-orientation", "groundtruth"),
    "inverted orientations": (lambda room: on_truth(room, inverted), "truth-orientation", "groundtruth"),
    "a jump of the ground truth": (lambda room: on_truth(room, truth_jump), "truth-jumps", "groundtruth"),
    "quaternions of another norm": (lambda room: on_truth(room, wrong_norms), "truth-quaternions", "groundtruth"),
    "unordered poses": (lambda room: on_truth(room, unordered), "truth-times", "groundtruth"),
    "half a ground truth": (lambda room: on_truth(room, lambda rows: rows[:400]), "truth-coverage", "groundtruth"),
    "a hole in the ground truth": (
        lambda room: on_truth(room, lambda rows: np.vstack((rows[:250], rows[500:]))),
        "truth-coverage",
        "groundtruth",
    ),
    "a sparse ground truth": (lambda room: on_truth(room, lambda rows: rows[::150]), "truth-rate", "groundtruth"),
    "ground truth of another day": (shifted(86_400.0), "truth-coverage", "groundtruth"),
    "undeclared positions only": (lambda room: on_truth(room, lambda rows: rows[:, :4]), "truth-kind", "groundtruth"),
    "a world that does not point up": (lambda room: on_truth(room, tilted_world), "gravity-direction", "imu0"),
    "an unreadable ground truth": (lambda _room: {"truth": np.zeros((3, 2))}, "truth-file", "groundtruth"),
    "accelerations in g": (imu(UNTURNED, UNTURNED / 9.80665), "gravity", "imu0"),
    "accelerations reversed": (imu(UNTURNED, -UNTURNED), "gravity-direction", "imu0"),
    "angular rates in deg/s": (imu(UNTURNED * 57.29578, UNTURNED), "imu-units", "imu0"),
    "a turned IMU": (imu(QUARTER_TURN, QUARTER_TURN), "imu-axes", "imu0"),
    "a left-handed gyroscope": (imu(np.diag([1.0, -1.0, 1.0]), UNTURNED), "imu-axes", "imu0"),
    "a gyroscope of zeros": (imu(np.zeros((3, 3)), UNTURNED), "imu-rates", "imu0"),
    "a late IMU": (late_imu, "imu-time-offset", "imu0"),
    "points in mm": (points(millimetres), "lidar-ranges", "lidar0"),
    "points at the origin": (points(at_origin), "lidar-ranges", "lidar0"),
    "times of points in another unit": (declared("lidar0", point_time_unit="ms"), "lidar-point-times", "lidar0"),
    "times of points since another zero": (
        declared("lidar0", point_time_reference="absolute"),
        "lidar-point-times",
        "lidar0",
    ),
    "no times of points": (declared("lidar0", point_time_field="t"), "lidar-point-times", "lidar0"),
    "times that run backwards": (points(backwards), "lidar-direction", "lidar0"),
    "sweeps in both directions": (both_ways, "lidar-direction", "lidar0"),
    "empty sweeps": (empty, "lidar-empty", "lidar0"),
    "sweeps stamped at their end": (stamped_at_end, "lidar-stamp", "lidar0"),
    "a turned LiDAR": (turned_lidar, "lidar-motion", "lidar0"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found(name: str, room: Room, tmp_path: Path):
    fault, check, about = FAULTS[name]
    report = room.check(tmp_path, **fault(room))
    found = [finding for finding in report.findings if finding.check == check]
    assert [finding.about for finding in found] == [about], shown(report)
    assert found[0].severity in {Severity.ERROR, Severity.WARNING}
    unrelated = [f for f in report.findings if f.check != check and f.severity is Severity.ERROR]
    assert not unrelated, shown(report)


def shown(report: CheckReport) -> str:
    return "\n".join(f"{f.severity} {f.check} {f.about}: {f.message} ({f.value} {f.unit})" for f in report.findings)
