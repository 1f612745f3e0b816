from dataclasses import replace

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.evaluators.relations import RelationErrors, read_relations, relation_errors
from slamhive.trajectory.transforms import move_sensor, rotations_from_quats
from tests.evaluation.evaluators.curves import kept, loop, moved, paired, scaled


@pytest.fixture
def exact(tmp_path):
    """Relations of the loop itself, between poses 40 apart; it turns about z only."""
    truth = loop()
    R = rotations_from_quats(truth.quats_xyzw)
    lines = []
    for i in range(0, 360, 7):
        x, y, z = R[i].T @ (truth.positions_m[i + 40] - truth.positions_m[i])
        turn = R[i].T @ R[i + 40]
        yaw = np.arctan2(turn[1, 0], turn[0, 0])
        lines.append(f"{truth.stamps_s[i]:.9f} {truth.stamps_s[i + 40]:.9f} {x:.9f} {y:.9f} {z:.9f} 0 0 {yaw:.9f}\n")
    path = tmp_path / "loop.relations"
    path.write_text("".join(lines))
    return path


def test_a_perfect_estimate_in_any_world_has_no_error(exact):
    pair = paired(loop(), moved(loop()), files={"relations": exact})
    figures = RelationErrors().evaluate(pair)
    assert figures.missing == {}
    assert figures.values["relations.matched_fraction"] == 1
    for key in ("relations.translation.max", "relations.rotation.max"):
        assert figures.values[key] == pytest.approx(0, abs=1e-5)


def test_relations_are_of_the_body_whatever_sensor_the_estimate_describes(exact):
    T_body_sensor = np.eye(4)
    T_body_sensor[:3, :3] = rotations_from_quats(np.array([[0.5, -0.5, 0.5, 0.5]]))[0]
    T_body_sensor[:3, 3] = [0.4, -0.2, 0.1]
    sensor = move_sensor(loop(), T_body_sensor)
    pair = replace(paired(loop(), sensor, files={"relations": exact}), T_body_estimate=T_body_sensor)
    values = RelationErrors().evaluate(pair).values
    assert values["relations.translation.max"] == pytest.approx(0, abs=1e-5)
    assert values["relations.rotation.max"] == pytest.approx(0, abs=1e-5)


def test_an_estimate_of_unknown_scale_is_scaled_as_it_was_aligned(exact):
    small = scaled(moved(loop()), 0.2)
    files = {"relations": exact}
    of_sim3 = RelationErrors().evaluate(paired(loop(), small, Protocol(Alignment.SIM3), files=files)).values
    of_se3 = RelationErrors().evaluate(paired(loop(), small, files=files)).values
    assert of_sim3["relations.translation.max"] == pytest.approx(0, abs=1e-5)
    assert of_se3["relations.translation.max"] > 0.1


def test_relations_in_a_gap_or_beyond_the_ends_are_not_matched(exact):
    part = kept(loop(), (np.arange(400) < 150) | ((np.arange(400) > 250) & (np.arange(400) < 380)))
    values = relation_errors(read_relations(exact), part, 1.0)
    assert 0.2 < values["relations.matched_fraction"] < 0.6
    assert values["relations.translation.max"] == pytest.approx(0, abs=1e-5)


def test_between_poses_the_estimate_is_interpolated(exact):
    values = relation_errors(read_relations(exact), kept(loop(), np.arange(400) % 3 == 0), 1.0)
    assert values["relations.matched_fraction"] > 0.9
    assert values["relations.translation.max"] < 0.005


def test_all_three_angles_are_read(tmp_path):
    path = tmp_path / "a.relations"
    path.write_text("0 1 0 0 0 0.1 0.2 0.3\n")
    R = rotations_from_quats(read_relations(path).quats_xyzw)[0]
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.3)
    assert -np.arcsin(R[2, 0]) == pytest.approx(0.2)
    assert np.arctan2(R[2, 1], R[2, 2]) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("1 2 3\n", "line 1: 3 columns instead of 8"),
        ("1 2 0 0 0 0 0 x\n", "'x' is not a number"),
        ("1 2 0 0 0 0 0 nan\n", "line 1: a number is not finite"),
        ("1 2 0 0 0 0 0 3.1\n1 3 0 0 0 0 0 -90\n", "line 2: an angle of 90 is more than a turn; write radians"),
    ],
)
def test_a_malformed_file_is_one_clear_line(tmp_path, text, message):
    path = tmp_path / "a.relations"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=message):
        read_relations(path)


def test_another_clock_is_named(exact):
    late = loop()
    late = type(late)(late.stamps_s + 1e6, late.positions_m, late.quats_xyzw)
    with pytest.raises(InvalidInput, match="no poses at the times of any of the 52 relations"):
        relation_errors(read_relations(exact), late, 1.0)


def test_without_relations_the_figures_are_missing():
    assert set(RelationErrors().evaluate(paired(loop(), loop())).missing.values()) == {"the dataset has no relations"}
