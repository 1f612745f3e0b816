"""A dataset: a recording with known sensors, and what is known to be true of it; or that alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slamhive.base.errors import InvalidInput, lacks
from slamhive.domain.sensors import Sensor, SensorKind

RELATIONS_FILE = "relations.txt"
MOST_UNCERTAIN_M = 1e6
"""A larger standard deviation of a true position is a mistake."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The reference trajectory of a dataset: TUM format, poses of the body frame in a fixed world frame.

    ``gravity_aligned`` says that the world's z axis points up, which yaw + position alignment needs. ``kitti_poses`` is
    the file of the same poses as KITTI publishes them, where they come from one: matrices of seven digits, which the
    KITTI protocol takes as they are. ``source`` says what measured it: ``motion capture (Vicon)``.

    ``lever_arm_m`` is the point in the body frame that positions are of, where they alone are known: an antenna or a
    prism. ``uncertainty_m`` is the standard deviation of a position along each axis; ``uncertainties`` is a file of
    them for each pose, ``timestamp sigma_x sigma_y sigma_z`` in s and m, which outweighs the constant. ``image_times``
    is a file of the timestamps of images in s, at which a protocol that holds the estimate compares, as ETH3D's tool.
    """

    file: str
    gravity_aligned: bool
    positions_only: bool = False
    kitti_poses: str | None = None
    source: str = ""
    lever_arm_m: tuple[float, ...] | None = None
    uncertainty_m: float | None = None
    uncertainties: str | None = None
    image_times: str | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """The names of all its files in the folder of the dataset."""
        return tuple(filter(None, (self.file, self.kitti_poses, self.uncertainties, self.image_times)))


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


# The words that describe a dataset, such as ``indoor`` or ``dark``, and the properties that they are values of.


@dataclass(frozen=True, slots=True)
class AttributeKind:
    """A property of datasets and its known values. A dataset that names none of them has no value."""

    name: str
    label: str
    values: tuple[str, ...]

    def of(self, attributes: Iterable[str]) -> str | None:
        """The stated value, or ``indoor + outdoor`` for two; None if ``attributes`` state none."""
        given = set(attributes)
        return " + ".join(value for value in self.values if value in given) or None


ATTRIBUTE_KINDS = (
    AttributeKind("place", "Place", ("indoor", "outdoor", "underground")),
    AttributeKind("motion", "Motion", ("static", "slow", "moderate", "fast")),
    AttributeKind("light", "Light", ("bright", "changing-light", "dark")),
    AttributeKind("loops", "Loops", ("loops", "no-loops")),
    AttributeKind("difficulty", "Difficulty", ("easy", "medium", "difficult")),
    AttributeKind("scene", "Scene", ("static-scene", "dynamic-scene")),
    AttributeKind("carrier", "Carrier", ("handheld", "robot", "drone", "car")),
    AttributeKind("origin", "Origin", ("real", "synthetic")),
)
"""Every further word is an attribute too, but belongs to no property."""


# What a check of a dataset finds: findings with a place and a remedy, and what could not be checked.


VERSION = 1
"""Raised when checks change, so that reports of before are known to be outdated."""


class Severity(StrEnum):
    """Severity of a finding."""

    ERROR = "error"
    """Results on this dataset will be wrong, or runs will fail."""
    WARNING = "warning"
    """Results may be worse than they should be."""
    NOTE = "note"
    """Worth knowing."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a dataset.

    Attributes:
        check: The check that found it, such as ``gaps``.
        severity: How bad it is.
        about: The sensor, or ``groundtruth``.
        message: What was found, in one sentence.
        remedy: What to do about it.
        topic: The topic of the sensor.
        at_s: Where it is first seen, in s from the start of the recording; None if it is everywhere.
        count: In how many places.
        value: What was measured; None if it is no number.
        unit: The unit of ``value``.
        expected: What was expected instead, in words.
    """

    check: str
    severity: Severity
    about: str
    message: str
    remedy: str
    topic: str | None = None
    at_s: float | None = None
    count: int = 1
    value: float | None = None
    unit: str = ""
    expected: str = ""


class Blame(StrEnum):
    """Side that a contradiction between a ground truth and several systems speaks against."""

    TRUTH = "truth"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class NotChecked:
    """A check that could not be done on ``about``, and why."""

    check: str
    about: str
    reason: str


@dataclass(frozen=True, slots=True)
class CheckReport:
    """The result of all checks of one dataset, worst findings first. ``checks`` are the names of all checks."""

    dataset: str
    checksum: str
    checks: tuple[str, ...]
    findings: tuple[Finding, ...]
    not_checked: tuple[NotChecked, ...]
    version: int = VERSION

    def count(self, severity: Severity) -> int:
        """The number of findings of one severity."""
        return sum(finding.severity == severity for finding in self.findings)
