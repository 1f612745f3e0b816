"""The protocols that give a number which a paper prints: all combinations of the rules that tools use.

Alignment, association, frame, crop, trajectory and statistic are varied. Those that give the same pairs and so the same
errors cannot be told apart, and are one match.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.claim import MetricFamily, Printed, PrintedUnit
from slamhive.domain.protocol import Alignment, Association, Duplicates, Protocol, RpePairs, TrajectoryKind
from slamhive.domain.sensors import Matrix4
from slamhive.evaluation.evaluators.base import Evaluator, Paired
from slamhive.evaluation.evaluators.relative import DistanceErrors, RelativeErrors
from slamhive.evaluation.evaluators.segments import KittiProtocol, SegmentErrors
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.presets import PRESETS
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.alignment import align
from slamhive.trajectory.model import FloatArray, Poses, Trajectory
from slamhive.trajectory.transforms import rotation_angles_rad

_FACTORS = {PrintedUnit.CM: 100.0, PrintedUnit.MM: 1000.0}


@dataclass(frozen=True, slots=True, eq=False)
class SearchInput:
    """Everything that protocols of a run can compare.

    Attributes:
        reference_of: Gives the ground truth in the frame of the estimate, for a T_body_sensor; None: as stated.
        estimates: The trajectories that the run left; None is ``traj.txt``.
        frames: {name: T_body_sensor} of other frames that the estimate may describe.
        gravity_aligned: The z axis of the ground truth points up.
        files: Other files of run and dataset by name.
    """

    reference_of: Callable[[Matrix4 | None], TruthReference]
    estimates: Mapping[TrajectoryKind | None, Trajectory]
    frames: Mapping[str, Matrix4]
    gravity_aligned: bool
    files: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ProtocolMatch:
    """A protocol that gives the printed number.

    Attributes:
        protocol: The most usual of those that cannot be told apart.
        key: The metric.
        unit: The unit in which it gives the printed number.
        value: The metric in that unit, with all digits.
        preset: Name of the tool whose rules these are; None if of none.
        rarity: How unusual it is: 0 for what most papers use.
        words: What distinguishes it, in words.
        alike: Other protocols with the same value to nine digits, in words.
    """

    protocol: Protocol
    key: str
    unit: PrintedUnit
    value: float
    preset: str | None
    rarity: int
    words: str
    alike: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ProtocolSearch:
    """The matches, the most usual first, and how many combinations were tried; ``skipped``: why others were not."""

    matches: tuple[ProtocolMatch, ...]
    tried: int
    skipped: Mapping[str, int]


_STATISTICS: Mapping[str, tuple[int, Callable[[FloatArray], float]]] = {
    "rmse": (0, lambda errors: float(np.sqrt(np.mean(errors**2)))),
    "mean": (1, lambda errors: float(errors.mean())),
    "median": (2, lambda errors: float(np.median(errors))),
    "max": (4, lambda errors: float(errors.max())),
    "std": (4, lambda errors: float(errors.std())),
}

_ASSOCIATIONS: tuple[tuple[int, Mapping[str, object]], ...] = (
    (0, {"association": Association.NEAREST, "association_tolerance_s": 0.01}),
    (1, {"association": Association.ONE_TO_ONE, "association_tolerance_s": 0.02}),
    (1, {"association": Association.NEAREST, "association_tolerance_s": 0.02}),
    (2, {"association": Association.SWEEP, "association_tolerance_s": 0.02}),
    (2, {"association": Association.INTERPOLATE}),
    (2, {"association": Association.HOLD, "hold_interval_s": 1 / 75}),
    (3, {"association": Association.HOLD}),
    (2, {"association": Association.INDEX}),
    (3, {"association": Association.INTERPOLATE_ESTIMATE}),
    (3, {"association": Association.NEAREST, "association_tolerance_s": 0.05}),
)
_ALIGNMENTS: tuple[tuple[int, Alignment, int | None], ...] = (
    (0, Alignment.SE3, None),
    (0, Alignment.SIM3, None),
    (1, Alignment.YAW_POSITION, None),
    (2, Alignment.FIRST_POSE, None),
    (2, Alignment.NONE, None),
    (3, Alignment.SCALE, None),
    (4, Alignment.SE3, 100),
    (4, Alignment.SIM3, 100),
    (4, Alignment.YAW_POSITION, 1),
)
_CROPS_S = ((0, 0.0), (3, 5.0), (4, 10.0))
_KINDS = {None: 0, TrajectoryKind.FINAL: 1, TrajectoryKind.KEYFRAMES: 1, TrajectoryKind.LIVE: 2}
_FRAME_RARITY = 3
_SAME = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A protocol, how unusual it is, and the name of its frame."""

    protocol: Protocol
    rarity: int
    frame: str


def search_protocols(found: SearchInput, printed: Printed, family: MetricFamily) -> ProtocolSearch:
    """All combinations that give the printed number, the most usual first.

    Args:
        found: What can be compared.
        printed: The number.
        family: What the paper calls it.
    """
    measured: list[tuple[_Candidate, str, PrintedUnit, float]] = []
    skipped: dict[str, int] = {}
    tried = 0
    for candidate, reference, estimate in _pairings(found, family):
        try:
            paired = pair(reference, estimate, candidate.protocol, found.files)
        except InvalidInput as error:
            skipped[error.message] = skipped.get(error.message, 0) + 1
            continue
        for aligned, rarity, key, unit, value in _values(paired, found, family):
            tried += 1
            if printed.unit in (None, unit) and printed.shows(value):
                more = replace(candidate, protocol=aligned, rarity=candidate.rarity + rarity)
                measured.append((more, key, unit, value))
    return ProtocolSearch(tuple(_grouped(measured)), tried, skipped)


def _pairings(found: SearchInput, family: MetricFamily) -> Iterator[tuple[_Candidate, TruthReference, Trajectory]]:
    """Everything but alignment and statistic; errors that few crop are not cropped."""
    frames: dict[str, Matrix4 | None] = {"": None, **found.frames}
    crops = _CROPS_S if family in (MetricFamily.ATE, MetricFamily.ATE_ROT) else _CROPS_S[:1]
    for kind, estimate in found.estimates.items():
        for frame, T_body_sensor in frames.items():
            reference = found.reference_of(T_body_sensor)
            start_s = float(reference.trajectory.stamps_s[0])
            for rare, crop_s in crops:
                for unusual, values in _ASSOCIATIONS:
                    if crop_s and values["association"] is Association.INDEX:
                        continue
                    content: dict[str, object] = {
                        **values,
                        "duplicates": Duplicates.KEEP,
                        "trajectory": kind,
                        "T_body_sensor": T_body_sensor,
                        "leave_out_s": (start_s, start_s + crop_s) if crop_s else (),
                    }
                    rarity = _KINDS[kind] + (_FRAME_RARITY if frame else 0) + rare + unusual
                    yield _Candidate(Protocol(Alignment.NONE, **content), rarity, frame), reference, estimate  # type: ignore[arg-type]


Value = tuple[Protocol, int, str, PrintedUnit, float]
"""The protocol with its alignment, how unusual that is, the metric, its unit and its value."""


def _values(paired: Paired, found: SearchInput, family: MetricFamily) -> Iterator[Value]:
    """All numbers of the family that the pairs give, under every alignment."""
    for rarity, alignment, first in _ALIGNMENTS:
        if alignment is Alignment.YAW_POSITION and not found.gravity_aligned:
            continue
        try:
            transform = align(alignment, paired.matched_estimate, paired.matched_reference, first)
        except InvalidInput:
            continue
        protocol = replace(paired.protocol, alignment=alignment, align_poses=first)
        if (first == 1 or alignment is Alignment.FIRST_POSE) and not paired.rotations_known:
            continue
        aligned = transform.poses(paired.matched_estimate)
        if family in (MetricFamily.ATE, MetricFamily.ATE_ROT):
            for extra, key, unit, value in _absolute(paired, aligned, family):
                yield protocol, rarity + extra, key, unit, value
        elif alignment in _RELATIVE_ALIGNMENTS and first is None:
            moved = replace(
                paired, aligned=aligned, transform=transform, aligned_estimate=transform.poses(paired.estimate)
            )
            for changed, extra, key, unit, value in _relative(moved, protocol, family):
                yield changed, rarity + extra, key, unit, value


_RELATIVE_ALIGNMENTS = (Alignment.SE3, Alignment.SIM3)
"""A rigid alignment does not change relative errors, so one of them stands for all."""


def _absolute(paired: Paired, aligned: Poses, family: MetricFamily) -> Iterator[tuple[int, str, PrintedUnit, float]]:
    if family is MetricFamily.ATE_ROT:
        if not paired.rotations_known:
            return
        errors = np.rad2deg(rotation_angles_rad(paired.matched_reference.quats_xyzw, aligned.quats_xyzw))
    else:
        errors = np.linalg.norm(aligned.positions_m - paired.matched_reference.positions_m, axis=1)
    path_m = paired.matched_reference.path_length_m
    for name, (rarity, statistic) in _STATISTICS.items():
        value = statistic(errors)
        if family is MetricFamily.ATE_ROT:
            yield rarity, f"ate_rot.{name}", PrintedUnit.DEG, value
            continue
        yield rarity, f"ate.{name}", PrintedUnit.M, value
        for unit, factor in _FACTORS.items():
            yield rarity + 1, f"ate.{name}", unit, factor * value
        if name in ("rmse", "mean") and path_m > 0:
            yield rarity + 2, f"ate.{name}", PrintedUnit.PERCENT, 100.0 * value / path_m


def _relative(paired: Paired, protocol: Protocol, family: MetricFamily) -> Iterator[Value]:
    rules: Sequence[tuple[int, RpePairs]] = ((0, RpePairs.ALL), (0, RpePairs.CONSECUTIVE), (1, RpePairs.TUM))
    if family not in (MetricFamily.RPE, MetricFamily.RPE_ROT):
        rules = rules[:1]
    for rarity, rule in rules:
        changed = replace(protocol, rpe_pairs=rule)
        for evaluator in _EVALUATORS[family]:
            try:
                values = evaluator.evaluate(replace(paired, protocol=changed)).values
            except InvalidInput:
                continue  # this metric does not exist for these pairs, as KITTI's without every frame
            for key, value in values.items():
                extra = 0 if key.rsplit(".", 1)[1] in _USUAL_ENDINGS else 1
                for unit, factor in _units_of(family, key):
                    yield changed, rarity + extra, key, unit, factor * value


_EVALUATORS: Mapping[MetricFamily, tuple[Evaluator, ...]] = {
    MetricFamily.RPE: (RelativeErrors(), DistanceErrors()),
    MetricFamily.RPE_ROT: (RelativeErrors(),),
    MetricFamily.KITTI: (KittiProtocol(),),
    MetricFamily.SEGMENT: (SegmentErrors(),),
}
_USUAL_ENDINGS = ("rmse", "translation", "rotation")


def _units_of(family: MetricFamily, key: str) -> Sequence[tuple[PrintedUnit, float]]:
    """The units in which the metric is printed, with the factor from its own; none if it is not of the family."""
    first, second = key.split(".")[:2]
    if key.endswith(".pairs"):
        return ()
    if family is MetricFamily.RPE and first in ("rpe", "rpe_point"):
        return ((PrintedUnit.M, 1.0), *_FACTORS.items())
    if family is MetricFamily.RPE_ROT and first == "rpe_rot":
        return ((PrintedUnit.DEG, 1.0),)
    if family in (MetricFamily.KITTI, MetricFamily.SEGMENT):
        unit = {"translation": PrintedUnit.PERCENT, "rotation": PrintedUnit.DEG_PER_M}.get(second)
        return () if unit is None else ((unit, 1.0),)
    return ()


def _grouped(measured: Sequence[tuple[_Candidate, str, PrintedUnit, float]]) -> list[ProtocolMatch]:
    """The matches, those of one value together, the most usual first."""
    groups: dict[tuple[str, PrintedUnit, float], list[_Candidate]] = {}
    for candidate, key, unit, value in measured:
        known = next((k for k in groups if k[:2] == (key, unit) and abs(k[2] - value) <= _SAME * max(1.0, value)), None)
        groups.setdefault(known or (key, unit, value), []).append(candidate)
    matches = []
    for (key, unit, value), candidates in groups.items():
        ranked = sorted(candidates, key=lambda entry: entry.rarity)
        first, others = ranked[0], ranked[1:]
        names = [name for entry in ranked if (name := _preset_of(entry, key)) is not None]
        alike = tuple(dict.fromkeys(_words(entry) for entry in others))
        preset = names[0] if names else None
        matches.append(ProtocolMatch(first.protocol, key, unit, value, preset, first.rarity, _words(first), alike))
    return sorted(matches, key=lambda match: (match.rarity, match.preset is None, match.key))


def _words(candidate: _Candidate) -> str:
    frame = f", frame of {candidate.frame}" if candidate.frame else ""
    return f"{candidate.protocol.label}{frame}"


def _preset_of(candidate: _Candidate, key: str) -> str | None:
    """The tool that computes this metric by these rules, None if there is none."""
    asked = candidate.protocol
    if candidate.frame or asked.leave_out_s or asked.align_poses is not None:
        return None
    for name, preset in PRESETS:
        rules = preset.protocol
        tolerance = rules.association in _BY_TOLERANCE
        if (
            key in preset.metrics
            and (rules.alignment, rules.association) == (asked.alignment, asked.association)
            and (not tolerance or rules.association_tolerance_s == asked.association_tolerance_s)
            and rules.hold_interval_s == asked.hold_interval_s
            and (not key.startswith("rpe") or rules.rpe_pairs is asked.rpe_pairs)
        ):
            return name
    return None


_BY_TOLERANCE = (Association.NEAREST, Association.ONE_TO_ONE, Association.SWEEP)
