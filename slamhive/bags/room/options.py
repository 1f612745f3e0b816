"""What can be chosen about a ``room`` dataset."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.domain.names import check_name
from slamhive.errors import InvalidInput


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
