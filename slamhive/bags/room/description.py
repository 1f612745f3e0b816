"""``dataset.yaml`` of the room: what its sensors are, in the terms of ``docs/dataset-format.md``."""

from __future__ import annotations

from typing import Any

from slamhive.bags.geometry import Array
from slamhive.bags.room.options import RoomOptions
from slamhive.bags.room.reference_map import REFERENCE_MAP_FILE
from slamhive.bags.room.rig import DEPTH_UNITS_PER_M, Rig
from slamhive.bags.staging import GROUND_TRUTH_FILE
from slamhive.domain.dataset import GroundTruth
from slamhive.domain.lidar_layout import LidarLayout, PointOrder, Rotation
from slamhive.domain.sensors import Matrix4, Sensor, SensorKind
from slamhive.runtime.point_times import PointTimes, TimeReference


def sensors_of(options: RoomOptions, rig: Rig) -> tuple[Sensor, ...]:
    """The sensors of the room, as ``dataset.yaml`` describes them."""
    return (*_cameras(options, rig), _imu(options, rig), _lidar(options, rig))


def description_of(options: RoomOptions) -> dict[str, Any]:
    """What ``dataset.yaml`` says besides the sensors."""
    return {
        "duration_s": options.duration_s,
        "groundtruth": GroundTruth(GROUND_TRUTH_FILE, gravity_aligned=True),
        "title": "Synthetic room",
        "description": (
            f"A rendered, textured room of 8 x 6 x 3 m, {options.duration_s:g} s, seed {options.seed}: rectified grey "
            "stereo, exact depth. The IMU has noise and drifting biases; motion distorts the LiDAR scans."
        ),
        "licence": "GPL-3.0-or-later",
        "source": f"slamhive dataset room --seconds {options.duration_s:g} --seed {options.seed}",
        "attributes": ("synthetic", "indoor"),
        "reference_map": REFERENCE_MAP_FILE,
    }


def _cameras(options: RoomOptions, rig: Rig) -> tuple[Sensor, Sensor, Sensor]:
    camera = rig.camera
    intrinsics: dict[str, float | int | str | tuple[float, ...]] = {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "model": "pinhole",
        "distortion": (0.0, 0.0, 0.0, 0.0),
        "rectified": True,
    }
    grey = {**intrinsics, "encoding": "mono8"}
    depth = {**intrinsics, "encoding": "16UC1", "units_per_m": DEPTH_UNITS_PER_M, "registered_to": "cam0"}
    left, right = _flat(rig.T_body_left), _flat(rig.T_body_right)
    rate_hz = options.camera_rate_hz
    return (
        Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", rate_hz, left, grey),
        Sensor("cam1", SensorKind.CAMERA, "/cam1/image_raw", rate_hz, right, grey),
        Sensor("depth0", SensorKind.DEPTH, "/depth0/image_raw", rate_hz, left, depth),
    )


def _imu(options: RoomOptions, rig: Rig) -> Sensor:
    noise = rig.imu_noise
    return Sensor(
        "imu0",
        SensorKind.IMU,
        "/imu0",
        options.imu_rate_hz,
        calibration={
            "gyroscope_noise_density": noise.gyroscope_noise_density,
            "accelerometer_noise_density": noise.accelerometer_noise_density,
            "gyroscope_random_walk": noise.gyroscope_random_walk,
            "accelerometer_random_walk": noise.accelerometer_random_walk,
        },
    )


def _lidar(options: RoomOptions, rig: Rig) -> Sensor:
    model = rig.lidar
    layout = LidarLayout(
        PointTimes(model.scan_duration_s, "time", reference=TimeReference.TIMESTAMP),
        ring_field="ring",
        point_order=PointOrder.COLUMNS,
        beams=model.beams,
        minimum_range_m=model.minimum_range_m,
        maximum_range_m=model.maximum_range_m,
        vertical_angles_deg=model.elevations_deg,
        points_per_ring=model.columns,
        rotation=Rotation.COUNTER_CLOCKWISE,
    )
    return Sensor(
        "lidar0",
        SensorKind.LIDAR,
        "/points",
        options.lidar_rate_hz,
        _flat(rig.T_body_lidar),
        layout.calibration(range_noise_m=model.range_noise_m),
    )


def _flat(T: Array) -> Matrix4:
    return tuple(float(value) for value in T.reshape(-1))
