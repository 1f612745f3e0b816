"""A dataset: a recording with known sensors, and what is known to be true of it; or that alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput, lacks

RELATIONS_FILE = "relations.txt"


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The reference trajectory of a dataset: TUM format, poses of the body frame in a fixed world frame.

    ``gravity_aligned`` says that the world's z axis points up, which yaw + position alignment needs. ``kitti_poses`` is
    the file of the same poses as KITTI publishes them, where they come from one: matrices of seven digits, which the
    KITTI protocol takes as they are. ``source`` says what measured it: ``motion capture (Vicon)``.
    """

    file: str
    gravity_aligned: bool
    positions_only: bool = False
    kitti_poses: str | None = None
    source: str = ""


@dataclass(frozen=True, slots=True)
class Dataset:
    """A recording as ``dataset.yaml`` describes it. ``folder`` holds the bag, the ground truth and the YAML.

    ``bag`` is empty for a dataset with only ground truth or relations, for imported runs; ``checksum`` is then that of
    these files. ``reference_map`` is a PCD file in the world of the ground truth. ``relations`` is a file of measured
    relative poses of the body frame: ``timestamp1 timestamp2 x y z roll pitch yaw`` per line.
    """

    name: str
    folder: Path
    bag: str
    duration_s: float
    sensors: tuple[Sensor, ...]
    groundtruth: GroundTruth | None
    checksum: str
    title: str = ""
    description: str = ""
    licence: str = ""
    citation: str = ""
    source: str = ""
    attributes: tuple[str, ...] = ()
    reference_map: str | None = None
    relations: str | None = None

    @property
    def bag_path(self) -> Path:
        """Where the recording lies: a file (ROS 1, MCAP) or a folder (ROS 2); raises InvalidInput if there is none."""
        self.check_recorded()
        return self.folder / self.bag

    def check_recorded(self) -> None:
        """Raise InvalidInput for a dataset without a recording."""
        if not self.bag:
            alone = "relations" if self.groundtruth is None else "a ground truth"
            raise InvalidInput(
                f"dataset {self.name} is {alone} without a recording: nothing can be run on it",
                "slamhive runs import adds trajectories of other tools",
            )

    @property
    def groundtruth_path(self) -> Path | None:
        """Where the ground truth lies, None for a dataset without."""
        return None if self.groundtruth is None else self.folder / self.groundtruth.file

    def of_kind(self, kind: SensorKind) -> tuple[Sensor, ...]:
        """The sensors of one kind, in the order of ``dataset.yaml``."""
        return tuple(sensor for sensor in self.sensors if sensor.kind is kind)

    def sensor(self, name: str) -> Sensor:
        """The sensor called ``name``; raises NotFound."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise lacks(f"dataset {self.name}", "sensor", name, [sensor.name for sensor in self.sensors])
