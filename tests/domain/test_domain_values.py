from __future__ import annotations

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.metrics import CATALOGUE, Direction, Group, metric
from slamhive.domain.names import check_name
from slamhive.domain.protocol import Alignment, Protocol, default_alignment
from slamhive.domain.run import LEGAL_MOVES, RunState, check_move
from slamhive.domain.sensors import SensorSetup


@pytest.mark.parametrize(
    "name", ["../x", "a/b", "a\\b", "", ".", "..", "a..b", "-x", "a b", "a\nb", "<b>", "a'b", 'a"b', "ä", "x" * 65]
)
def test_names_that_could_leave_a_folder_or_a_page_are_refused(name):
    with pytest.raises(InvalidInput, match="name"):
        check_name("dataset", name)


@pytest.mark.parametrize("name", ["room", "kitti_06", "orb-slam3-stereo", "V1_01.easy", "x" * 64])
def test_plain_names_are_fine(name):
    assert check_name("dataset", name) == name


def test_equal_content_has_an_equal_hash_whatever_the_order():
    one = Configuration("a", "d", {"x": 1, "y": (1.0, 2.0)})
    other = Configuration("a", "d", {"y": (1.0, 2.0), "x": 1})
    assert one.content_hash == other.content_hash


@pytest.mark.parametrize(
    "other",
    [
        Configuration("b", "d", {"x": 1}),
        Configuration("a", "e", {"x": 1}),
        Configuration("a", "d", {"x": 1.0}),
        Configuration("a", "d", {"x": True}),
        Configuration("a", "d", {"x": "1"}),
        Configuration("a", "d", {"x": 1}, Playback(PlaybackMode.SEQUENTIAL)),
        Configuration("a", "d", {"x": 1}, Playback(rate=2.0)),
    ],
)
def test_any_difference_makes_another_configuration(other):
    assert Configuration("a", "d", {"x": 1}).content_hash != other.content_hash


def test_every_state_has_its_moves_and_ends_have_none():
    assert set(LEGAL_MOVES) == set(RunState)
    for state, targets in LEGAL_MOVES.items():
        assert state.ended == (not targets)
        assert state not in targets


def test_every_state_is_reached_from_queued():
    reached = {RunState.QUEUED}
    for _ in RunState:
        reached |= {target for state in reached for target in LEGAL_MOVES[state]}
    assert reached == set(RunState)


def test_an_illegal_move_names_run_and_states():
    with pytest.raises(Conflict, match="run 7 is succeeded, it cannot become running"):
        check_move(7, RunState.SUCCEEDED, RunState.RUNNING)


@pytest.mark.parametrize(
    ("setup", "gravity", "expected"),
    [
        (SensorSetup.MONO, True, Alignment.SIM3),
        (SensorSetup.MONO_INERTIAL, True, Alignment.YAW_POSITION),
        (SensorSetup.STEREO_INERTIAL, True, Alignment.YAW_POSITION),
        (SensorSetup.STEREO_INERTIAL, False, Alignment.SE3),
        (SensorSetup.STEREO, True, Alignment.SE3),
        (SensorSetup.RGBD, True, Alignment.SE3),
        (SensorSetup.LIDAR, True, Alignment.SE3),
        (SensorSetup.LIDAR_INERTIAL, True, Alignment.SE3),
    ],
)
def test_alignment_follows_what_the_sensors_cannot_observe(setup, gravity, expected):
    assert default_alignment(setup, gravity_aligned=gravity) is expected


def test_the_fingerprint_tells_protocols_apart_and_is_stable():
    protocol = Protocol(Alignment.SE3)
    assert protocol.fingerprint == Protocol(Alignment.SE3).fingerprint
    others = [Protocol(Alignment.SIM3), Protocol(Alignment.SE3, association_tolerance_s=0.02)]
    assert len({protocol.fingerprint, *(other.fingerprint for other in others)}) == 3


def test_each_metric_is_whole_and_defined_once():
    for key, entry in CATALOGUE.items():
        assert key == entry.key
        assert entry.label
        assert entry.definition.endswith(".")
    assert CATALOGUE["ate.rmse"].unit == "m"
    assert CATALOGUE["ate.sse"].unit == "m²"


def test_every_mean_over_pairs_or_segments_names_the_metric_that_counts_them():
    for entry in CATALOGUE.values():
        errors = entry.direction is Direction.LOWER or entry.key.endswith(".sse")
        sampled = entry.group in (Group.RELATIVE, Group.SEGMENTS) and errors
        assert bool(entry.counted_by) is sampled, entry.key
        if sampled:
            number = CATALOGUE[entry.counted_by]
            assert (number.unit, number.direction, number.group) == ("", Direction.NEUTRAL, entry.group)
    assert CATALOGUE["rpe_rot.seconds.mean"].sample({"rpe.seconds.pairs": 3600.0}) == "3,600 pairs"
    assert CATALOGUE["segment.metres.8m.median"].sample({"segment.count.8m": 1.0}) == "1 segment"
    assert CATALOGUE["rpe.rmse"].sample({"rpe.frames.pairs": 5.0}) == ""


def test_an_unknown_metric_gets_the_nearest():
    with pytest.raises(NotFound, match=r"did you mean 'ate\.rmse'"):
        metric("ate_rmse")
