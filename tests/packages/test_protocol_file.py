"""Protocol files: what they may say, and that every mistake is told with its line."""

import json
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import (
    Alignment,
    Association,
    Duplicates,
    FrameFit,
    Protocol,
    RpePairs,
    SegmentRule,
    TrajectoryKind,
)
from slamhive.packages.protocol_file import load_protocol, parse_protocol, protocol_schema

WHOLE = """\
# Leica prism, one clock late
alignment: se3
align_poses: 500
association: interpolate
association_tolerance_s: 0.02
interpolation_interval_s: 0.2
time_offset_s: -0.1
offset_search_s: 1
T_body_sensor: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, -0.05, 0, 0, 0, 1]
reference: leica.txt
gap_threshold_s: 2
rpe_pairs: consecutive
rpe_delta_m: 5
rpe_delta_s: 2
rpe_delta_frames: 10
rpe_delta_deg: 45
segment_lengths_m: [8, 16, 24]
segment_tolerance_m: 0.5
duplicates: mean
segment_rule: rpg
hold_interval_s: 0.1
trajectory: live
frame_fit: pose
lever_arm_m: [0.1, 0, 1.2]
leave_out_s: [12.5, 20, 61, 64]
"""


def test_every_field_is_read(tmp_path: Path) -> None:
    path = tmp_path / "leica.yaml"
    path.write_text(WHOLE)
    protocol = load_protocol(path).on(Protocol(Alignment.SIM3))
    assert protocol == Protocol(
        alignment=Alignment.SE3,
        align_poses=500,
        association=Association.INTERPOLATE,
        association_tolerance_s=0.02,
        interpolation_interval_s=0.2,
        time_offset_s=-0.1,
        offset_search_s=1,
        T_body_sensor=(1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, -0.05, 0, 0, 0, 1),
        reference="leica.txt",
        gap_threshold_s=2,
        rpe_pairs=RpePairs.CONSECUTIVE,
        rpe_delta_m=5,
        rpe_delta_s=2,
        rpe_delta_frames=10,
        rpe_delta_deg=45,
        segment_lengths_m=(8, 16, 24),
        segment_tolerance_m=0.5,
        duplicates=Duplicates.MEAN,
        segment_rule=SegmentRule.RPG,
        hold_interval_s=0.1,
        trajectory=TrajectoryKind.LIVE,
        frame_fit=FrameFit.POSE,
        lever_arm_m=(0.1, 0.0, 1.2),
        leave_out_s=(12.5, 20.0, 61.0, 64.0),
    )
    fields = {line.partition(":")[0] for line in WHOLE.splitlines() if not line.startswith("#")}
    assert set(json.loads(protocol_schema())["properties"]) == fields


def test_numbers_written_as_1_and_1_0_are_one_protocol() -> None:
    default = Protocol(Alignment.SE3)
    first, second = (parse_protocol(f"rpe_delta_m: {text}\n").on(default) for text in ("2", "2.0"))
    assert first.fingerprint == second.fingerprint


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("alignment: se3\nassociaton: nearest\n", "p.yaml line 2: unknown key 'associaton'; did you mean"),
        ("\nalignment: se4\n", "p.yaml line 2: alignment: must be 'none', 'first_pose', 'se3'"),
        ("rpe_delta_m: -1\n", "p.yaml line 1: rpe_delta_m: must be greater than or equal to 0.000001 (found -1)"),
        ("rpe_delta_m: .nan\n", "p.yaml line 1: rpe_delta_m: nan is not a finite number"),
        ("time_offset_s: .inf\n", "p.yaml line 1: time_offset_s: inf is not a finite number"),
        ("offset_search_s: 1000\n", "p.yaml line 1: offset_search_s: must be less than or equal to 60"),
        ("rpe_delta_frames: 1.5\n", "p.yaml line 1: rpe_delta_frames: must be a whole number (found 1.5)"),
        ("align_poses: true\n", "p.yaml line 1: align_poses: must be a whole number (found True)"),
        ("T_body_sensor: [1, 2]\n", "p.yaml line 1: T_body_sensor: must have at least 16 entries, not 2"),
        (f"T_body_sensor: {[2.0] * 16}\n", "p.yaml line 1: T_body_sensor: must be a rigid transform by rows"),
        (
            "reference: ../../etc/passwd\n",
            "p.yaml line 1: reference: must be the name of a file in the dataset",
        ),
        ("reference: ..\n", "p.yaml line 1: reference: must be the name of a file"),
        ("segment_lengths_m: []\n", "p.yaml line 1: segment_lengths_m: must have at least 1 entry, not 0"),
        (f"segment_lengths_m: {list(range(1, 102))}\n", "p.yaml line 1: segment_lengths_m: must have at most 100"),
        ("segment_lengths_m: [1, 1]\n", "p.yaml line 1: segment_lengths_m: must grow, each length once"),
        ("gap_threshold_s: 0\n", "p.yaml line 1: gap_threshold_s: must be greater than or equal to 0.001"),
        (
            "association_tolerance_s: -0.1\n",
            "p.yaml line 1: association_tolerance_s: must be greater than or equal to 0",
        ),
        ("rpe_delta_s: 0\n", "p.yaml line 1: rpe_delta_s: must be greater than or equal to 0.000001"),
        ("segment_lengths_m: [2, 1]\n", "p.yaml line 1: segment_lengths_m: must grow"),
        ("segment_lengths_m:\n- 1\n- x\n", "p.yaml line 3: segment_lengths_m.1: must be a number"),
        ("alignment: se3\nalignment: sim3\n", "p.yaml line 2: the key 'alignment' appears twice"),
        ("alignment: !!python/object x\n", "p.yaml line 1: the tag"),
        ("", "p.yaml: expected keys with values at the top level, found nothing"),
    ],
)
def test_mistakes_are_told_with_their_line(text: str, message: str) -> None:
    with pytest.raises(InvalidInput) as raised:
        parse_protocol(text, "p.yaml")
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="does not exist"):
        load_protocol(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidInput, match="is not UTF-8 text"):
        load_protocol(tmp_path / "binary.yaml")
