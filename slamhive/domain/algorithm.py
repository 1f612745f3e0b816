"""An algorithm as a user sees it: one mode of one package, with its needs, its settings and its promises."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout, PointOrder
from slamhive.domain.configuration import Playback, PlaybackMode
from slamhive.domain.dataset import Dataset
from slamhive.domain.packages import UNKNOWN, PackageOrigin, PinnedImage, Weights, version_label
from slamhive.domain.parameters import Parameter, SensorProperty, Value
from slamhive.domain.protocol import ALIGNMENT_LABELS, Alignment, PoseTime, TrajectoryKind
from slamhive.domain.roles import BY_RULE, Chosen, TopicOf, assign_in_order, check_choice
from slamhive.domain.sensors import Sensor, SensorKind, SensorSetup
from slamhive.domain.verdict import ERROR, RELATION_ERROR, RELATION_ROTATION
from slamhive.runtime.point_times import TimeReference, TimeUnit


@dataclass(frozen=True, slots=True)
class Bound:
    """One entry of ``bounds`` in ``algorithm.yaml``.

    Attributes:
        dataset: The name of the dataset.
        poses: The trajectory has at least so many poses.
        ate_rmse_m: The absolute trajectory error (RMSE, m) is at most this; None does not limit it.
        alignment: How the estimate is aligned before the error is computed.
        playback: How the recording is played. Sequential playback tests the algorithm, not the speed of the machine.
        parameters: Values that differ from the defaults.
        relations_m: The mean translation error (m) over the dataset's relations is at most this; None does not limit
            it. For datasets without ground truth.
        relations_deg: The same for the mean rotation error (degrees).
    """

    dataset: str
    poses: int
    ate_rmse_m: float | None
    alignment: Alignment
    playback: Playback
    parameters: Mapping[str, Value]
    relations_m: float | None = None
    relations_deg: float | None = None

    @property
    def words(self) -> str:
        """Describe the bounds: ``≥ 149 poses, ATE ≤ 0.03 m (SE(3))``."""
        parts = [f"≥ {self.poses} poses"]
        if self.ate_rmse_m is not None:
            parts.append(f"ATE ≤ {self.ate_rmse_m:g} m ({ALIGNMENT_LABELS[self.alignment]})")
        if self.relations_m is not None:
            parts.append(f"relations ≤ {self.relations_m:g} m")
        if self.relations_deg is not None:
            parts.append(f"≤ {self.relations_deg:g} deg")
        return ", ".join(parts)

    def broken_by(self, poses: int | None, metrics: Mapping[str, float]) -> str | None:
        """Why a run that succeeded and was evaluated does not keep the bound; None if it does."""
        if poses is None or poses < self.poses:
            return f"{poses or 0} poses, at least {self.poses} are needed"
        limits = (
            ("ATE RMSE", ERROR, self.ate_rmse_m, "m"),
            ("mean translation error of the relations", RELATION_ERROR, self.relations_m, "m"),
            ("mean rotation error of the relations", RELATION_ROTATION, self.relations_deg, "deg"),
        )
        for name, key, limit, unit in limits:
            error = metrics.get(key)
            if limit is None:
                continue
            if error is None:
                return "the trajectory could not be evaluated"
            if error > limit:
                return f"{name} {error:.4g} {unit}, at most {limit:g} {unit} is allowed"
        return None


# An algorithm as a user sees it: one mode of one package, with what it needs and what can be set.


# What an algorithm has to know of a sensor, and whether the dataset has it.


@dataclass(frozen=True, slots=True)
class Requirement:
    """An entry of ``requires`` in ``algorithm.yaml``: a property that must be known.

    ``allowed`` are its only values, empty for any.
    """

    source: SensorProperty
    allowed: tuple[str, ...] = ()

    def met_by(self, sensor: Sensor) -> bool:
        """Tell if ``sensor`` has the property, with a value that is allowed."""
        found = self.source.value({self.source.role: sensor})
        return found is not None and (not self.allowed or str(found) in self.allowed)


def check_requirements(requirements: Sequence[Requirement], sensor: Sensor, algorithm: str, dataset: str) -> None:
    """Raise InvalidInput naming all that ``sensor`` of ``dataset`` lacks of what ``algorithm`` requires of its role."""
    unmet = [entry for entry in requirements if not entry.met_by(sensor)]
    missing = [entry.source.name for entry in unmet if entry.source.value({entry.source.role: sensor}) is None]
    if missing:
        raise InvalidInput(
            f"{algorithm} needs {', '.join(missing)} of its {unmet[0].source.role}; {sensor.name} of dataset {dataset} "
            f"does not state {'it' if len(missing) == 1 else 'them'}",
            f"add {', '.join(missing)} to the calibration of {sensor.name} in dataset.yaml",
        )
    for entry in unmet:
        raise InvalidInput(
            f"{algorithm} needs {entry.source} to be {' or '.join(entry.allowed)}; it is "
            f"{entry.source.value({entry.source.role: sensor})} for {sensor.name} of dataset {dataset}",
            "choose another sensor, dataset or algorithm",
        )


# Whether a package uses a GPU, and what a GPU is.


class GpuNeed(StrEnum):
    """Access of a package's runs to a GPU."""

    NONE = "none"
    OPTIONAL = "optional"
    """A run gets one where the machine has one."""
    REQUIRED = "required"


@dataclass(frozen=True, slots=True)
class Gpu:
    """One GPU of this machine. ``uuid`` stays the same over restarts, unlike its number."""

    uuid: str
    model: str
    driver: str
    memory_bytes: int


@dataclass(frozen=True, slots=True)
class GivenGpu:
    """The GPU that an engine of several nodes gave to a run. What nobody could find out is None.

    Attributes:
        node: Where it is.
        number: What the engine calls it on that node.
        uuid: As in :class:`Gpu`, with ``model``, ``driver`` and ``memory_bytes``.
    """

    node: str
    number: str | None = None
    uuid: str | None = None
    model: str | None = None
    driver: str | None = None
    memory_bytes: int | None = None


# What an algorithm needs of the points of a LiDAR, and whether a dataset has it.


class LidarNeed(StrEnum):
    """Degree to which an algorithm needs something."""

    REQUIRED = "required"
    OPTIONAL = "optional"
    IGNORED = "ignored"


@dataclass(frozen=True, slots=True)
class LidarNeeds:
    """Demands of a package on point clouds, the entry ``lidar`` of ``algorithm.yaml``.

    Attributes:
        point_time: A time for each point.
        ring: The number of the ring of each point.
        organised: Scans that are images of ranges.
        point_time_units: The units that it takes; empty if its adapter converts all.
        point_time_references: What the times may count from; empty if its adapter converts all.
        point_orders: The orders of points that it takes; empty for any.
    """

    point_time: LidarNeed = LidarNeed.OPTIONAL
    ring: LidarNeed = LidarNeed.IGNORED
    organised: LidarNeed = LidarNeed.IGNORED
    point_time_units: tuple[TimeUnit, ...] = ()
    point_time_references: tuple[TimeReference, ...] = ()
    point_orders: tuple[PointOrder, ...] = ()

    def check(self, sensor: Sensor, algorithm: str, dataset: str) -> None:
        """Raise InvalidInput if ``sensor`` of ``dataset`` does not give ``algorithm`` what it needs."""
        layout = LidarLayout.of(sensor)
        problem = self._lacks(layout) or self._unfit(layout)
        if problem is not None:
            needed, found = problem
            raise InvalidInput(
                f"{algorithm} needs {needed}; {sensor.name} of dataset {dataset} {found}",
                "choose another dataset or algorithm, or correct the calibration of the sensor in dataset.yaml",
            )

    def _lacks(self, layout: LidarLayout) -> tuple[str, str] | None:
        if self.point_time is LidarNeed.REQUIRED and not layout.times.field:
            return "a time for each point", "has none"
        if self.ring is LidarNeed.REQUIRED and not layout.ring_field:
            return "the ring of each point", "has none"
        if self.organised is LidarNeed.REQUIRED and not layout.organised:
            return "organised scans", "has a list of points"
        return None

    def _unfit(self, layout: LidarLayout) -> tuple[str, str] | None:
        unit, reference, order = layout.times.unit, layout.times.reference, layout.point_order
        timed = bool(layout.times.field) and self.point_time is not LidarNeed.IGNORED
        if timed and self.point_time_units and unit not in self.point_time_units:
            return f"point times in {_or(self.point_time_units)}", f"has them in {unit}"
        if timed and self.point_time_references and reference not in self.point_time_references:
            return f"point times relative to {_or(self.point_time_references)}", f"has them relative to {reference}"
        if self.point_orders and order not in self.point_orders:
            return f"points in the order {_or(self.point_orders)}", f"has {order or 'an unknown order'}"
        return None


def _or(choices: tuple[StrEnum, ...]) -> str:
    return " or ".join(choices)


_SHORT_LICENCE = 30


@dataclass(frozen=True, slots=True)
class Input:
    """One sensor that an algorithm listens to, under a role of its own (``left``, ``depth``, ``points``, ``imu``)."""

    role: str
    kind: SensorKind


class RunUser(StrEnum):
    """User of a run inside its container."""

    WORKER = "worker"
    """The user and group of the worker; ``HOME`` is ``/tmp``."""
    ROOT = "root"
    """Root without capabilities; ``HOME`` is what the image says."""
    IMAGE = "image"
    """The user that the image names, without capabilities; ``HOME`` is what the image says."""

    @property
    def in_words(self) -> str:
        """The user in a line of text."""
        words = {RunUser.WORKER: "the worker's user", RunUser.ROOT: "root without capabilities"}
        return words.get(self, "the user of the image, without capabilities")


ROS1_SUFFIX = ".bag"


class Base(StrEnum):
    """Base of a package's image, which decides who plays the recording."""

    PYTHON = "python"
    """The runtime plays any recording, in real time or sequentially."""
    ROS1 = "ros1"
    """``rosbag play`` plays ROS 1 bags, in real time."""


@dataclass(frozen=True, slots=True)
class AlgorithmPackage:
    """One folder below ``algorithms/``: code, image and provenance shared by all modes of an upstream project.

    ``standard_image``: its image is made by the Dockerfile that packages with this base share. ``reports_tracking``:
    while it runs it says for how long it has found no pose (``progress.json``). ``user``: who its runs are in a
    container. ``base``: what its image is based on. ``map_output``: the file in the result with the map that another
    run of the same algorithm can start with; it is there if the run saves its map. ``playback``: how recordings can be
    played. ``gpu``: whether its runs get a GPU. ``shm_mb``: size of ``/dev/shm`` in its containers, None for the
    default of the engine. ``time_factor``: the time limit of its runs is at least this many times the duration of the
    recording. ``origin``: where it was imported from; None for a package that was written for SLAM Hive.
    ``pinned_image``: the image that was built elsewhere and that its runs use; None for others.
    """

    name: str
    folder: Path
    title: str
    version: str
    upstream: str
    licence: str
    citation: str
    standard_image: bool = False
    system_packages: tuple[str, ...] = ()
    system_libraries: tuple[str, ...] = ()
    cpu_cores: float = 2.0
    memory_mb: int = 4096
    reports_tracking: bool = False
    base: Base = Base.PYTHON
    user: RunUser = RunUser.WORKER
    map_output: str | None = None
    playback: tuple[PlaybackMode, ...] = tuple(PlaybackMode)
    gpu: GpuNeed = GpuNeed.NONE
    shm_mb: int | None = None
    time_factor: float = 0.0
    origin: PackageOrigin | None = None
    weights: tuple[Weights, ...] = ()
    pinned_image: PinnedImage | None = None

    @property
    def image(self) -> str:
        """The Docker image that holds this package."""
        return f"slam-hive-algorithm:{self.name}" if self.pinned_image is None else self.pinned_image.reference

    @property
    def short_licence(self) -> str:
        """The licence for lists: without what stands in brackets, and cut after 30 characters."""
        text = " ".join(re.sub(r"\s*\([^()]*\)", "", self.licence).split()) or self.licence
        return text if len(text) <= _SHORT_LICENCE else f"{text[: _SHORT_LICENCE - 1].rstrip(' ,;')}…"

    def check_recording(self, dataset: Dataset) -> None:
        """Raise InvalidInput if the package cannot play the format of the recording of ``dataset``."""
        if self.base is Base.ROS1 and not dataset.bag.endswith(ROS1_SUFFIX):
            raise InvalidInput(
                f"{self.name} plays ROS 1 bags, dataset {dataset.name} holds {dataset.bag}",
                f"make one: slamhive dataset export {dataset.name} --format ros1",
            )

    def check_playback(self, playback: Playback) -> None:
        """Raise InvalidInput if the package cannot be played in this way."""
        if self.base is Base.ROS1 and playback.mode is not PlaybackMode.REALTIME:
            raise InvalidInput(
                f"{self.name} cannot be played {playback.mode}: ROS 1 systems take messages when they come",
                "play it realtime, with a low rate if it is too slow",
            )
        if playback.mode not in self.playback:
            supported = " or ".join(self.playback)
            problem = f"{self.name} takes {supported} playback only, not {playback.mode}"
            raise InvalidInput(problem, f"choose {supported} playback")


@dataclass(frozen=True, slots=True)
class Algorithm:
    """A runnable algorithm: a package in one mode.

    ``trajectory_role`` names the input whose frame the poses in ``traj.txt`` describe. ``bounds`` is what its runs
    keep on some datasets, in the order of ``algorithm.yaml``. ``topics`` says how it learns of the topic of a role; a
    role that is not in it is played as ``/<role>``. ``requires`` is what must be known of the sensors.
    ``version`` is the number of the version of the package, None for the package as it is now. ``map_input``: it can
    start with the map of another run. ``lidar``: what it needs of the points of a LiDAR.
    ``trajectory`` says which trajectory ``traj.txt`` is, and ``pose_time`` at which instant its poses hold; None if the
    package does not.
    """

    name: str
    package: AlgorithmPackage
    mode: str
    title: str
    setup: SensorSetup
    inputs: tuple[Input, ...]
    trajectory_role: str
    parameters: tuple[Parameter, ...]
    bounds: tuple[Bound, ...] = ()
    topics: tuple[TopicOf, ...] = ()
    requires: tuple[Requirement, ...] = ()
    trajectory: TrajectoryKind | None = None
    pose_time: PoseTime | None = None
    version: int | None = None
    map_input: bool = False
    lidar: LidarNeeds = field(default_factory=LidarNeeds)

    @property
    def label(self) -> str:
        """Name that users ask for it by: ``aloam``, or ``aloam@2`` for a version."""
        return self.name if self.version is None else version_label(self.name, self.version)

    @property
    def unknown(self) -> tuple[str, ...]:
        """List, in words, what an import did not find and nobody has filled in since."""
        texts = {"upstream": self.package.upstream, "licence": self.package.licence, "citation": self.package.citation}
        missing = [key for key, text in texts.items() if text == UNKNOWN]
        if self.package.origin is not None:
            known = {topic.role for topic in self.topics}
            missing += [f"topic of {entry.role}" for entry in self.inputs if entry.role not in known]
        return (*missing, *(f"default of {entry.key}" for entry in self.parameters if entry.must_be_given))

    def assign(self, dataset: Dataset, chosen: Chosen = BY_RULE) -> dict[str, Sensor]:
        """Assign sensors of ``dataset`` to roles: as ``chosen``, the others in the dataset's order.

        Raises NotFound or InvalidInput, before anything starts, if a choice makes no sense. The same goes for a dataset
        that lacks a recording, a sensor, or calibration that the algorithm requires.
        """
        dataset.check_recorded()
        self.package.check_recording(dataset)
        fitting = self.fitting(dataset)
        check_choice(self.name, dataset.name, fitting, chosen)
        assigned: dict[str, Sensor] = {}
        for kind in SensorKind:
            roles = {entry.role: fitting[entry.role] for entry in self.inputs if entry.kind is kind}
            available = dataset.of_kind(kind)
            if len(roles) > len(available):
                has = ", ".join(f"{sensor.name} ({sensor.kind})" for sensor in dataset.sensors) or "no sensors"
                raise InvalidInput(
                    f"{self.name} needs {len(roles)} {kind} sensor{'s' if len(roles) > 1 else ''}, "
                    f"dataset {dataset.name} has {len(available)} ({has})",
                    "choose a dataset that has them, or an algorithm that needs less",
                )
            assigned |= assign_in_order(roles, available, chosen)
        for role, sensor in assigned.items():
            self._check_fits(role, sensor, dataset)
        return {entry.role: assigned[entry.role] for entry in self.inputs}

    def fitting(self, dataset: Dataset) -> dict[str, tuple[Sensor, ...]]:
        """The sensors of ``dataset`` that can serve each role."""
        return {
            entry.role: tuple(
                sensor for sensor in dataset.of_kind(entry.kind) if self._fits(entry.role, sensor, dataset)
            )
            for entry in self.inputs
        }

    def stated_choice(self, dataset: Dataset, chosen: Chosen) -> dict[str, str]:
        """``chosen`` as it is stored: nothing if the rule gives the same, else each role of those kinds.

        Raises as :meth:`assign`.
        """
        if not chosen:
            return {}
        by_rule, asked = self.assign(dataset), self.assign(dataset, chosen)
        kinds = {sensor.kind for role, sensor in asked.items() if sensor != by_rule[role]}
        return {role: sensor.name for role, sensor in asked.items() if sensor.kind in kinds}

    def _fits(self, role: str, sensor: Sensor, dataset: Dataset) -> bool:
        try:
            self._check_fits(role, sensor, dataset)
        except InvalidInput:
            return False
        return True

    def _check_fits(self, role: str, sensor: Sensor, dataset: Dataset) -> None:
        if sensor.kind is SensorKind.LIDAR:
            self.lidar.check(sensor, self.name, dataset.name)
        own = [entry for entry in self.requires if entry.source.role == role]
        check_requirements(own, sensor, self.name, dataset.name)


# Algorithms that are known by imported trajectories only. They have a name and a sensor setup.


IMPORTED = "imported"
"""The executor of imported runs."""

EXTERNAL_PACKAGE = "(imported)"
"""The package of algorithms that have none; no real package can have this name. Their mode is their setup."""


def external_algorithm(name: str, setup: SensorSetup) -> Algorithm:
    """The algorithm called ``name``, whose trajectories describe the body. It cannot be run."""
    package = AlgorithmPackage(
        name=EXTERNAL_PACKAGE, folder=Path(), title=name, version="", upstream="", licence="", citation=""
    )
    return Algorithm(
        name=name,
        package=package,
        mode=setup.value,
        title=name,
        setup=setup,
        inputs=(),
        trajectory_role="",
        parameters=(),
    )
