import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.evaluators.base import ROTATIONS_UNKNOWN
from slamhive.evaluation.evaluators.consistency import Consistency, read_covariances
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import multiply_quats
from tests.evaluation.evaluators.curves import SE3, loop, moved, paired, scaled

pytestmark = pytest.mark.quick

COUNT = 4000
UPPER = np.triu_indices(6)


def write(path, stamps_s, matrices, frame="body"):
    rows = np.column_stack([stamps_s, matrices[:, UPPER[0], UPPER[1]]])
    lines = "".join(
        " ".join(f"{value:.9g}" if i else f"{value:.9f}" for i, value in enumerate(row)) + "\n" for row in rows
    )
    path.write_text(f"# orientation: {frame}\n{lines}")
    return path


def quats_of(vectors_rad):
    angles = np.linalg.norm(vectors_rad, axis=1, keepdims=True)
    return np.column_stack([np.sin(angles / 2) * vectors_rad / angles, np.cos(angles / 2)])


@pytest.fixture(scope="module")
def drawn():
    """Covariances, and an estimate that is off by errors drawn from them; its truth; both orientation conventions."""
    rng = np.random.default_rng(7)
    roots = rng.standard_normal((COUNT, 6, 6)) * 0.003
    matrices = roots @ roots.transpose(0, 2, 1) + 1e-6 * np.eye(6)
    errors = (np.linalg.cholesky(matrices) @ rng.standard_normal((COUNT, 6, 1)))[:, :, 0]
    estimate = loop(COUNT, 400.0)
    truth = {}
    for frame in ("body", "world"):
        turn = quats_of(errors[:, 3:])
        turned = (estimate.quats_xyzw, turn) if frame == "body" else (turn, estimate.quats_xyzw)
        truth[frame] = Trajectory(estimate.stamps_s, estimate.positions_m + errors[:, :3], multiply_quats(*turned))
    return estimate, truth, matrices


@pytest.mark.integration
@pytest.mark.parametrize("frame", ["body", "world"])
@pytest.mark.parametrize("alignment", [Alignment.SE3, Alignment.SIM3])
def test_errors_drawn_from_the_covariances_are_consistent(drawn, tmp_path, frame, alignment):
    """In whatever world the ground truth is, and of whatever scale."""
    estimate, truth, matrices = drawn
    path = write(tmp_path / "covariances.txt", estimate.stamps_s, matrices, frame)
    reference = moved(truth[frame])
    if alignment is Alignment.SIM3:
        reference = scaled(reference, 3.0)
    pair = paired(reference, estimate, Protocol(alignment), files={"covariances": path})
    values = Consistency().evaluate(pair).values
    for part in ("position", "orientation"):
        assert values[f"nees.{part}"] == pytest.approx(3.0, abs=0.15)
        assert values[f"nees.{part}.within"] == pytest.approx(0.95, abs=0.01)


def test_the_stated_frame_of_the_orientation_matters(drawn, tmp_path):
    estimate, truth, matrices = drawn
    path = write(tmp_path / "covariances.txt", estimate.stamps_s, matrices, "body")
    values = Consistency().evaluate(paired(truth["world"], estimate, files={"covariances": path})).values
    assert values["nees.orientation"] > 4
    assert values["nees.position"] == pytest.approx(3.0, abs=0.15)


def test_too_small_covariances_are_overconfident(drawn, tmp_path):
    estimate, truth, matrices = drawn
    path = write(tmp_path / "covariances.txt", estimate.stamps_s, matrices / 4)
    values = Consistency().evaluate(paired(truth["body"], estimate, files={"covariances": path})).values
    assert values["nees.position"] == pytest.approx(12.0, abs=0.6)
    assert values["nees.position.within"] < 0.6


def test_only_poses_with_a_covariance_count_on_whatever_clock(drawn, tmp_path):
    estimate, truth, matrices = drawn
    path = write(tmp_path / "covariances.txt", estimate.stamps_s[::2] + 2e-7, matrices[::2])
    late = Trajectory(truth["body"].stamps_s + 5.0, truth["body"].positions_m, truth["body"].quats_xyzw)
    pair = paired(late, estimate, Protocol(Alignment.SE3, time_offset_s=5.0), files={"covariances": path})
    assert Consistency().evaluate(pair).values["nees.position"] == pytest.approx(3.0, abs=0.2)


@pytest.mark.integration
def test_without_covariances_or_orientations_the_figures_are_missing(drawn, tmp_path):
    estimate, truth, matrices = drawn
    pair = paired(truth["body"], estimate)
    assert set(Consistency().evaluate(pair).missing.values()) == {"the algorithm gives no covariances.txt"}
    path = write(tmp_path / "covariances.txt", estimate.stamps_s, matrices)
    positions = paired(truth["body"], estimate, SE3, files={"covariances": path}, rotations_known=False)
    figures = Consistency().evaluate(positions)
    assert set(figures.values) == {"nees.position", "nees.position.within"}
    assert set(figures.missing.values()) == {ROTATIONS_UNKNOWN}
    other = write(tmp_path / "other.txt", estimate.stamps_s + 0.003, matrices)
    figures = Consistency().evaluate(paired(truth["body"], estimate, SE3, files={"covariances": other}))
    assert set(figures.missing.values()) == {"no covariance has the timestamp of a matched pose"}


IDENTITY = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
HEAD = "# orientation: body\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "does not say which frame"),
        (f"1 {IDENTITY}\n", "does not say which frame"),
        (f"# orientation: camera\n1 {IDENTITY}\n", "does not say which frame"),
        (HEAD, "is empty"),
        (f"{HEAD}1 2 3\n", "line 2: 3 columns instead of 22"),
        (f"{HEAD}1 {IDENTITY}\n1 {IDENTITY}\n", "line 3: the timestamp does not grow"),
        (f"{HEAD}1 {IDENTITY.replace('1', 'nan', 1)}\n", "line 2: a number is not finite"),
        (f"{HEAD}1 {IDENTITY}\n2 {IDENTITY.replace('1', '0', 1)}\n", "line 3: the covariance is not positive definite"),
        (f"{HEAD}1 {IDENTITY.replace('1', '-1', 1)}\n", "not positive definite: its smallest eigenvalue is -1"),
        (f"{HEAD}1 {IDENTITY.replace('1', '1e300')}\n2 {IDENTITY.replace('0', '1e308', 1)}\n", "not positive definite"),
    ],
)
def test_a_file_that_holds_no_covariances_is_one_clear_line(tmp_path, text, message):
    path = tmp_path / "covariances.txt"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=message) as caught:
        read_covariances(path)
    assert "\n" not in str(caught.value)


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "covariances.txt").symlink_to("/etc/passwd")
    with pytest.raises(InvalidInput, match="is a link"):
        read_covariances(tmp_path / "covariances.txt")
