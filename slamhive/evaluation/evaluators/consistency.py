"""Consistency: whether the errors are as large as the covariances of the algorithm say.

NEES (normalised estimation error squared) is e^T P^-1 e. For position and for orientation it has a chi-square
distribution with 3 degrees of freedom, so its mean is 3. Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to
Tracking and Navigation", 2001, section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.evaluation.evaluators.base import COVARIANCES, MetricValues, Paired, absent
from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.table import parse_table, read_bounded
from slamhive.trajectory.transforms import inverse_quats, multiply_quats, quats_from_rotations

LAYOUT = "timestamp and 21 numbers: the upper triangle, row by row, of the 6x6 covariance of x y z rx ry rz"
FRAMES = ("body", "world")
_HEADER = b"# orientation:"
_SAME_STAMP_S = 1e-5
"""Timestamps of one pose in two files can differ by this much, because they are written with different digits."""
_CHI_SQUARE_95 = 7.814727903251179
"""95 % of a chi-square distribution with 3 degrees of freedom is below this."""
_UPPER = np.triu_indices(6)


@dataclass(frozen=True, slots=True, eq=False)
class Covariances:
    """Content of ``covariances.txt``.

    Attributes:
        stamps_s: Of the poses, strictly increasing, shape (n,).
        matrices: Of the errors x y z (m) in the world of the estimate and rx ry rz (rad), shape (n, 6, 6).
        in_body: The rotation vector is in the body frame, R_true = R Exp(r); in the world frame, R_true = Exp(r) R,
            otherwise.
    """

    stamps_s: FloatArray
    matrices: FloatArray
    in_body: bool


class Consistency:
    """NEES of position and orientation."""

    keys = ("nees.position", "nees.position.within", "nees.orientation", "nees.orientation.within")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the algorithm gives no covariances, or one that is invalid."""
        path = paired.files.get(COVARIANCES)
        if path is None:
            return absent(self.keys, "the algorithm gives no covariances.txt")
        covariances = read_covariances(path)
        # A covariance belongs to the pose with its timestamp.
        stamps_s = paired.matched_estimate.stamps_s - paired.time_offset_s
        after = np.searchsorted(covariances.stamps_s, stamps_s - _SAME_STAMP_S)
        after = np.minimum(after, len(covariances.stamps_s) - 1)
        own = np.flatnonzero(np.abs(covariances.stamps_s[after] - stamps_s) <= _SAME_STAMP_S)
        theirs = after[own]
        if len(own) == 0:
            return absent(self.keys, "no covariance has the timestamp of a matched pose")
        # In the world of the estimate, in whose units the covariances are.
        transform = paired.transform
        moved_m = paired.matched_reference.positions_m - transform.translation_m
        errors_m = moved_m @ transform.rotation / transform.scale - paired.matched_estimate.positions_m
        values = _nees("nees.position", errors_m[own], covariances.matrices[theirs, :3, :3])
        if not paired.rotations_known:
            return MetricValues(values, dict.fromkeys(self.keys[2:], paired.rotations_unknown))
        # Rotation vectors from the estimated to the true orientations, in the world of the estimate, (n, 3).
        to_estimate = inverse_quats(quats_from_rotations(transform.rotation[None]))
        true = multiply_quats(to_estimate, paired.matched_reference.quats_xyzw)
        back = inverse_quats(paired.matched_estimate.quats_xyzw)
        turned = multiply_quats(back, true) if covariances.in_body else multiply_quats(true, back)
        turned *= np.where(turned[:, 3:] < 0, -1.0, 1.0)
        lengths = np.linalg.norm(turned[:, :3], axis=1, keepdims=True)
        # Of a rotation by almost nothing the vector part is half the rotation vector.
        factors = np.where(lengths > 0, 2.0 * np.arctan2(lengths, turned[:, 3:]) / np.maximum(lengths, 1e-300), 2.0)
        turns_rad = np.asarray(factors * turned[:, :3])[own]
        return MetricValues(values | _nees("nees.orientation", turns_rad, covariances.matrices[theirs, 3:, 3:]))


def read_covariances(path: Path) -> Covariances:
    """Read ``covariances.txt``.

    Raises:
        InvalidInput: Naming the line that is malformed, out of order or no covariance, or the convention that the
            first line does not state.
    """
    if path.is_symlink():
        raise InvalidInput(f"{path.name} is a link, which is not followed")
    try:
        data = read_bounded(path)
    except NotFound:
        raise InvalidInput(f"{path.name} does not exist") from None
    first = data.split(b"\n", 1)[0].strip()
    stated = first.removeprefix(_HEADER).strip().decode("ascii", errors="replace") if first.startswith(_HEADER) else ""
    if stated not in FRAMES:
        raise InvalidInput(
            f"{path.name} does not say which frame its rotation vectors are in",
            "begin it with the line '# orientation: body' or '# orientation: world'",
        )
    in_body = stated == "body"
    table = parse_table(data, path.name, 22, LAYOUT)
    finite = np.isfinite(table.values).all(axis=1)
    if not finite.all():
        raise table.error(int((~finite).argmax()), "a number is not finite", "leave out covariances that are unknown")
    stamps_s = table.values[:, 0]
    backwards = np.diff(stamps_s) <= 0
    if backwards.any():
        raise table.error(int(backwards.argmax()) + 1, "the timestamp does not grow", "sort by timestamp, each once")
    matrices = np.zeros((len(stamps_s), 6, 6))
    matrices[:, _UPPER[0], _UPPER[1]] = matrices[:, _UPPER[1], _UPPER[0]] = table.values[:, 1:]
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    if not (smallest > 0).all():
        row = int((~(smallest > 0)).argmax())
        found = f"the covariance is not positive definite: its smallest eigenvalue is {smallest[row]:.3g}"
        raise table.error(row, found, "write covariances, of all six in the order x y z rx ry rz")
    return Covariances(stamps_s, matrices, in_body)


def _nees(key: str, errors: FloatArray, covariances: FloatArray) -> dict[str, float]:
    """Mean NEES, and the share within the 95 % bound."""
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
    return {key: float(nees.mean()), f"{key}.within": float(np.mean(nees <= _CHI_SQUARE_95))}
