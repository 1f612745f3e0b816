"""An evaluation protocol: everything a trajectory error depends on besides the two trajectories."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any

from slamhive.base.errors import InvalidInput, nearest
from slamhive.domain.sensors import Matrix4, SensorSetup, is_rigid


class TrajectoryKind(StrEnum):
    """Moment at which the poses of a trajectory were known."""

    LIVE = "live"
    """Each pose as it was given while the recording played."""
    FINAL = "final"
    """Each frame's pose after the end, with all that was learnt later."""
    KEYFRAMES = "keyframes"
    """The poses of keyframes after the end."""

    @property
    def adjective(self) -> str:
        """Adjective that sentences put before "trajectory"."""
        return self.value.removesuffix("s")


def with_trajectory(label: str, kind: TrajectoryKind | None) -> str:
    """The label of a protocol, with the kind of the trajectory that was judged.

    It stays as it is if it names a kind itself, or if the kind is not stated (None).
    """
    named = {f"{each.adjective} trajectory" for each in TrajectoryKind}
    return label if kind is None or named.intersection(label.split(", ")) else f"{label}, {kind.adjective} trajectory"


# The instant that the poses of an algorithm describe.


class PoseTime(StrEnum):
    """The time convention of a trajectory: the instant at which its poses hold, which is their timestamp."""

    MESSAGE = "message"
    SWEEP_START = "sweep_start"
    SWEEP_MIDDLE = "sweep_middle"
    SWEEP_END = "sweep_end"

    @property
    def words(self) -> str:
        """Phrase that follows "a pose holds"."""
        if self is PoseTime.MESSAGE:
            return "at the timestamp of its image or scan"
        return f"at the {self.removeprefix('sweep_')} of its sweep"


# An evaluation protocol: everything a trajectory error depends on besides the two trajectories.


# The choices of an evaluation protocol.


class Alignment(StrEnum):
    """Alignment of the estimate with the ground truth before errors are taken."""

    NONE = "none"
    FIRST_POSE = "first_pose"
    SE3 = "se3"
    SIM3 = "sim3"
    YAW_POSITION = "yaw_position"
    SCALE = "scale"


ALIGNMENT_LABELS = {
    Alignment.NONE: "no alignment",
    Alignment.FIRST_POSE: "first pose",
    Alignment.SE3: "SE(3)",
    Alignment.SIM3: "Sim(3)",
    Alignment.YAW_POSITION: "yaw + position",
    Alignment.SCALE: "scale only",
}


class Association(StrEnum):
    """Rule that matches poses of the ground truth with poses of the estimate.

    ``nearest``: each pose of the shorter list takes the nearest of the other, which may be taken twice (as evo does).
    ``one_to_one``: the closest pairs first, each pose once (as TUM does). ``sweep``: each pose of the estimate in turn
    takes the nearest pose of the ground truth after the last one taken (as OpenVINS does). ``interpolate``: the ground
    truth is interpolated at the timestamps of the estimate. ``interpolate_estimate``: the estimate is interpolated at
    the timestamps of the ground truth, for a truth that is sparse. ``hold``: the estimate is compared at the timestamps
    of the ground truth. Its last pose is held in gaps and after its end, so that lost tracking counts (as ETH3D does).
    ``index``: by place in the files, without timestamps (as KITTI does).
    """

    NEAREST = "nearest"
    ONE_TO_ONE = "one_to_one"
    SWEEP = "sweep"
    INTERPOLATE = "interpolate"
    INTERPOLATE_ESTIMATE = "interpolate_estimate"
    HOLD = "hold"
    INDEX = "index"


class RpePairs(StrEnum):
    """Pairs of poses over which a relative error is taken.

    ``all``: all matched poses that are a delta apart. ``consecutive``: one pair after the other (both as evo does).
    ``tum``: as TUM's ``evaluate_rpe.py --fixed_delta`` counts, from every pose of the estimate, matched or not, each
    compared with the pose of the ground truth that is nearest in time.
    """

    ALL = "all"
    CONSECUTIVE = "consecutive"
    TUM = "tum"


class SegmentRule(StrEnum):
    """Lengths of segments, and the divisor of their errors.

    ``matched``: shares of the path of the matched ground truth; errors over the nominal length. ``rpg``: shares of the
    path of the whole ground truth, as in rpg_trajectory_evaluation. ``eth3d``: errors over the true length of a
    segment, seen from its last pose, as in ETH3D. Mistakes of these tools are reproduced.
    """

    MATCHED = "matched"
    RPG = "rpg"
    ETH3D = "eth3d"


class FrameFit(StrEnum):
    """Constant transform between the frames of estimate and ground truth that is fitted before errors are taken.

    ``rotation``: the orientation of the one in the other. ``lever_arm``: the position. ``pose``: both. What is fitted
    no longer counts as an error, so it is reported with every evaluation.
    """

    ROTATION = "rotation"
    LEVER_ARM = "lever_arm"
    POSE = "pose"


class Duplicates(StrEnum):
    """Treatment of poses in one file that share a timestamp.

    ``refuse``: nothing is evaluated. ``first``: the first of them counts. ``mean``: one pose in their middle counts.
    ``keep``: all of them count, each as a pose of its own (as evo does).
    """

    REFUSE = "refuse"
    FIRST = "first"
    MEAN = "mean"
    KEEP = "keep"


DUPLICATES_LABELS = {
    Duplicates.REFUSE: "refused",
    Duplicates.FIRST: "the first counts",
    Duplicates.MEAN: "their mean counts",
    Duplicates.KEEP: "all count",
}


def option(default: Any, help_text: str, minimum: float | None = None, maximum: float | None = None) -> Any:
    """A field with its help in protocol files; a number also has a minimum and a maximum."""
    limits = {} if minimum is None else {"minimum": minimum, "maximum": maximum}
    return field(default=default, metadata={"help": help_text, **limits})


_LARGEST_S, _LARGEST_M = 1e6, 1e9


@dataclass(frozen=True, slots=True)
class Protocol:
    """Association, time offset, alignment, reference and deltas.

    Values of different fingerprints are never averaged or ranked together. The default of a field is part of every
    fingerprint that was ever taken. No default may therefore change, and the default of a new field has to mean what
    was done before there was the field.

    The metadata of a field is its help in protocol files, and the smallest and largest number that it takes.

    Raises:
        InvalidInput: Naming the field and a value that is not allowed.
    """

    alignment: Alignment = field(
        metadata={"help": "How the estimate is moved onto the ground truth; left out: what follows from the sensors."}
    )
    association_tolerance_s: float = option(0.01, "Largest gap between matched timestamps (s)", 0.0, _LARGEST_S)
    gap_threshold_s: float = option(1.0, "A longer gap in the estimate counts as lost tracking (s)", 1e-3, _LARGEST_S)
    rpe_delta_m: float = option(1.0, "Path length between the poses of an RPE pair (m)", 1e-6, _LARGEST_M)
    association: Association = option(
        Association.NEAREST, "Which pose of the ground truth is matched with which of the estimate; default nearest."
    )
    interpolation_interval_s: float = option(
        0.1, "Longest interval that is interpolated, of the ground truth or of the estimate (s)", 1e-6, _LARGEST_S
    )
    time_offset_s: float = option(0.0, "Added to the timestamps of the estimate (s)", -1e10, 1e10)
    offset_search_s: float = option(0.0, "Search the offset within this of time_offset_s; 0: no search (s)", 0.0, 60.0)
    align_poses: int | None = option(
        None, "Align over this many first matched poses; over one, by its orientation too (1)", 1, 10**9
    )
    T_body_sensor: Matrix4 | None = option(
        None,
        "Pose of the estimate's frame in the ground truth's body frame, 16 numbers by rows, metres; "
        "instead of what algorithm and dataset say.",
    )
    reference: str | None = option(None, "File in the dataset's folder to compare with, instead of its ground truth.")
    rpe_pairs: RpePairs = option(RpePairs.ALL, "Over which pairs the relative errors are taken; default all.")
    rpe_delta_s: float = option(1.0, "Time between the poses of an RPE pair (s)", 1e-6, _LARGEST_S)
    rpe_delta_frames: int = option(1, "Poses from one to the other of an RPE pair (frames)", 1, 10**9)
    rpe_delta_deg: float = option(10.0, "Rotation between the poses of an RPE pair (deg)", 1e-3, 180.0)
    segment_lengths_m: tuple[float, ...] = option(
        (), "Path lengths of the segments, growing; left out: 10 to 50 % of the path (m)", 1e-6, _LARGEST_M
    )
    segment_tolerance_m: float | None = option(
        None, "How far a segment's length may be off; left out: a fifth of it (m)", 1e-9, _LARGEST_M
    )
    duplicates: Duplicates = option(
        Duplicates.REFUSE, "What is done with poses of one file that have the same timestamp; default refuse."
    )
    segment_rule: SegmentRule = option(
        SegmentRule.MATCHED, "What path shares are of, and what segment errors are divided by; default matched."
    )
    hold_interval_s: float | None = option(
        None, "Longest step of the ground truth that counts with hold; left out: any (s)", 1e-6, _LARGEST_S
    )

    trajectory: TrajectoryKind | None = option(
        None, "Which trajectory of a run is judged; left out: traj.txt, whatever kind the algorithm says it is."
    )

    frame_fit: FrameFit | None = option(
        None, "Constant transform between the frames of estimate and ground truth that is fitted; left out: none."
    )
    lever_arm_m: tuple[float, ...] | None = option(
        None,
        "Point in the body frame that a ground truth of positions measures, x y z, such as an antenna or a prism; "
        "instead of what the dataset says (m)",
    )
    leave_out_s: tuple[float, ...] = option(
        (), "Stretches of the ground truth that do not count: first and last timestamp of each, growing (s)"
    )

    def __post_init__(self) -> None:
        for entry in fields(self):
            if "minimum" not in entry.metadata:
                continue
            minimum, maximum = entry.metadata["minimum"], entry.metadata["maximum"]
            value = getattr(self, entry.name)
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not minimum <= number <= maximum:
                    raise InvalidInput(f"{entry.name} {number!r} is not allowed", f"use {minimum:g} to {maximum:g}")
            if isinstance(value, int) and entry.name not in _COUNTS:
                object.__setattr__(self, entry.name, float(value))  # 1 and 1.0 are one protocol
        if len(self.segment_lengths_m) > MOST_SEGMENT_LENGTHS:
            raise InvalidInput(
                f"segment_lengths_m has {len(self.segment_lengths_m)} lengths", f"give {MOST_SEGMENT_LENGTHS} at most"
            )
        if list(self.segment_lengths_m) != sorted(set(self.segment_lengths_m)):
            raise InvalidInput(f"segment_lengths_m {list(self.segment_lengths_m)} must grow", "sort them, each once")
        if self.T_body_sensor is not None and not is_rigid(self.T_body_sensor):
            raise InvalidInput(
                "T_body_sensor must be 16 numbers, row by row, that are a rotation with a translation",
                "take them from the calibration of the sensor",
            )
        if self.T_body_sensor is not None and max(map(abs, self.T_body_sensor[3:12:4])) > LONGEST_LEVER_ARM_M:
            raise InvalidInput(
                f"T_body_sensor moves by more than {LONGEST_LEVER_ARM_M:g} m", "write its translation in metres"
            )

        if self.lever_arm_m is not None:
            check_lever_arm(self.lever_arm_m, "lever_arm_m")
        stretches = list(self.leave_out_s)
        if len(stretches) % 2 or stretches != sorted(stretches) or not all(map(math.isfinite, stretches)):
            raise InvalidInput(
                f"leave_out_s {stretches} must hold two timestamps for each stretch, growing",
                "write for instance [12.5, 20, 61, 64]",
            )
        if len(stretches) > 2 * MOST_STRETCHES:
            raise InvalidInput(f"leave_out_s has {len(stretches) // 2} stretches", f"give {MOST_STRETCHES} at most")

    @property
    def fingerprint(self) -> str:
        """First 12 hex digits of the SHA-256 of the protocol's content."""
        text = json.dumps(self.content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def content(self) -> dict[str, Any]:
        """Return plain values: the first four fields, and every other one that differs from its default.

        A new field therefore does not change fingerprints.
        """
        return {
            entry.name: value.value if isinstance(value := getattr(self, entry.name), StrEnum) else value
            for index, entry in enumerate(fields(self))
            if index < _ALWAYS_IN_CONTENT or getattr(self, entry.name) != entry.default
        }

    @property
    def aligns_one_pose(self) -> bool:
        """True if the alignment is that of the first matched pose, for which its orientation is needed."""
        alone = self.align_poses == 1 and self.alignment in (Alignment.SE3, Alignment.YAW_POSITION)
        return alone or self.alignment is Alignment.FIRST_POSE

    @property
    def label(self) -> str:
        """The protocol in words, for captions; names every field that differs from its default."""
        return ", ".join(_words(self))


def check_lever_arm(arm_m: Sequence[float], name: str) -> None:
    """Raise InvalidInput, calling it ``name``, unless it is three numbers of metres that a vehicle may have."""
    if len(arm_m) != 3 or not all(map(math.isfinite, arm_m)):
        raise InvalidInput(f"{name} {list(arm_m)} must be three numbers x y z", "write the position in the body frame")
    if max(map(abs, arm_m)) > LONGEST_LEVER_ARM_M:
        raise InvalidInput(f"{name} is longer than {LONGEST_LEVER_ARM_M:g} m", "write it in metres")


MOST_STRETCHES = 100
"""A ground truth with more stretches to leave out is none."""
LONGEST_LEVER_ARM_M = 1000.0
"""A vehicle is shorter; larger numbers are not metres."""
MOST_SEGMENT_LENGTHS = 100
"""Every one costs a pass over the trajectory; published protocols have 4 to 8."""
_ALWAYS_IN_CONTENT = 4
_COUNTS = ("align_poses", "rpe_delta_frames")


def protocol_from_content(content: Mapping[str, Any]) -> Protocol:
    """The protocol with this :attr:`Protocol.content`; raises InvalidInput for what cannot be one."""
    values = dict(content)
    known = [field.name for field in fields(Protocol)]
    for name in values:
        if name not in known:
            raise InvalidInput(f"a protocol has no field {name!r}; {nearest(name, known)}")
    if "alignment" not in values:
        raise InvalidInput("a protocol needs an alignment", f"use one of {', '.join(Alignment)}")
    for name, kind in _ENUMS.items():
        if name in values and (name not in _OPTIONAL_ENUMS or values[name] is not None):
            values[name] = _member(kind, name, values[name])
    try:
        for name in ("T_body_sensor", "segment_lengths_m", "lever_arm_m", "leave_out_s"):
            if values.get(name) is not None:
                values[name] = tuple(float(number) for number in values[name])
        if not isinstance(values.get("reference"), str | None):
            raise InvalidInput(f"reference {values['reference']!r} is not the name of a file")
        return Protocol(**values)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"a field of the protocol has a type that is not allowed: {error}") from None


_ENUMS: dict[str, type[StrEnum]] = {
    "alignment": Alignment,
    "association": Association,
    "rpe_pairs": RpePairs,
    "duplicates": Duplicates,
    "segment_rule": SegmentRule,
    "trajectory": TrajectoryKind,
    "frame_fit": FrameFit,
}
_OPTIONAL_ENUMS = {"trajectory", "frame_fit"}


def _member(kind: type[StrEnum], name: str, value: str) -> StrEnum:
    try:
        return kind(value)
    except ValueError:
        raise InvalidInput(f"{name} {value!r} is not known", f"use one of {', '.join(kind)}") from None


def default_alignment(setup: SensorSetup, *, gravity_aligned: bool) -> Alignment:
    """The alignment for a sensor setup: it removes what the sensors cannot observe, and nothing more.

    Monocular scale is unobservable: Sim(3). Visual-inertial roll, pitch and scale are observable: yaw + position,
    provided the ground truth's z axis points up; SE(3) where it does not. SE(3) otherwise.
    """
    if setup is SensorSetup.MONO:
        return Alignment.SIM3
    inertial = setup in (SensorSetup.MONO_INERTIAL, SensorSetup.STEREO_INERTIAL)
    if inertial and gravity_aligned:
        return Alignment.YAW_POSITION
    return Alignment.SE3


def _words(protocol: Protocol) -> list[str]:
    alignment = ALIGNMENT_LABELS[protocol.alignment]
    if protocol.align_poses is not None:
        alignment += (
            " of the first pose" if protocol.align_poses == 1 else f" over the first {protocol.align_poses} poses"
        )
    words = [alignment, _association_words(protocol)]
    if protocol.offset_search_s > 0:
        around = f" around {protocol.time_offset_s:+g} s" if protocol.time_offset_s else ""
        words.append(f"time offset searched within {protocol.offset_search_s:g} s{around}")
    elif protocol.time_offset_s:
        words.append(f"time offset {protocol.time_offset_s:+g} s")
    words += _compared_words(protocol)
    words.append(f"RPE over {protocol.rpe_delta_m:g} m")
    if protocol.rpe_pairs is not RpePairs.ALL:
        words.append("pairs as TUM counts" if protocol.rpe_pairs is RpePairs.TUM else "consecutive pairs")
    if protocol.segment_lengths_m:
        words.append(f"segments of {'/'.join(f'{length_m:g}' for length_m in protocol.segment_lengths_m)} m")
    if protocol.segment_tolerance_m is not None:
        words.append(f"segment lengths within {protocol.segment_tolerance_m:g} m")
    if protocol.segment_rule is not SegmentRule.MATCHED:
        words.append(f"segments as {'ETH3D' if protocol.segment_rule is SegmentRule.ETH3D else 'rpg'} counts")
    if protocol.duplicates is not Duplicates.REFUSE:
        words.append(f"duplicate timestamps: {DUPLICATES_LABELS[protocol.duplicates]}")
    defaults = {entry.name: entry.default for entry in fields(protocol)}
    for name in ("gap_threshold_s", "rpe_delta_s", "rpe_delta_frames", "rpe_delta_deg"):
        if getattr(protocol, name) != defaults[name]:
            words.append(f"{name} {getattr(protocol, name):g}")
    return words


def _compared_words(protocol: Protocol) -> list[str]:
    words = [] if protocol.T_body_sensor is None else ["own T_body_sensor"]
    if protocol.lever_arm_m is not None:
        words.append("own lever arm")
    if protocol.frame_fit is not None:
        words.append(f"{protocol.frame_fit.replace('_', ' ')} of the frame fitted")
    if protocol.leave_out_s:
        pairs = zip(protocol.leave_out_s[::2], protocol.leave_out_s[1::2], strict=True)
        words.append(f"without {' and '.join(f'{begin:.3f} to {end:.3f} s' for begin, end in pairs)}")
    if protocol.trajectory is not None:
        words.append(f"{protocol.trajectory.adjective} trajectory")
    if protocol.reference is not None:
        words.append(f"against {protocol.reference}")
    return words


def _association_words(protocol: Protocol) -> str:
    if protocol.association is Association.INTERPOLATE:
        return f"ground truth interpolated over up to {protocol.interpolation_interval_s:g} s"
    if protocol.association is Association.INTERPOLATE_ESTIMATE:
        return f"estimate interpolated over up to {protocol.interpolation_interval_s:g} s"
    if protocol.association is Association.HOLD:
        if protocol.hold_interval_s is not None:
            within = f"with a next one within {protocol.hold_interval_s:g} s"
            return f"estimate held at the ground truth's timestamps {within}"
        return "estimate held at every timestamp of the ground truth"
    if protocol.association is Association.INDEX:
        return "poses by index"
    how = {Association.ONE_TO_ONE: " one to one", Association.SWEEP: " in one sweep"}.get(protocol.association, "")
    return f"association{how} {protocol.association_tolerance_s:g} s"


# A request for a protocol. Fields that it leaves out follow from the sensors.


@dataclass(frozen=True, slots=True)
class ProtocolRequest:
    """Some fields of a protocol, or all.

    Attributes:
        values: {field of :class:`Protocol`: value}, as plain values.
        name: What to call it in messages: a preset, a file, an option.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    def on(self, default: Protocol) -> Protocol:
        """``default`` with the values of the request; raises InvalidInput for what cannot be one."""
        try:
            return protocol_from_content({**default.content, **self.values})
        except InvalidInput as error:
            where = f"protocol {self.name}: " if self.name else ""
            raise InvalidInput(f"{where}{error.message}", error.remedy) from None


def exactly(protocol: Protocol, name: str) -> ProtocolRequest:
    """The request for ``protocol`` as it is, defaults of settings and sensors set aside."""
    every = {entry.name: entry.default for entry in fields(Protocol) if entry.name != "alignment"}
    return ProtocolRequest({**every, **protocol.content}, name)
