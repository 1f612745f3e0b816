"""What is known of the sensors of a recording before their messages are read: from files and from topics."""

from __future__ import annotations

from dataclasses import dataclass, field

from slamhive.bags.geometry import Array
from slamhive.domain.calibration import CameraIntrinsics, ImuNoise
from slamhive.domain.sensors import CalibrationValue, SensorKind


@dataclass(frozen=True, eq=False)
class KnownSensor:
    """One sensor of a calibration.

    Attributes:
        name: What the calibration calls it.
        kind: What it measures.
        topic: Where its messages are, empty if the calibration does not say.
        frame: What transforms call it; several files may have a ``cam0``.
        intrinsics: Of a camera.
        noise: Of an IMU.
        more: Further keys of ``dataset.yaml``.
    """

    name: str
    kind: SensorKind
    topic: str
    frame: str
    intrinsics: CameraIntrinsics | None = None
    noise: ImuNoise | None = None
    more: dict[str, CalibrationValue] = field(default_factory=dict)


@dataclass(eq=False)
class KnownCalibration:
    """Sensors, and transforms ``(parent, child, T_parent_child)`` between their frames; ``body`` is the body frame.

    ``notes`` say what was not read.
    """

    sensors: list[KnownSensor] = field(default_factory=list)
    transforms: list[tuple[str, str, Array]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
