"""Recording the room: schedule, sensing, bag, ground truth, ``dataset.yaml``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout, PointOrder, Rotation
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.names import check_name
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array, flat, quaternions_from_rotations
from slamhive.recordings.room.sensors import (
    BASELINE_M,
    DEPTH_UNITS_PER_M,
    ImuSamples,
    Rig,
    Scene,
    Task,
    TaskKind,
    make_rig,
    measure,
    sense_all,
)
from slamhive.recordings.room.world import REFERENCE_MAP_FILE, motion_at, sample_surfaces
from slamhive.recordings.staging import GROUND_TRUTH_FILE, Progress, new_dataset
from slamhive.recordings.writers import NS_PER_S, BagWriter
from slamhive.runtime.pcd import write_pcd
from slamhive.runtime.point_times import PointTimes, TimeReference

# What can be chosen about a ``room`` dataset.


@dataclass(frozen=True, slots=True)
class RoomOptions:
    """Size and seed of one sequence; raises InvalidInput for values that make no sense.

    ``workers`` processes render; the bag does not depend on their number.
    """

    name: str = "room"
    duration_s: float = 15.0
    seed: int = 1
    width: int = 640
    height: int = 480
    camera_rate_hz: float = 20.0
    imu_rate_hz: float = 200.0
    lidar_rate_hz: float = 10.0
    workers: int = 2

    def __post_init__(self) -> None:
        check_name("dataset", self.name)
        _check("duration", self.duration_s, 0.1, 600.0, "s")
        _check("seed", self.seed, 0, 2**32 - 1, "")
        _check("width", self.width, 32, 1920, "pixels")
        _check("height", self.height, 24, 1440, "pixels")
        _check("camera rate", self.camera_rate_hz, 1.0, 60.0, "Hz")
        _check("IMU rate", self.imu_rate_hz, 50.0, 1000.0, "Hz")
        _check("LiDAR rate", self.lidar_rate_hz, 1.0, 20.0, "Hz")
        _check("workers", self.workers, 1, 64, "processes")

    @property
    def frames(self) -> int:
        """Number of stereo and depth frames."""
        return _count(self.duration_s, self.camera_rate_hz) + 1

    @property
    def imu_samples(self) -> int:
        """Number of IMU samples and of ground-truth poses."""
        return _count(self.duration_s, self.imu_rate_hz) + 1

    @property
    def scans(self) -> int:
        """Number of LiDAR scans that end within the sequence."""
        return _count(self.duration_s, self.lidar_rate_hz)


def _count(duration_s: float, rate_hz: float) -> int:
    return int(duration_s * rate_hz + 1e-9)


def _check(what: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise InvalidInput(f"room {what} {value!r} is not allowed", f"expected {low:g} to {high:g} {unit}".strip())


# ``dataset.yaml`` of the room: what its sensors are, in the terms of ``docs/dataset-format.md``.


def sensors_of(options: RoomOptions, rig: Rig) -> tuple[Sensor, ...]:
    """The sensors of the room, as ``dataset.yaml`` describes them."""
    noise = rig.imu_noise
    return (
        *_cameras(options, rig),
        Sensor(
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
        ),
        _lidar(options, rig),
    )


def description_of(options: RoomOptions) -> dict[str, Any]:
    """Content of ``dataset.yaml`` besides the sensors."""
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
    left, right = flat(rig.T_body_left), flat(rig.T_body_right)
    rate_hz = options.camera_rate_hz
    return (
        Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", rate_hz, left, grey),
        Sensor("cam1", SensorKind.CAMERA, "/cam1/image_raw", rate_hz, right, grey),
        Sensor("depth0", SensorKind.DEPTH, "/depth0/image_raw", rate_hz, left, depth),
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
        flat(rig.T_body_lidar),
        layout.calibration(range_noise_m=model.range_noise_m),
    )


START_NS = 1000 * NS_PER_S
"""Start of the sequence. ROS takes 0 for "no time"; a small number keeps timestamps in float64 exact to 1e-12."""
_IMU_NOISE_STREAM = 4
_SCAN_BYTES_PER_RAY = 22
_MAP_BYTES = 10_000_000


class _Kind(StrEnum):
    IMU = "imu"
    FRAME = "frame"
    SCAN = "scan"


@dataclass(frozen=True, slots=True)
class _Event:
    """One thing to record: when it was received and measured, in ns since the sequence's start."""

    received_ns: int
    kind: _Kind
    number: int
    measured_ns: int


def render_room(folder: Path, options: RoomOptions, progress: Progress) -> Dataset:
    """Render the dataset ``options.name`` into ``folder``, which must not exist; equal options give equal bytes.

    A cloud of the room's surfaces lies beside the bag as the reference for maps.

    Raises:
        Conflict: the folder exists.
        Unavailable: no space, or a render process died. Nothing is left behind.
    """
    rig = make_rig(options.width, options.height, options.lidar_rate_hz)
    sensors = sensors_of(options, rig)
    frame_bytes = options.width * options.height * 4 + 2000
    scan_bytes = rig.lidar.beams * rig.lidar.columns * _SCAN_BYTES_PER_RAY + 1000
    needed_bytes = options.frames * frame_bytes + options.scans * scan_bytes + options.imu_samples * 800 + _MAP_BYTES
    with new_dataset(folder, needed_bytes) as new:
        progress(0.0, "painting the room")
        with new.recording() as bag:
            _record(bag, options, rig, sensors, progress)
        times_ns = _times_ns(options.imu_samples, options.imu_rate_hz)
        motion = motion_at(times_ns * 1e-9, options.duration_s)
        quats_xyzw = quaternions_from_rotations(motion.R_world_body)
        new.write_ground_truth((START_NS + times_ns) / NS_PER_S, motion.positions_m, quats_xyzw)
        write_pcd(new.aside / REFERENCE_MAP_FILE, sample_surfaces())
        progress(0.98, "computing the checksum")
        dataset = new.seal(sensors=sensors, **description_of(options))
    progress(1.0, "done")
    return dataset


def _record(bag: BagWriter, options: RoomOptions, rig: Rig, sensors: tuple[Sensor, ...], progress: Progress) -> None:
    # By time of receipt; at equal times the IMU comes first, as the sort is stable.
    imu = [
        _Event(int(t), _Kind.IMU, n, int(t)) for n, t in enumerate(_times_ns(options.imu_samples, options.imu_rate_hz))
    ]
    frame_events = [
        _Event(int(t), _Kind.FRAME, n, int(t)) for n, t in enumerate(_times_ns(options.frames, options.camera_rate_hz))
    ]
    edges = _times_ns(options.scans + 1, options.lidar_rate_hz)
    scans = [_Event(int(edges[n + 1]), _Kind.SCAN, n, int(edges[n])) for n in range(options.scans)]
    events = sorted([*imu, *frame_events, *scans], key=lambda event: event.received_ns)
    heavy = [event for event in events if event.kind is not _Kind.IMU]
    tasks = [Task(TaskKind(event.kind), event.number, event.measured_ns * 1e-9) for event in heavy]
    scene = Scene(options.seed, options.duration_s, options.width, options.height, options.lidar_rate_hz)
    results = sense_all(scene, tasks, options.workers)
    samples = _imu(options, rig)
    recorder = _Recorder(sensors)
    frames = 0
    for event in events:
        stamp_ns = START_NS + event.measured_ns
        if event.kind is _Kind.IMU:
            recorder.imu(bag, stamp_ns, samples, event.number)
        elif event.kind is _Kind.SCAN:
            recorder.scan(bag, stamp_ns, START_NS + event.received_ns, next(results)[0])
        else:
            recorder.frame(bag, stamp_ns, next(results))
            frames += 1
            progress(0.02 + 0.95 * frames / options.frames, f"rendering frame {frames} of {options.frames}")


class _Recorder:
    """Puts what the sensors saw on their topics."""

    def __init__(self, sensors: tuple[Sensor, ...]) -> None:
        self._left, self._right, self._depth, self._imu, self._lidar = sensors

    def imu(self, bag: BagWriter, stamp_ns: int, samples: ImuSamples, number: int) -> None:
        bag.imu(self._imu, stamp_ns, samples.rates_radps[number], samples.specific_forces_mps2[number])

    def scan(self, bag: BagWriter, stamp_ns: int, received_ns: int, points: Array) -> None:
        bag.points(self._lidar, stamp_ns, received_ns, points)

    def frame(self, bag: BagWriter, stamp_ns: int, images: tuple[Array, ...]) -> None:
        left, right, depth = images
        bag.camera_info(self._left, "/cam0/camera_info", stamp_ns)
        bag.image(self._left, stamp_ns, left, "mono8")
        bag.camera_info(self._right, "/cam1/camera_info", stamp_ns, BASELINE_M)
        bag.image(self._right, stamp_ns, right, "mono8")
        bag.image(self._depth, stamp_ns, depth, "16UC1")


def _times_ns(count: int, rate_hz: float) -> Array:
    times: Array = np.rint(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)
    return times


def _imu(options: RoomOptions, rig: Rig) -> ImuSamples:
    motion = motion_at(_times_ns(options.imu_samples, options.imu_rate_hz) * 1e-9, options.duration_s)
    rng = np.random.default_rng(np.random.SeedSequence([options.seed, _IMU_NOISE_STREAM]))
    return measure(motion, options.imu_rate_hz, rig.imu_noise, rng)
