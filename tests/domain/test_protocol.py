"""A protocol's fingerprint, its plain form, and what it cannot be."""

import math
from dataclasses import fields

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import (
    Alignment,
    Association,
    Duplicates,
    Protocol,
    ProtocolRequest,
    RpePairs,
    SegmentRule,
    exactly,
    protocol_from_content,
)
from slamhive.domain.sensors import IDENTITY4

EVERYTHING = Protocol(
    alignment=Alignment.SIM3,
    association_tolerance_s=0.02,
    gap_threshold_s=2.0,
    rpe_delta_m=5.0,
    association=Association.ONE_TO_ONE,
    interpolation_interval_s=0.2,
    time_offset_s=-0.5,
    offset_search_s=1.0,
    align_poses=100,
    T_body_sensor=IDENTITY4,
    reference="leica.txt",
    rpe_pairs=RpePairs.CONSECUTIVE,
    rpe_delta_s=2.0,
    rpe_delta_frames=5,
    rpe_delta_deg=30.0,
    segment_lengths_m=(8.0, 16.0),
    segment_tolerance_m=0.5,
)


@pytest.mark.parametrize(
    ("protocol", "fingerprint"),
    [
        (Protocol(Alignment.SE3), "9ef7844a7e18"),
        (Protocol(Alignment.SIM3), "babf6e45e390"),
        (Protocol(Alignment.YAW_POSITION), "ddded99b5beb"),
        (Protocol(Alignment.SE3, time_offset_s=0.05), "1284fcfd6cc9"),
        (EVERYTHING, "c6b429ef47b8"),
    ],
)
def test_fingerprints_stay_what_they_are(protocol: Protocol, fingerprint: str) -> None:
    """Figures are filed under these: a change here would part old figures from new ones of the same protocol."""
    assert protocol.fingerprint == fingerprint


def test_a_repair_of_duplicates_has_a_fingerprint_and_a_name_of_its_own() -> None:
    plain = Protocol(Alignment.SE3)
    assert Protocol(Alignment.SE3, duplicates=Duplicates.REFUSE) == plain
    repaired = [Protocol(Alignment.SE3, duplicates=how) for how in Duplicates]
    assert len({entry.fingerprint for entry in repaired}) == len({entry.label for entry in repaired}) == len(Duplicates)
    assert protocol_from_content(repaired[1].content) == repaired[1]
    assert repaired[1].label.endswith("duplicate timestamps: the first counts")


def test_a_tools_way_with_segments_and_pairs_has_a_fingerprint_and_a_name_of_its_own() -> None:
    plain = Protocol(Alignment.SE3)
    assert Protocol(Alignment.SE3, segment_rule=SegmentRule.MATCHED, hold_interval_s=None).content == plain.content
    for changed, words in (
        (Protocol(Alignment.SE3, segment_rule=SegmentRule.RPG), "segments as rpg counts"),
        (Protocol(Alignment.SE3, segment_rule=SegmentRule.ETH3D), "segments as ETH3D counts"),
        (Protocol(Alignment.SE3, segment_lengths_m=(0.5, 2.0)), "segments of 0.5/2 m"),
        (Protocol(Alignment.SE3, association=Association.HOLD, hold_interval_s=0.1), "with a next one within 0.1 s"),
        (Protocol(Alignment.SE3, rpe_pairs=RpePairs.TUM), "pairs as TUM counts"),
        (Protocol(Alignment.SE3, association=Association.SWEEP), "association in one sweep 0.01 s"),
        (Protocol(Alignment.YAW_POSITION, align_poses=1), "yaw + position of the first pose"),
    ):
        assert changed.fingerprint != plain.fingerprint
        assert words in changed.label
        assert protocol_from_content(changed.content) == changed


def test_whole_numbers_are_numbers() -> None:
    assert Protocol(Alignment.SE3, rpe_delta_m=2).fingerprint == Protocol(Alignment.SE3, rpe_delta_m=2.0).fingerprint


def test_every_field_shows_in_fingerprint_and_label() -> None:
    plain = Protocol(Alignment.SE3)
    for name, value in EVERYTHING.content.items():
        one = protocol_from_content({**plain.content, name: value})
        assert one.fingerprint != plain.fingerprint, name
        if name != "interpolation_interval_s":  # it shows where it counts, below
            assert one.label != plain.label, name
    assert "0.2 s" in Protocol(Alignment.SE3, association=Association.INTERPOLATE, interpolation_interval_s=0.2).label


def test_the_plain_form_is_read_back() -> None:
    for protocol in (Protocol(Alignment.NONE), EVERYTHING):
        assert protocol_from_content(protocol.content) == protocol


def test_the_plain_form_of_before_the_new_fields_is_read() -> None:
    content = {"alignment": "se3", "association_tolerance_s": 0.01, "gap_threshold_s": 1.0, "rpe_delta_m": 1.0}
    assert protocol_from_content(content) == Protocol(Alignment.SE3)
    assert Protocol(Alignment.SE3).content == content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "needs an alignment"),
        ({"alignment": "magic"}, "alignment 'magic' is not known"),
        ({"alignment": "se3", "association": 3}, "association 3 is not known"),
        ({"alignment": "se3", "rpe_delta": 1}, "no field 'rpe_delta'; did you mean 'rpe_delta_s'"),
        ({"alignment": "se3", "rpe_delta_m": "1"}, "type that is not allowed"),
        ({"alignment": "se3", "T_body_sensor": "unity"}, "type that is not allowed"),
        ({"alignment": "se3", "T_body_sensor": [1.0] * 16}, "rotation with a translation"),
        ({"alignment": "se3", "T_body_sensor": [*IDENTITY4[:3], 2000.0, *IDENTITY4[4:]]}, "moves by more than 1000 m"),
        ({"alignment": "se3", "segment_lengths_m": list(range(1, 102))}, "has 101 lengths; give 100 at most"),
        ({"alignment": "se3", "reference": 5}, "reference 5 is not the name of a file"),
        ({"alignment": "se3", "segment_lengths_m": [2, 1]}, r"segment_lengths_m \[2.0, 1.0\] must grow"),
    ],
)
def test_what_is_no_protocol_is_refused(content: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        protocol_from_content(content)


BOUNDS = {
    entry.name: (entry.metadata["minimum"], entry.metadata["maximum"])
    for entry in fields(Protocol)
    if "minimum" in entry.metadata
}


@pytest.mark.parametrize("name", BOUNDS)
def test_numbers_have_bounds(name: str) -> None:
    minimum, maximum = BOUNDS[name]
    for value in (minimum - 1, maximum + 1, math.nan, math.inf):
        with pytest.raises(InvalidInput, match=f"{name} .* is not allowed; use "):
            protocol_from_content({"alignment": "se3", name: [value] if name.endswith("lengths_m") else value})


def test_a_request_leaves_the_rest_as_it_is() -> None:
    default = Protocol(Alignment.SIM3, association_tolerance_s=0.03)
    assert ProtocolRequest().on(default) == default
    assert ProtocolRequest({"alignment": "se3"}).on(default) == Protocol(Alignment.SE3, association_tolerance_s=0.03)
    assert exactly(Protocol(Alignment.SE3), "x").on(default) == Protocol(Alignment.SE3)
    assert exactly(EVERYTHING, "x").on(default) == EVERYTHING
    with pytest.raises(InvalidInput, match=r"protocol mine\.yaml: rpe_delta_m -1 is not allowed"):
        ProtocolRequest({"rpe_delta_m": -1}, "mine.yaml").on(default)
