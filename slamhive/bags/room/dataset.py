"""Recording the room: schedule, sensing, bag, ground truth, ``dataset.yaml``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from slamhive.bags.bag_writer import NS_PER_S, BagWriter
from slamhive.bags.geometry import Array, quaternions_from_rotations
from slamhive.bags.room.description import description_of, sensors_of
from slamhive.bags.room.imu import ImuSamples, measure
from slamhive.bags.room.motion import motion_at
from slamhive.bags.room.options import RoomOptions
from slamhive.bags.room.reference_map import REFERENCE_MAP_FILE, sample_surfaces
from slamhive.bags.room.rig import BASELINE_M, Rig, make_rig
from slamhive.bags.room.sensing import Scene, Task, TaskKind, sense_all
from slamhive.bags.staging import Progress, new_dataset
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor
from slamhive.runtime.pcd import write_pcd

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
    with new_dataset(folder, _expected_bytes(options, rig)) as new:
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
    events = _schedule(options)
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


def _schedule(options: RoomOptions) -> list[_Event]:
    """All events by receive time; at equal times the IMU comes first."""
    imu = [
        _Event(int(t), _Kind.IMU, n, int(t)) for n, t in enumerate(_times_ns(options.imu_samples, options.imu_rate_hz))
    ]
    frames = [
        _Event(int(t), _Kind.FRAME, n, int(t)) for n, t in enumerate(_times_ns(options.frames, options.camera_rate_hz))
    ]
    edges = _times_ns(options.scans + 1, options.lidar_rate_hz)
    scans = [_Event(int(edges[n + 1]), _Kind.SCAN, n, int(edges[n])) for n in range(options.scans)]
    return sorted([*imu, *frames, *scans], key=lambda event: event.received_ns)


def _times_ns(count: int, rate_hz: float) -> Array:
    times: Array = np.rint(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)
    return times


def _imu(options: RoomOptions, rig: Rig) -> ImuSamples:
    motion = motion_at(_times_ns(options.imu_samples, options.imu_rate_hz) * 1e-9, options.duration_s)
    rng = np.random.default_rng(np.random.SeedSequence([options.seed, _IMU_NOISE_STREAM]))
    return measure(motion, options.imu_rate_hz, rig.imu_noise, rng)


def _expected_bytes(options: RoomOptions, rig: Rig) -> int:
    frame_bytes = options.width * options.height * 4 + 2000
    scan_bytes = rig.lidar.beams * rig.lidar.columns * _SCAN_BYTES_PER_RAY + 1000
    return options.frames * frame_bytes + options.scans * scan_bytes + options.imu_samples * 800 + _MAP_BYTES
