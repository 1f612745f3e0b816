"""A small bag of images and IMU samples, and what a mapping script would be configured with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.writers import BagWriter
from slamhive.runtime.config import RunConfig
from slamhive.runtime.playback import player_options
from slamhive.runtime.player import PlayerOptions

START_NS = 1_000_000_000_000
LEFT = Sensor("cam0", SensorKind.CAMERA, "/cam0", 100.0)
RIGHT = Sensor("cam1", SensorKind.CAMERA, "/cam1", 100.0)
IMU = Sensor("imu0", SensorKind.IMU, "/imu", 500.0)


def write_bag(path: Path, frames: int = 50, period_ns: int = 10_000_000, skew_ns: int = 0) -> None:
    """Stereo frames every 10 ms, five IMU samples to each; the right image lacks every tenth frame if skewed."""
    with BagWriter(path) as bag:
        for number in range(frames):
            stamp_ns = START_NS + number * period_ns
            pixels = np.full((4, 6), number, dtype=np.uint8)
            bag.image(LEFT, stamp_ns, pixels, "mono8")
            if not (skew_ns and number % 10 == 9):
                bag.image(RIGHT, stamp_ns + skew_ns, pixels + 1, "mono8")
            for part in range(5):
                rate = np.array([number, part, 0.0])
                bag.imu(IMU, stamp_ns + (part + 1) * period_ns // 6, rate, np.zeros(3))


def options(bag: Path, topics: dict[str, str], mode: str = "realtime", queue_size: int = 3) -> PlayerOptions:
    config = RunConfig(
        "a",
        "d",
        algorithm_remap={role: f"/{role}" for role in topics},
        dataset_remap={f"/{role}": topic for role, topic in topics.items()},
        general_parameter={"queue_size": queue_size},
        playback_mode=mode,
    )
    return player_options(config, bag)
