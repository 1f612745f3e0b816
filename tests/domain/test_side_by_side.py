"""The one rule for runs side by side: what is not comparable, in which words, and what would make it comparable."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind
from slamhive.domain.side_by_side import (
    MixedProtocols,
    ProtocolUse,
    common_protocol,
    mixed_protocols,
    of_live,
    short_names,
)

SE3, SIM3 = Protocol(Alignment.SE3), Protocol(Alignment.SIM3)
KNOWN = {protocol.fingerprint: protocol for protocol in (SE3, SIM3)}


def use(protocol: Protocol, runs: int, trajectory: TrajectoryKind | None = None) -> ProtocolUse:
    return ProtocolUse(protocol.fingerprint, protocol.label, trajectory, runs)


def mixed(*uses: ProtocolUse) -> MixedProtocols:
    found = mixed_protocols(uses, KNOWN)
    assert found is not None
    return found


def test_runs_under_one_protocol_are_comparable():
    assert mixed_protocols([use(SE3, 3), use(SE3, 4)], KNOWN) is None
    assert mixed_protocols([], KNOWN) is None


def test_a_mix_says_how_many_use_what_and_offers_the_freer_alignment():
    found = mixed(use(SIM3, 4), use(SIM3, 2), use(SE3, 6))
    assert found.words == "6 runs use SE(3), 6 Sim(3): not comparable."
    assert found.common == use(SIM3, 6)
    assert found.common_name == "Sim(3)"
    assert found.remedy.endswith(f"slamhive evaluate RUNS --protocol {SIM3.fingerprint} --current")


def test_the_most_used_comes_first_and_one_run_is_singular():
    assert mixed(use(SIM3, 1), use(SE3, 7)).words == "7 runs use SE(3), 1 Sim(3): not comparable."
    assert mixed_protocols([use(SIM3, 1), use(SE3, 1)]) is not None
    assert mixed(use(SE3, 1), use(SIM3, 1)).words.startswith("1 run uses ")


def test_live_and_final_trajectories_are_not_comparable_under_one_protocol():
    found = mixed(use(SE3, 5, TrajectoryKind.LIVE), use(SE3, 6, TrajectoryKind.FINAL))
    assert found.only_trajectories
    assert found.common is None
    assert found.words == "6 runs use the final trajectory, 5 the live trajectory: not comparable."


def test_live_poses_of_all_runs_are_the_way_out_where_they_have_been_judged():
    live = of_live(SE3)
    known = {SE3.fingerprint: SE3, live.fingerprint: live}
    uses = [use(SE3, 5, TrajectoryKind.LIVE), use(SE3, 6, TrajectoryKind.FINAL)]
    found = mixed_protocols(uses, known)
    assert found is not None
    assert found.common is not None
    assert (found.common.fingerprint, found.common_name) == (live.fingerprint, "the live trajectory")
    assert f"--protocol {live.fingerprint} --current" in found.remedy
    # Under it, the kind of traj.txt no longer matters.
    assert mixed_protocols([use(live, 5, TrajectoryKind.LIVE), use(live, 6, TrajectoryKind.FINAL)], known) is None


def test_one_run_without_live_poses_does_not_send_the_others_back_to_what_was_mixed():
    live = of_live(SE3)
    known = {SE3.fingerprint: SE3, live.fingerprint: live}
    uses = [use(live, 5, TrajectoryKind.LIVE), use(live, 6, TrajectoryKind.FINAL), use(SE3, 1, TrajectoryKind.FINAL)]
    found = mixed_protocols(uses, known)
    assert found is not None
    assert found.common is not None
    assert found.common.fingerprint == live.fingerprint
    # Those that have no live poses are named, and what was tried in vain is not offered again.
    found = mixed_protocols(uses, known, {live.fingerprint: 1})
    assert found is not None
    assert found.common is None
    assert found.words.endswith("not comparable. No evaluation of the live trajectory of 1 run succeeded.")
    assert found.remedy == "compare runs of one kind of trajectory"
    final = replace(SE3, trajectory=TrajectoryKind.FINAL)
    found = mixed_protocols(uses, known | {final.fingerprint: final}, {live.fingerprint: 1})
    assert found is not None
    assert found.common is not None
    assert found.common.fingerprint == final.fingerprint


def test_a_run_that_does_not_say_its_kind_stands_beside_either():
    assert mixed_protocols([use(SE3, 5, TrajectoryKind.LIVE), use(SE3, 6)]) is None


def test_a_protocol_that_names_its_trajectory_settles_the_kind():
    named = Protocol(Alignment.SE3, trajectory=TrajectoryKind.LIVE)
    assert mixed_protocols([use(named, 2, TrajectoryKind.FINAL), use(named, 2, TrajectoryKind.LIVE)]) is None


@pytest.mark.parametrize(
    ("alignments", "common"),
    [
        ("se3 sim3", "sim3"),
        ("yaw_position se3", "se3"),
        ("none first_pose yaw_position", "yaw_position"),
        ("scale none", "scale"),
        ("scale sim3", "sim3"),
        ("scale se3", None),  # neither removes what the other does
    ],
)
def test_the_common_protocol_removes_what_every_other_does(alignments: str, common: str | None):
    chosen = common_protocol([Protocol(Alignment(name)) for name in alignments.split()])
    assert (None if chosen is None else chosen.alignment) == common


def test_of_equal_alignments_the_most_used_protocol_is_common():
    other = Protocol(Alignment.SIM3, association_tolerance_s=0.02)
    assert common_protocol([SE3, other, SIM3]) == other


def test_names_drop_the_words_that_all_share():
    other = Protocol(Alignment.SE3, association_tolerance_s=0.02)
    assert short_names([SIM3.label, SE3.label]) == ["Sim(3)", "SE(3)"]
    assert short_names([SIM3.label, other.label]) == ["Sim(3), association 0.01 s", "SE(3), association 0.02 s"]
    assert short_names([SE3.label, f"{SE3.label}, live trajectory"]) == ["SE(3)", "SE(3), live trajectory"]


def test_many_protocols_are_counted_and_not_named():
    others = [Protocol(Alignment.SE3, association_tolerance_s=0.1 * number) for number in range(1, 6)]
    words = mixed(*(use(protocol, 10 - place) for place, protocol in enumerate(others))).words
    assert words.endswith("13 others: not comparable.")
