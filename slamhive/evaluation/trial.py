"""Ground truth on trial: stretches where systems agree with each other and contradict it.

Systems drift, so positions are compared within short windows, in which each system is aligned to the ground truth by
Sim(3) of its own. What the systems then have in common contradicts the ground truth; what they do not have in common
is their own error. The alignment takes up a scale or a heading that is wrong for all of them, as of one calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamhive.documents.catalogue import ConstantOffsetDocument, ContradictionDocument
from slamhive.domain.dataset import Blame
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.transforms import interpolate, rotations_from_quats

BoolArray = npt.NDArray[np.bool_]

FEWEST_SYSTEMS = 3
"""Two systems that agree may be wrong together; of two that do not, nobody knows which is wrong."""
RATE_HZ = 20.0
LONGEST_GAP_S = 0.5
"""A system counts where its poses are no further apart: keyframes are too rare to interpolate."""
LEAST_COVERAGE = 0.3
"""A system that has poses in a smaller share of the ground truth's time takes no part."""
_SCALE_WITHIN = 0.15
"""The scale of a window may differ from that of the whole by this share; more would explain contradictions away."""


@dataclass(frozen=True, slots=True)
class Scale:
    """A length of windows, and what the common residual has to exceed there.

    Attributes:
        window_s: Length of a window.
        over_own: Times the residual that the systems do not have in common.
        over_usual: Times the median common residual of all windows of this length.
    """

    window_s: float
    over_own: float
    over_usual: float


SCALES = (
    Scale(0.5, 2.5, 4.0),
    Scale(1.5, 2.5, 4.0),
    Scale(4.5, 2.3, 3.0),
    Scale(13.5, 1.7, 1.7),
    Scale(30.0, 1.6, 1.6),
)
LEAST_M = 0.01
"""A smaller common residual means nothing."""
LEAST_MAX_M = 0.04
"""A stretch is reported if the difference reaches this: real systems share errors of some centimetres in fast turns."""
AGREEING = 0.7
"""A system agrees if its residual differs from the common one by at most this share of it."""


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrial:
    """Result of a trial.

    Attributes:
        systems: Those that took part.
        left_out: {system: why it took no part}.
        stretches: Contradictions, in order of time.
        constants: Constants that the systems agree on.
        stamps_s: Times of the residuals, shape (n,).
        residuals_m: {system: distance from the ground truth after an alignment over some seconds around, shape (n,)};
            NaN where it is not known.
        common_m: The same of what the systems have in common, shape (n,).
        judged: Times at which enough systems have poses, shape (n,): elsewhere nothing can be found.
        why_not: Reason why there can be no verdict; empty if there can.
    """

    systems: tuple[str, ...]
    left_out: Mapping[str, str]
    stretches: tuple[ContradictionDocument, ...]
    constants: tuple[ConstantOffsetDocument, ...]
    stamps_s: FloatArray
    residuals_m: Mapping[str, FloatArray]
    common_m: FloatArray
    judged: BoolArray
    why_not: str = ""

    @property
    def judged_share(self) -> float:
        """Share of the ground truth's time at which enough systems have poses."""
        return float(self.judged.mean()) if len(self.judged) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Everything on the grid: times (n,), true positions (n, 3), estimated ones (k, n, 3), and the names of systems.

    ``flagged`` (n,) says where windows contradict the ground truth, ``ratios`` (n,) how clearly.
    """

    stamps_s: FloatArray
    true_m: FloatArray
    estimated_m: FloatArray
    names: Sequence[str]
    flagged: BoolArray
    ratios: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Witness:
    """A system on the grid: positions (n, 3), NaN where unknown; rotations (n, 3, 3); what was corrected."""

    name: str
    positions_m: FloatArray
    rotations: FloatArray
    offset_s: float
    offset_sigma_s: float
    arm_m: FloatArray
    arm_sigma_m: FloatArray


def judge_truth(
    truth: Trajectory,
    systems: Mapping[str, Trajectory],
    sensors: Mapping[str, frozenset[str]] | None = None,
    *,
    rotations_known: bool = True,
) -> TruthTrial:
    """Find the stretches in which systems agree with each other and contradict the ground truth.

    Args:
        truth: The ground truth, in the frame of the estimates.
        systems: {name: estimate}; repeats of one algorithm are one system, and only one of them may be given.
        sensors: {name: the sensors it uses}; systems that share one may share its errors.
        rotations_known: Orientations of the ground truth mean something.
    """
    # Between two poses of a ground truth that pauses nothing is known.
    stamps_s = np.arange(truth.stamps_s[0], truth.stamps_s[-1], 1.0 / RATE_HZ)
    true_m = _positions(truth, stamps_s)
    left_out: dict[str, str] = {}
    witnesses: list[_Witness] = []
    for name, estimate in systems.items():
        known = ~np.isnan(_positions(estimate, stamps_s)).any(axis=1)
        if known.mean() < LEAST_COVERAGE:
            left_out[name] = f"it has poses at most {LONGEST_GAP_S:g} s apart in {known.mean():.0%} of the time only"
            continue
        witnesses.append(_corrected(name, estimate, truth, stamps_s, true_m, rotations_known=rotations_known))
    names = tuple(witness.name for witness in witnesses)
    nothing = np.full(len(stamps_s), np.nan)
    if len(witnesses) < FEWEST_SYSTEMS:
        words = f"{FEWEST_SYSTEMS} systems are needed, {len(witnesses)} have poses that can be compared"
        return TruthTrial(names, left_out, (), (), stamps_s, {}, nothing, np.zeros(len(stamps_s), dtype=bool), words)
    estimated_m = np.stack([witness.positions_m for witness in witnesses])
    nowhere = np.zeros(len(stamps_s), dtype=bool)
    scene = _Scene(stamps_s, true_m, estimated_m, names, nowhere, np.zeros(len(stamps_s)))
    for scale in SCALES:
        _flag(scale, scene)
    stretches = tuple(_contradiction(part, scene, sensors) for part in _runs(scene.flagged))
    residuals_m, common_m = _curves(true_m, estimated_m)
    return TruthTrial(
        names,
        left_out,
        tuple(entry for entry in stretches if entry is not None and entry.max_m >= LEAST_MAX_M),
        _constants(witnesses, rotations_known=rotations_known),
        stamps_s,
        dict(zip(names, residuals_m, strict=True)),
        common_m,
        (~np.isnan(estimated_m[:, :, 0] + true_m[:, 0])).sum(axis=0) >= FEWEST_SYSTEMS,
    )


def _positions(trajectory: Trajectory, stamps_s: FloatArray) -> FloatArray:
    """Positions at ``stamps_s``, NaN outside and in gaps, shape (n, 3)."""
    after = np.clip(np.searchsorted(trajectory.stamps_s, stamps_s), 1, len(trajectory) - 1)
    step_s = trajectory.stamps_s[after] - trajectory.stamps_s[after - 1]
    inside = (stamps_s >= trajectory.stamps_s[0]) & (stamps_s <= trajectory.stamps_s[-1])
    positions_m = np.array(interpolate(trajectory, stamps_s).positions_m)
    positions_m[~inside | (step_s > LONGEST_GAP_S)] = np.nan
    return positions_m


def _windows(count: int, window_s: float) -> npt.NDArray[np.intp]:
    """Indices of windows that overlap by five sixths, shape (w, m)."""
    length = round(window_s * RATE_HZ) + 1
    starts = np.arange(0, max(count - length + 1, 0), max(1, length // 6))
    return np.asarray(starts[:, None] + np.arange(length), dtype=np.intp)


def _aligned_residuals(true_m: FloatArray, estimated_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals of true positions (w, m, 3) after Sim(3) in each window (Umeyama 1991), rotations, and scales (w,).

    The scale stays within :data:`_SCALE_WITHIN` of the median over all windows.
    """
    q = true_m - true_m.mean(axis=1, keepdims=True)
    p = estimated_m - estimated_m.mean(axis=1, keepdims=True)
    U, d, Vt = np.linalg.svd(np.einsum("wni,wnj->wij", q, p))
    signs = np.ones_like(d)
    signs[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    rotations = np.einsum("wij,wj,wjk->wik", U, signs, Vt)
    power = (p**2).sum(axis=(1, 2))
    moves = power > 1e-6
    scales = np.where(moves, (d * signs).sum(axis=1) / np.where(moves, power, 1.0), 1.0)
    usual = float(np.median(scales[moves])) if moves.any() else 1.0
    scales = np.clip(scales, usual * (1 - _SCALE_WITHIN), usual * (1 + _SCALE_WITHIN))
    residuals = q - scales[:, None, None] * np.einsum("wij,wnj->wni", rotations, p)
    return residuals, rotations, scales


def _rms(residuals_m: FloatArray) -> FloatArray:
    """RMS of residuals (..., m, 3) over each window, shape (...)."""
    return np.asarray(np.sqrt((residuals_m**2).sum(axis=-1).mean(axis=-1)))


_FITTED_WINDOW_S = 4.0
_ROUNDS = 3


def _corrected(
    name: str,
    estimate: Trajectory,
    truth: Trajectory,
    stamps_s: FloatArray,
    true_m: FloatArray,
    *,
    rotations_known: bool,
) -> _Witness:
    """A system without the time offset and the lever arm that it has throughout, fitted window by window.

    In each window the alignment is free, so drift does not matter. Its seven directions are taken out of the residuals,
    and of their derivatives by offset and arm, which are velocity and orientation. Windows with large residuals,
    where something else is wrong, do not count.
    """
    rotations = rotations_from_quats((truth if rotations_known else estimate).quats_xyzw)
    source = truth if rotations_known else estimate
    nearest = np.clip(np.searchsorted(source.stamps_s, stamps_s), 0, len(source) - 1)
    frames = rotations[nearest]
    offset_s, arm_m = 0.0, np.zeros(3)
    covariance = np.full((4, 4), np.nan)
    velocity = np.gradient(true_m, 1.0 / RATE_HZ, axis=0)
    positions_m = _positions(estimate, stamps_s)
    for _ in range(_ROUNDS):
        positions_m = _positions(estimate, stamps_s + offset_s)
        indices = _windows(len(stamps_s), _FITTED_WINDOW_S)
        whole = ~np.isnan(true_m[indices] + positions_m[indices] + velocity[indices]).any(axis=(1, 2))
        if whole.sum() < 4:
            break
        indices = indices[whole]
        moved_m = true_m + frames @ arm_m if rotations_known else true_m
        own_m = positions_m if rotations_known else positions_m + frames @ arm_m
        residuals, turned, scales = _aligned_residuals(moved_m[indices], own_m[indices])
        by_arm = frames[indices]
        if not rotations_known:
            by_arm = -scales[:, None, None, None] * np.einsum("wij,wnjk->wnik", turned, by_arm)
        columns = np.concatenate([by_arm, -velocity[indices][..., None]], axis=3)
        parameters, covariance = _solved(residuals, columns, moved_m[indices] - residuals)
        arm_m = arm_m + parameters[:3]
        offset_s += float(parameters[3])
    sigmas = np.sqrt(np.diag(covariance))
    positions_m = _positions(estimate, stamps_s + offset_s)
    if rotations_known:
        # The arm is taken off the estimate, whose frame in its own world is that of the truth turned by the alignment.
        own = rotations_from_quats(interpolate(estimate, stamps_s + offset_s).quats_xyzw)
        positions_m = positions_m - own @ arm_m if np.isfinite(sigmas[:3]).all() else positions_m
    else:
        positions_m = positions_m + frames @ arm_m
    return _Witness(name, positions_m, frames, offset_s, float(sigmas[3]), arm_m, sigmas[:3])


_TRIMMED = 2.5


def _solved(residuals: FloatArray, columns: FloatArray, moved_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares of the four parameters over all windows, and their covariance (4, 4).

    Args:
        residuals: Shape (w, m, 3).
        columns: Their derivatives, shape (w, m, 3, 4).
        moved_m: Aligned positions, shape (w, m, 3), from which the directions of the alignment follow.
    """
    count, length = residuals.shape[:2]
    centred = moved_m - moved_m.mean(axis=1, keepdims=True)
    x, y, z = np.moveaxis(centred, 2, 0)
    zero, one = np.zeros_like(x), np.ones_like(x)
    turns = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=2).reshape(count, length, 3, 3)
    shifts = np.broadcast_to(np.eye(3), (count, length, 3, 3))
    world = np.concatenate([turns, shifts * one[..., None, None], centred[..., None]], axis=3)
    basis, _ = np.linalg.qr(world.reshape(count, length * 3, 7))
    B = columns.reshape(count, length * 3, 4)
    B = B - basis @ (np.swapaxes(basis, 1, 2) @ B)
    r = residuals.reshape(count, length * 3, 1)
    sizes = _rms(residuals)
    kept = sizes <= _TRIMMED * np.median(sizes)
    information = np.einsum("wni,wnj->ij", B[kept], B[kept])
    gradient = np.einsum("wni,wnk->i", B[kept], r[kept])
    inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    step = -inverse @ gradient
    # Windows overlap, and residuals within one are alike: about one of them counts for each window.
    left = (r + B @ step[:, None])[kept]
    variance = float((left**2).mean()) * length
    return np.asarray(step), np.asarray(inverse * variance)


def _flag(scale: Scale, scene: _Scene) -> None:
    """Mark the windows of one length in which the systems contradict the ground truth together."""
    true_m, estimated_m = scene.true_m, scene.estimated_m
    indices = _windows(len(true_m), scale.window_s)
    if len(indices) == 0:
        return
    q = true_m[indices]
    residuals = np.full((len(estimated_m), *q.shape), np.nan)
    for system, positions_m in enumerate(estimated_m):
        whole = ~np.isnan(q + positions_m[indices]).any(axis=(1, 2))
        if whole.any():
            residuals[system, whole], _, _ = _aligned_residuals(q[whole], positions_m[indices[whole]])
    present = ~np.isnan(residuals[:, :, 0, 0])
    enough = present.sum(axis=0) >= FEWEST_SYSTEMS
    if not enough.any():
        return
    indices, residuals, present = indices[enough], residuals[:, enough], present[:, enough]
    common = np.nanmedian(residuals, axis=0)
    common_m = _rms(common)
    own_m = _rms(residuals - common)
    usual_m = float(np.median(common_m))
    agreeing = (np.where(present, own_m, np.inf) <= AGREEING * common_m).sum(axis=0)
    typical_m = np.nanmedian(own_m, axis=0)
    bad = (
        (common_m >= LEAST_M)
        & (common_m >= scale.over_own * typical_m)
        & (common_m >= scale.over_usual * usual_m)
        & (agreeing >= FEWEST_SYSTEMS)
        & (3 * agreeing >= 2 * present.sum(axis=0))
    )
    for window in np.flatnonzero(bad):
        inside = indices[window]
        # Only the part with the deviation: a window is longer than the fault that it shows.
        sizes = np.linalg.norm(common[window], axis=1)
        steps = np.linalg.norm(np.diff(common[window], axis=0), axis=1)
        moving = np.concatenate([steps[:1], np.maximum(steps[1:], steps[:-1]), steps[-1:]])
        part = (sizes >= common_m[window]) | (moving >= 0.5 * steps.max())
        scene.flagged[inside[part]] = True
        ratio = common_m[window] / max(float(typical_m[window]), 1e-9)
        scene.ratios[inside] = np.maximum(scene.ratios[inside], ratio)


def _median(values: FloatArray) -> FloatArray:
    """Median over the first axis of what is not NaN, NaN where nothing is."""
    known = ~np.isnan(values).all(axis=0)
    found = np.full(values.shape[1:], np.nan)
    found[known] = np.nanmedian(values[:, known], axis=0)
    return found


_JOINED_S = 3.0


def _runs(flagged: BoolArray) -> list[tuple[int, int]]:
    """First and last index of each stretch; those a few seconds apart are one."""
    places = np.flatnonzero(flagged)
    if len(places) == 0:
        return []
    breaks = np.flatnonzero(np.diff(places) > _JOINED_S * RATE_HZ)
    firsts = places[np.concatenate([[0], breaks + 1])]
    lasts = places[np.concatenate([breaks, [len(places) - 1]])]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


_CONTEXT_S = (2.0, 15.0)
"""A stretch is seen from an alignment over as long before and after it, within these limits: systems drift."""


def _contradiction(
    part: tuple[int, int], scene: _Scene, sensors: Mapping[str, frozenset[str]] | None
) -> ContradictionDocument | None:
    """The stretch with its size, seen from an alignment before and after it; None where the systems do not agree."""
    first, last = part
    stamps_s, true_m, names = scene.stamps_s, scene.true_m, scene.names
    shortest, longest = (round(limit_s * RATE_HZ) for limit_s in _CONTEXT_S)
    margin = min(max(last - first, shortest), longest)
    around = np.arange(max(0, first - margin), min(len(stamps_s), last + margin + 1))
    outside = (around < first - 1) | (around > last + 1)
    common: list[FloatArray] = []
    present: list[int] = []
    for system, positions_m in enumerate(scene.estimated_m):
        usable = ~np.isnan(true_m[around] + positions_m[around]).any(axis=1)
        reference = np.flatnonzero(usable & outside)
        if len(reference) < 10 or not usable[~outside].any():
            continue
        q, p = true_m[around], positions_m[around]
        _, rotation, scale = _aligned_residuals(q[None, reference], p[None, reference])
        shift = q[reference].mean(axis=0) - scale[0] * rotation[0] @ p[reference].mean(axis=0)
        common.append(q - (scale[0] * p @ rotation[0].T + shift))
        present.append(system)
    if len(common) < FEWEST_SYSTEMS:
        return None
    away = np.stack(common)[:, ~outside]
    middle = _median(away)
    known = ~np.isnan(middle[:, 0])
    size_m = math.sqrt(float(np.mean((middle[known] ** 2).sum(axis=1))))
    own_m = np.sqrt(np.nanmean(((away - middle) ** 2).sum(axis=2), axis=1))
    agrees = [bool(value <= size_m) for value in own_m]
    agreeing = tuple(names[present[i]] for i, yes in enumerate(agrees) if yes)
    differing = tuple(names[present[i]] for i, yes in enumerate(agrees) if not yes)
    if len(agreeing) < FEWEST_SYSTEMS:
        # The windows have shown agreement; over the context the systems drift apart by more than the fault.
        agreeing, differing = tuple(names[i] for i in present), ()
    ratio = float(scene.ratios[first : last + 1].max())
    max_m = float(np.nanmax(np.linalg.norm(middle, axis=1)))
    of_all = None if sensors is None else [sensors.get(name, frozenset()) for name in agreeing]
    shared = None if of_all is None else frozenset.intersection(*of_all)
    blame, because = _blamed(true_m, scene.estimated_m[present], part, max_m, shared)
    clear = ratio >= 2.0 * SCALES[0].over_own
    confidence = "low" if blame is Blame.UNDECIDED else "high" if clear and len(agreeing) > FEWEST_SYSTEMS else "medium"
    return ContradictionDocument(
        begin_s=float(stamps_s[first]),
        end_s=float(stamps_s[last]),
        rms_m=size_m,
        max_m=max_m,
        agreeing=agreeing,
        differing=differing,
        ratio=ratio,
        blame=blame,
        because=because,
        confidence=confidence,
    )


_SPIKE = 3.0
_STILL_M = 1e-4
_MOVING_M = 0.02
_JUMP_SHARE = 0.25
"""A jump of the ground truth explains a contradiction if it is at least this share of it."""


def _blamed(
    true_m: FloatArray, estimated_m: FloatArray, part: tuple[int, int], max_m: float, shared: frozenset[str] | None
) -> tuple[Blame, str]:
    """Decide whether the ground truth is wrong, or whether the systems may share an error of one sensor.

    ``shared`` are the sensors that all agreeing systems use, None if they are not known.
    """
    first, last = max(part[0] - 2, 0), part[1] + 3
    truth = _accelerations(true_m)
    own = _median(np.stack([_accelerations(positions_m) for positions_m in estimated_m]))
    inside = slice(first, min(last, len(truth)))
    steps_m = np.linalg.norm(np.diff(true_m[first:last], axis=0), axis=1)
    own_steps_m = _median(np.linalg.norm(np.diff(estimated_m[:, first:last], axis=1), axis=2))
    if np.any((steps_m < _STILL_M) & (own_steps_m > _MOVING_M)):
        return Blame.TRUTH, "it stands still while the systems move"
    peak, own_peak = _peak(truth, inside), _peak(own, inside)
    large = np.nanmax(truth[inside], initial=0.0) >= _JUMP_SHARE * max_m
    if large and peak > _SPIKE and peak > 2.0 * own_peak and own_peak < _SPIKE:
        return Blame.TRUTH, "it jumps where the systems move smoothly"
    if own_peak > _SPIKE:
        return Blame.UNDECIDED, "the systems jump together there"
    if shared:
        names = ", ".join(sorted(shared))
        return Blame.UNDECIDED, f"the systems share {names}, whose errors would look the same"
    if shared is None:
        return Blame.UNDECIDED, "it is not known whether the systems share a sensor"
    return Blame.TRUTH, "the systems share no sensor"


def _accelerations(positions_m: FloatArray) -> FloatArray:
    """Norms of the second differences at the rate of the grid, shape (n - 2,)."""
    return np.asarray(np.linalg.norm(np.diff(positions_m, n=2, axis=0), axis=1))


def _peak(accelerations: FloatArray, inside: slice) -> float:
    """The largest of a stretch over the 99th percentile of all others."""
    others = np.concatenate([accelerations[: inside.start], accelerations[inside.stop :]])
    part, others = accelerations[inside], others[~np.isnan(others)]
    if len(others) < 10 or np.isnan(part).all():
        return 0.0
    return float(np.nanmax(part) / max(float(np.percentile(others, 99)), 1e-9))


_CERTAIN = 4.0
LEAST_ARM_M = 0.03
LEAST_OFFSET_S = 0.01


def _constants(witnesses: Sequence[_Witness], *, rotations_known: bool) -> tuple[ConstantOffsetDocument, ...]:
    """The lever arm and the time offset that the systems agree on, if they are certain."""
    found: list[ConstantOffsetDocument] = []
    arms = np.stack([witness.arm_m for witness in witnesses])
    arm_sigmas = np.stack([witness.arm_sigma_m for witness in witnesses])
    offsets = np.array([[witness.offset_s] for witness in witnesses])
    offset_sigmas = np.array([[witness.offset_sigma_s] for witness in witnesses])
    for kind, values, sigmas, least in (
        ("lever_arm", arms, arm_sigmas, LEAST_ARM_M),
        ("time_offset", offsets, offset_sigmas, LEAST_OFFSET_S),
    ):
        middle = np.median(values, axis=0)
        apart = np.linalg.norm(values - middle, axis=1)
        size = float(np.linalg.norm(middle))
        agrees = apart <= 0.4 * size
        if size < least or agrees.sum() < FEWEST_SYSTEMS or 3 * agrees.sum() < 2 * len(values):
            continue
        mean = values[agrees].mean(axis=0)
        spread = np.sqrt((values[agrees].var(axis=0) + (sigmas[agrees] ** 2).mean(axis=0)) / agrees.sum())
        if np.linalg.norm(mean) < _CERTAIN * np.linalg.norm(spread):
            continue
        # Arms are of the measured point in the frame of the estimates, whichever side has the orientations.
        sign = -1.0 if kind == "lever_arm" and rotations_known else 1.0
        names = tuple(witness.name for witness, yes in zip(witnesses, agrees, strict=True) if yes)
        found.append(
            ConstantOffsetDocument(
                kind=kind, values=tuple((sign * mean).tolist()), sigmas=tuple(spread.tolist()), agreeing=names
            )
        )
    return tuple(found)


_CURVE_S = 6.0


def _curves(true_m: FloatArray, estimated_m: FloatArray) -> tuple[list[FloatArray], FloatArray]:
    """Residuals of all systems over time, and of what they have in common, by windows of some seconds."""
    indices = _windows(len(true_m), _CURVE_S)
    count = len(true_m)
    vectors = np.full((len(estimated_m), count, 3), np.nan)
    for system, positions_m in enumerate(estimated_m):
        whole = (
            ~np.isnan(true_m[indices] + positions_m[indices]).any(axis=(1, 2)) if len(indices) else np.empty(0, bool)
        )
        if not whole.any():
            continue
        residuals, _, _ = _aligned_residuals(true_m[indices[whole]], positions_m[indices[whole]])
        sums, weights = np.zeros((count, 3)), np.zeros(count)
        np.add.at(sums, indices[whole], residuals)
        np.add.at(weights, indices[whole], 1.0)
        known = weights > 0
        vectors[system, known] = sums[known] / weights[known, None]
    enough = (~np.isnan(vectors[:, :, 0])).sum(axis=0) >= FEWEST_SYSTEMS
    common = np.full((count, 3), np.nan)
    if enough.any():
        common[enough] = np.nanmedian(vectors[:, enough], axis=0)
    return list(np.linalg.norm(vectors, axis=2)), np.asarray(np.linalg.norm(common, axis=1))
