"""Poses that were written in another convention than they are read in. Each mistake is undone to see if it was made."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slamhive.domain.hint import Hint
from slamhive.errors import InvalidInput
from slamhive.trajectory.agreement import orientation_spread_deg
from slamhive.trajectory.alignment import Similarity, align_umeyama
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import inverse_quats, rotations_from_quats

TRIED_POSES = 300
"""This many of the matched poses are enough."""
SUSPICIOUS_SHARE = 0.1
"""A position error above this share of the path's size is suspicious."""
SUSPICIOUS_DEG = 5.0
"""Orientations that differ from the ground truth by more are suspicious; those of real systems differ by less."""
COLLAPSE, GOOD_SHARE = 0.3, 0.2
"""A mistake is reported if undoing it leaves at most these shares of the position error and of the path's size, ..."""
ROTATION_COLLAPSE, ROTATION_GAIN_DEG = 0.5, 2.0
"""... or at most this share of the spread of orientations, and at least so many degrees less."""
KEPT = 1.2
"""The other of the two errors may grow by this factor."""
AMBIGUOUS = 3.0
"""An explanation that leaves up to this many times as much error may be right as well."""

Undo = Callable[[Poses], Poses]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well matched poses agree if position, rotation and scale are free.

    Attributes:
        reference: Poses of the ground truth.
        estimate: As many of the estimate.
        transform: The alignment.
        ate_m: RMSE of the aligned positions.
        size_m: RMS distance of the ground truth from its middle.
        spread_deg: Spread of the orientation errors; None if orientations are not known.
    """

    reference: Poses
    estimate: Poses
    transform: Similarity
    ate_m: float
    size_m: float
    spread_deg: float | None


@dataclass(frozen=True, slots=True)
class Mistake:
    """A convention that may have been mistaken, by whoever wrote the estimate or the ground truth.

    Attributes:
        key: Of the hint.
        found: Describes it; ``{}`` stands for the file.
        remedy: What to do.
        undo: Turns wrong poses into right ones.
        truth_remedy: What to do if the ground truth is wrong; None if the two cases cannot be separated.
    """

    key: str
    found: str
    remedy: str
    undo: Undo
    truth_remedy: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """A mistake that explains the errors, and the fit without it."""

    mistake: Mistake
    of_truth: bool
    undone: Fit

    @property
    def left(self) -> float:
        """The remaining errors, as shares of the path's size and of a right angle."""
        return self.undone.ate_m / self.undone.size_m + (self.undone.spread_deg or 0.0) / 90.0


def thinned(poses: Poses) -> Poses:
    """Some hundreds of the poses, evenly spread."""
    return poses.take(np.unique(np.linspace(0, len(poses) - 1, TRIED_POSES).astype(np.intp)))


def fit_poses(reference: Poses, estimate: Poses, *, rotations: bool) -> Fit | None:
    """The fit of matched poses; None if they do not determine one."""
    try:
        transform = align_umeyama(estimate.positions_m, reference.positions_m, scaled=True)
    except InvalidInput:
        return None
    ate_m = rms_m(transform.points(estimate.positions_m) - reference.positions_m)
    size_m = rms_m(reference.positions_m - reference.positions_m.mean(axis=0))
    spread_deg = orientation_spread_deg(reference, estimate) if rotations else None
    return Fit(reference, estimate, transform, ate_m, size_m, spread_deg)


def rms_m(vectors_m: FloatArray) -> float:
    """Root of the mean squared length of vectors, shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors_m**2, axis=1))))


def mistaken_convention(fit: Fit) -> Hint | None:
    """The mistake that explains the errors best; None if none does, or if the errors are small.

    Some mistakes explain nearly as much in the ground truth as in the estimate; the hint then names both.
    """
    if not _positions_suspicious(fit) and not _rotations_suspicious(fit):
        return None
    explained = [entry for entry in _tried(fit) if _explains(fit, entry.undone)]
    if not explained:
        return None
    best = min(explained, key=lambda entry: entry.left)
    alike = [
        entry for entry in explained if entry.mistake.key == best.mistake.key and entry.left <= AMBIGUOUS * best.left
    ]
    return _hint(fit, [min(same, key=lambda entry: entry.left) for same in _by_owner(alike)])


def _tried(fit: Fit) -> Iterator[_Explanation]:
    for mistake in MISTAKES:
        for of_truth in (False, True) if mistake.truth_remedy is not None else (False,):
            undone = fit_poses(
                mistake.undo(fit.reference) if of_truth else fit.reference,
                fit.estimate if of_truth else mistake.undo(fit.estimate),
                rotations=fit.spread_deg is not None,
            )
            if undone is not None:
                yield _Explanation(mistake, of_truth, undone)


def _by_owner(entries: Iterable[_Explanation]) -> list[list[_Explanation]]:
    """Explanations by the estimate, then those by the ground truth; empty groups are left out."""
    found = list(entries)
    return [part for of_truth in (False, True) if (part := [entry for entry in found if entry.of_truth is of_truth])]


def _hint(fit: Fit, entries: Sequence[_Explanation]) -> Hint:
    owners = " or ".join(_OWNERS[entry.of_truth] for entry in entries)
    remedies = [(entry.mistake.truth_remedy or "") if entry.of_truth else entry.mistake.remedy for entry in entries]
    best = min(entries, key=lambda entry: entry.left)
    return Hint(
        best.mistake.key,
        f"{best.mistake.found.format(owners)}: {_collapse_words(fit, best.undone)}.",
        "; or ".join(remedies),
    )


_OWNERS = {False: "the estimate", True: "the ground truth"}


def _positions_suspicious(fit: Fit) -> bool:
    return fit.ate_m > SUSPICIOUS_SHARE * fit.size_m


def _rotations_suspicious(fit: Fit) -> bool:
    return fit.spread_deg is not None and fit.spread_deg > SUSPICIOUS_DEG


def _explains(fit: Fit, undone: Fit) -> bool:
    """Whether one of the errors collapses, and the other does not grow."""
    positions, before = undone.ate_m / undone.size_m, fit.ate_m / fit.size_m
    positions_collapse = _positions_suspicious(fit) and positions <= COLLAPSE * before and positions <= GOOD_SHARE
    if fit.spread_deg is None or undone.spread_deg is None:
        return positions_collapse
    gain_deg = fit.spread_deg - undone.spread_deg
    rotations_collapse = (
        _rotations_suspicious(fit)
        and undone.spread_deg <= ROTATION_COLLAPSE * fit.spread_deg
        and gain_deg >= ROTATION_GAIN_DEG
    )
    if positions_collapse:
        return rotations_collapse or undone.spread_deg <= max(KEPT * fit.spread_deg, SUSPICIOUS_DEG)
    return rotations_collapse and positions <= KEPT * before


def _collapse_words(fit: Fit, undone: Fit) -> str:
    words = []
    if undone.ate_m / undone.size_m <= COLLAPSE * fit.ate_m / fit.size_m:
        words.append(
            f"the position error falls from {fit.ate_m / fit.size_m:.0%} to {undone.ate_m / undone.size_m:.1%} of the "
            "path's size"
        )
    if fit.spread_deg is not None and undone.spread_deg is not None and undone.spread_deg < fit.spread_deg:
        words.append(
            f"the orientations follow the ground truth to {undone.spread_deg:.1f} deg instead of {fit.spread_deg:.1f}"
        )
    return "with that undone " + " and ".join(words)


def _rolled(places: int) -> Undo:
    return lambda poses: Poses(poses.stamps_s, poses.positions_m, np.roll(poses.quats_xyzw, places, axis=1))


def _inverted(poses: Poses) -> Poses:
    """T_body_world for T_world_body: R^T and -R^T p."""
    positions_m = -np.einsum("nji,nj->ni", rotations_from_quats(poses.quats_xyzw), poses.positions_m)
    return Poses(poses.stamps_s, positions_m, inverse_quats(poses.quats_xyzw))


def _turned_back(poses: Poses) -> Poses:
    return Poses(poses.stamps_s, poses.positions_m, inverse_quats(poses.quats_xyzw))


def _mirrored(axis: int, *, turning: bool) -> Undo:
    """Positions with one axis reversed; with ``turning`` the orientations as well: M R M, as in a left-handed world."""
    signs_m = np.where(np.arange(3) == axis, -1.0, 1.0)
    signs = np.append(-signs_m, 1.0) if turning else np.ones(4)
    return lambda poses: Poses(poses.stamps_s, poses.positions_m * signs_m, poses.quats_xyzw * signs)


def _order(read_as: str, places: int) -> Mistake:
    return Mistake(
        "quaternion_order",
        "The quaternions of {} seem to stand in another order than they are read in",
        f"write the estimate as qx qy qz qw, or import it again with --quaternion-order {read_as}",
        _rolled(places),
        f"write the ground truth as qx qy qz qw, or import it again with --groundtruth-quaternion-order {read_as}",
    )


def _mirror(undo: Undo) -> Mistake:
    return Mistake(
        "mirrored_axes",
        "The path of {} seems to be mirrored, as in left-handed axes",
        "reverse the axis that points the wrong way, so that the axes are right-handed",
        undo,
    )


MISTAKES = (
    _order("wxyz", -1),
    _order("xyzw", 1),
    Mistake(
        "inverse_poses",
        "The poses of {} seem to be inverted, T_body_world instead of T_world_body",
        "write the estimated pose of the body in the world, which is the inverse of what is written",
        _inverted,
        "write the true pose of the body in the world, and import the dataset again",
    ),
    Mistake(
        "inverse_rotations",
        "The orientations of {} seem to be inverted, from world to body instead of from body to world",
        "write the orientation of the body in the world: reverse the signs of qx qy qz",
        _turned_back,
    ),
    _mirror(_mirrored(2, turning=True)),
    *(_mirror(_mirrored(axis, turning=False)) for axis in range(3)),
)
