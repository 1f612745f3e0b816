"""An evaluation protocol: everything a trajectory error depends on besides the two trajectories."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

from slamhive.domain.sensors import Matrix4, SensorSetup, is_rigid
from slamhive.errors import InvalidInput, nearest


class Alignment(StrEnum):
    """How the estimate is moved onto the ground truth before errors are taken."""

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
    """Which pose of the ground truth answers to which of the estimate.

    ``nearest``: each pose of the shorter list takes the nearest of the other, which may be taken twice (as evo does).
    ``one_to_one``: pairs by growing gap, each pose once (as TUM does). ``sweep``: each pose of the estimate in turn
    takes the nearest pose of the ground truth after the last one taken (as OpenVINS does). ``interpolate``: the ground
    truth at the estimate's timestamps, between neighbours. ``hold``: the estimate at the ground truth's timestamps, its
    last pose held where it pauses or has ended, so that lost tracking counts (as ETH3D does). ``index``: by position in
    the files, timestamps unused (as KITTI does).
    """

    NEAREST = "nearest"
    ONE_TO_ONE = "one_to_one"
    SWEEP = "sweep"
    INTERPOLATE = "interpolate"
    HOLD = "hold"
    INDEX = "index"


class RpePairs(StrEnum):
    """Which pairs of poses a relative error is taken over.

    ``all``: all matched poses that are a delta apart. ``consecutive``: one pair after the other (both as evo does).
    ``tum``: as TUM's ``evaluate_rpe.py --fixed_delta`` counts, from every pose of the estimate, matched or not, each
    compared with the pose of the ground truth that is nearest in time.
    """

    ALL = "all"
    CONSECUTIVE = "consecutive"
    TUM = "tum"


class SegmentRule(StrEnum):
    """How long segments are, and what their errors are divided by.

    ``matched``: shares of the path of the matched ground truth; errors over the nominal length. ``rpg``: as
    rpg_trajectory_evaluation counts, shares of the path of the whole ground truth. ``eth3d``: as ETH3D counts, errors
    over the length that a segment really has, seen from its last pose. What these tools do by mistake is part of it.
    """

    MATCHED = "matched"
    RPG = "rpg"
    ETH3D = "eth3d"


class Duplicates(StrEnum):
    """What is done with poses of one file that have the same timestamp.

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


@dataclass(frozen=True, slots=True)
class Protocol:
    """Association, time offset, alignment, reference and deltas.

    Metrics of different fingerprints are never averaged or ranked together. A field's default is part of existing
    fingerprints, so no default may change, and the default of a new field must keep the old behaviour.

    Attributes:
        alignment: How the estimate is moved onto the ground truth.
        association_tolerance_s: Largest gap between matched timestamps (nearest, one_to_one, sweep).
        gap_threshold_s: A gap in the estimate longer than this counts as tracking lost.
        rpe_delta_m: Path length between the poses of an RPE pair.
        association: Which pose answers to which.
        interpolation_interval_s: Longest interval of the ground truth that is interpolated (interpolate).
        time_offset_s: Added to the estimate's timestamps, to bring them to the ground truth's clock.
        offset_search_s: The offset is searched within this of ``time_offset_s``; 0 for no search.
        align_poses: The alignment is computed over this many first matched poses; None for all. Over one, SE(3) and
            yaw + position take its orientation too.
        T_body_sensor: Pose of the estimate's frame in the ground truth's body frame, instead of what algorithm and
            dataset say; None for that.
        reference: File of the dataset's folder to compare with instead of its ground truth; None for that.
        rpe_pairs: Which pairs the relative errors are taken over.
        rpe_delta_s: Time between the poses of a pair, for the relative error by time.
        rpe_delta_frames: Poses from one to the other of a pair, for the relative error by frames.
        rpe_delta_deg: Rotation between the poses of a pair, for the relative error by angle.
        segment_lengths_m: Path lengths of the segments; empty for 10, 20, 30, 40 and 50 % of the ground truth's path.
        segment_tolerance_m: How far a segment's length may be off; None for a fifth of it.
        duplicates: What is done with poses of one file that have the same timestamp.
        segment_rule: What path the shares are of, and what the errors of a segment are divided by.
        hold_interval_s: With the association ``hold``, poses of the ground truth count only where the next one is no
            further away than this; None for all.

    Raises:
        InvalidInput: Naming the field and the value that cannot be meant.
    """

    alignment: Alignment
    association_tolerance_s: float = 0.01
    gap_threshold_s: float = 1.0
    rpe_delta_m: float = 1.0
    association: Association = Association.NEAREST
    interpolation_interval_s: float = 0.1
    time_offset_s: float = 0.0
    offset_search_s: float = 0.0
    align_poses: int | None = None
    T_body_sensor: Matrix4 | None = None
    reference: str | None = None
    rpe_pairs: RpePairs = RpePairs.ALL
    rpe_delta_s: float = 1.0
    rpe_delta_frames: int = 1
    rpe_delta_deg: float = 10.0
    segment_lengths_m: tuple[float, ...] = ()
    segment_tolerance_m: float | None = None
    duplicates: Duplicates = Duplicates.REFUSE
    segment_rule: SegmentRule = SegmentRule.MATCHED
    hold_interval_s: float | None = None

    def __post_init__(self) -> None:
        for name, (minimum, maximum) in BOUNDS.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not minimum <= number <= maximum:
                    raise InvalidInput(f"{name} {number!r} is not allowed", f"use {minimum:g} to {maximum:g}")
            if isinstance(value, int) and name not in _COUNTS:
                object.__setattr__(self, name, float(value))  # 1 and 1.0 are one protocol
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

    @property
    def fingerprint(self) -> str:
        """First 12 hex digits of the SHA-256 of the protocol's content."""
        text = json.dumps(self.content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def content(self) -> dict[str, Any]:
        """As plain values: the first four fields, and every other one that differs from its default.

        So a field that comes to be later leaves the fingerprints as they are.
        """
        return {
            field.name: value.value if isinstance(value := getattr(self, field.name), StrEnum) else value
            for index, field in enumerate(fields(self))
            if index < _ALWAYS_IN_CONTENT or getattr(self, field.name) != field.default
        }

    @property
    def aligns_one_pose(self) -> bool:
        """Whether the alignment is that of the first matched pose, for which its orientation is needed."""
        alone = self.align_poses == 1 and self.alignment in (Alignment.SE3, Alignment.YAW_POSITION)
        return alone or self.alignment is Alignment.FIRST_POSE

    @property
    def label(self) -> str:
        """The protocol in words, for captions: what differs from the defaults is there."""
        return ", ".join(_words(self))


LONGEST_LEVER_ARM_M = 1000.0
"""A vehicle is shorter; numbers beyond it are no metres."""
MOST_SEGMENT_LENGTHS = 100
"""Every one costs a pass over the trajectory; published protocols have 4 to 8."""
_ALWAYS_IN_CONTENT = 4
_COUNTS = ("align_poses", "rpe_delta_frames")
_LARGEST_S, _LARGEST_M = 1e6, 1e9
BOUNDS = {
    "association_tolerance_s": (0.0, _LARGEST_S),
    "gap_threshold_s": (1e-3, _LARGEST_S),
    "rpe_delta_m": (1e-6, _LARGEST_M),
    "interpolation_interval_s": (1e-6, _LARGEST_S),
    "time_offset_s": (-1e10, 1e10),
    "offset_search_s": (0.0, 60.0),
    "align_poses": (1, 10**9),
    "rpe_delta_s": (1e-6, _LARGEST_S),
    "rpe_delta_frames": (1, 10**9),
    "rpe_delta_deg": (1e-3, 180.0),
    "segment_lengths_m": (1e-6, _LARGEST_M),
    "segment_tolerance_m": (1e-9, _LARGEST_M),
    "hold_interval_s": (1e-6, _LARGEST_S),
}
"""What the numbers of a protocol may be, both ends included."""


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
        if name in values:
            values[name] = _member(kind, name, values[name])
    try:
        for name in ("T_body_sensor", "segment_lengths_m"):
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
}


def _member(kind: type[StrEnum], name: str, value: str) -> StrEnum:
    try:
        return kind(value)
    except ValueError:
        raise InvalidInput(f"{name} {value!r} is not known", f"use one of {', '.join(kind)}") from None


def default_alignment(setup: SensorSetup, *, gravity_aligned: bool) -> Alignment:
    """The alignment that a sensor setup deserves: what the sensors cannot observe, and nothing more.

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
    if protocol.T_body_sensor is not None:
        words.append("own T_body_sensor")
    if protocol.reference is not None:
        words.append(f"against {protocol.reference}")
    words.append(f"RPE over {protocol.rpe_delta_m:g} m")
    if protocol.rpe_pairs is not RpePairs.ALL:
        words.append("pairs as TUM counts" if protocol.rpe_pairs is RpePairs.TUM else "consecutive pairs")
    words += _segment_words(protocol)
    if protocol.duplicates is not Duplicates.REFUSE:
        words.append(f"duplicate timestamps: {DUPLICATES_LABELS[protocol.duplicates]}")
    shown = {"alignment", "association", "align_poses", "offset_search_s", "time_offset_s", "T_body_sensor"}
    shown |= {"reference", "rpe_delta_m", "rpe_pairs", "association_tolerance_s", "interpolation_interval_s"}
    shown |= {"duplicates", "segment_lengths_m", "segment_tolerance_m", "segment_rule", "hold_interval_s"}
    for field in fields(protocol):
        value = getattr(protocol, field.name)
        if field.name not in shown and value != field.default:
            words.append(f"{field.name} {value:g}")
    return words


def _segment_words(protocol: Protocol) -> list[str]:
    words: list[str] = []
    if protocol.segment_lengths_m:
        words.append(f"segments of {'/'.join(f'{length_m:g}' for length_m in protocol.segment_lengths_m)} m")
    if protocol.segment_tolerance_m is not None:
        words.append(f"segment lengths within {protocol.segment_tolerance_m:g} m")
    if protocol.segment_rule is not SegmentRule.MATCHED:
        words.append(f"segments as {'ETH3D' if protocol.segment_rule is SegmentRule.ETH3D else 'rpg'} counts")
    return words


def _association_words(protocol: Protocol) -> str:
    if protocol.association is Association.INTERPOLATE:
        return f"ground truth interpolated over up to {protocol.interpolation_interval_s:g} s"
    if protocol.association is Association.HOLD:
        if protocol.hold_interval_s is not None:
            return f"estimate held at the ground truth's stamps with a next one within {protocol.hold_interval_s:g} s"
        return "estimate held at every stamp of the ground truth"
    if protocol.association is Association.INDEX:
        return "poses by index"
    how = {Association.ONE_TO_ONE: " one to one", Association.SWEEP: " in one sweep"}.get(protocol.association, "")
    return f"association{how} {protocol.association_tolerance_s:g} s"
