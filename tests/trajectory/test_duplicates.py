"""Poses of one file that have the same timestamp: refused, merged or kept."""

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.layout import parse_positions, parse_tum
from slamhive.trajectory.transforms import interpolate

HALF = np.sqrt(0.5)
TEXT = f"""\
0 0 0 0 0 0 0 1
1 1 0 0 0 0 0 1
1 3 0 0 0 0 {-HALF} {-HALF}
1 5 3 0 0 0 {HALF} {HALF}
2 9 0 0 0 0 0 1
""".encode()


def test_they_are_refused_with_the_line_and_the_remedy() -> None:
    with pytest.raises(InvalidInput, match=r"t, line 3: timestamp 1\.000000000 occurs twice; .* --duplicates first"):
        parse_tum(TEXT, "t")


def test_the_first_is_kept() -> None:
    found = parse_tum(TEXT, "t", Duplicates.FIRST)
    assert found.stamps_s.tolist() == [0, 1, 2]
    assert found.positions_m[1].tolist() == [1, 0, 0]


def test_the_mean_is_taken_of_positions_and_of_orientations_whatever_their_sign() -> None:
    found = parse_tum(TEXT, "t", Duplicates.MEAN)
    assert found.stamps_s.tolist() == [0, 1, 2]
    assert found.positions_m[1].tolist() == [3, 1, 0]
    two = parse_tum(TEXT.replace(b"1 1 0 0 0 0 0 1\n", b"", 1), "t", Duplicates.MEAN)
    assert np.abs(two.quats_xyzw[1]) == pytest.approx([0, 0, HALF, HALF])
    between = parse_tum(f"1 0 0 0 0 0 0 1\n1 0 0 0 0 0 {HALF} {HALF}\n".encode(), "t", Duplicates.MEAN)
    assert between.quats_xyzw[0] == pytest.approx([0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)])


def test_all_are_kept() -> None:
    found = parse_tum(TEXT, "t", Duplicates.KEEP)
    assert found.stamps_s.tolist() == [0, 1, 1, 1, 2]


def test_positions_alone_are_repaired_too() -> None:
    text = b"0 0 0 0\n0 2 0 0\n1 5 0 0\n"
    assert parse_positions(text, "t", Duplicates.MEAN).positions_m[:, 0].tolist() == [1, 5]


def test_disorder_is_refused_whatever_is_done_with_duplicates() -> None:
    for how in Duplicates:
        with pytest.raises(InvalidInput, match=r"line 2: timestamp 1\.000000000 comes after 2\.000000000"):
            parse_tum(b"2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "t", how)


def test_between_kept_duplicates_nothing_is_divided_by_zero() -> None:
    text = b"0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n1 3 0 0 0 0 0 1\n"
    found = interpolate(parse_tum(text, "t", Duplicates.KEEP), np.array([0.5, 1.0, 2.0]))
    assert found.positions_m[:, 0].tolist() == [0.5, 3, 3]
