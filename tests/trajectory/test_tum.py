import os
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.trajectory import table
from slamhive.trajectory.layout import parse_tum, read_tum, write_tum

GOOD = "1 0 0 0 0 0 0 1\n"


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    stamps_s = np.linspace(1.4e9, 1.4e9 + 2.5, 50)
    quats_xyzw = rng.normal(size=(50, 4))
    quats_xyzw /= np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    positions_m = rng.normal(size=(50, 3))
    write_tum(tmp_path / "t.txt", stamps_s, positions_m, quats_xyzw, header="two\nlines")
    trajectory = read_tum(tmp_path / "t.txt")
    np.testing.assert_allclose(trajectory.stamps_s, stamps_s, atol=1e-6)
    np.testing.assert_allclose(trajectory.positions_m, positions_m, atol=1e-9)
    np.testing.assert_allclose(trajectory.quats_xyzw, quats_xyzw, atol=1e-8)
    assert (tmp_path / "t.txt").read_text().startswith("# two\n# lines\n")
    assert [path.name for path in tmp_path.iterdir()] == ["t.txt"]


@pytest.mark.parametrize(
    "text",
    [
        GOOD + "2 0 0 0 0 0 0 1",
        "# comment\n\n" + GOOD + "  # another\r\n\t2 0 0 0 0 0 0 1 \r\n",
        "1,0,0,0,0,0,0,1\n2, 0, 0, 0, 0, 0, 0, 1\n",
        "\ufeff" + GOOD + "2 0 0 0 0 0 0 1.004\n",
    ],
)
def test_comments_blank_lines_commas_and_rounded_quaternions_are_fine(text: str) -> None:
    trajectory = parse_tum(text.encode(), "t.txt")
    assert len(trajectory) == 2
    assert np.linalg.norm(trajectory.quats_xyzw[1]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "t.txt is empty"),
        ("# only\n\n", "t.txt is empty"),
        (GOOD + "# c\n2 0 0 0 0 0 1\n", "t.txt, line 3: 7 columns instead of 8"),
        ("1 2 3 4 5 6 7 8 9\n" * 2, "t.txt, line 1: 9 columns instead of 8"),
        (GOOD + "2 0 0 nan 0 0 0 1\n", "t.txt, line 2: tz is nan"),
        (GOOD + "2 0 0 0 0 0 0 inf\n", "t.txt, line 2: qw is inf"),
        ("nan 0 0 0 0 0 0 1\n", "t.txt, line 1: timestamp is nan"),
        (GOOD + GOOD, "t.txt, line 2: timestamp 1.000000000 occurs twice"),
        (GOOD + "\n0.5 0 0 0 0 0 0 1\n", "t.txt, line 3: timestamp 0.500000000 comes after 1.000000000"),
        (GOOD + "2 0 0 0 0 0 0 2\n", "t.txt, line 2: quaternion has norm 2, not 1"),
        (GOOD + "2 0 0 0 0 0 0 0\n", "t.txt, line 2: quaternion is all zero"),
        (GOOD + "2 0 0 0 foo 0 0 1\n", "t.txt, line 2: 'foo' is not a number"),
        (GOOD + "2 0 0 1e300 0 0 0 1\n", "t.txt, line 2: position 1e+300 m is beyond"),
        (GOOD + "2 0 0 1_0 0 0 0 1\n", "t.txt, line 2: '1_0' is not a number"),
    ],
)
def test_every_mistake_is_named_with_file_line_value_and_remedy(text: str, message: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        parse_tum(text.encode(), "t.txt")
    assert str(caught.value).startswith(message)
    assert caught.value.remedy
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [b"\x89PNG\r\n\x1a\n\x00\x00", b"abc\x00def", bytes(range(256))])
def test_a_binary_file_is_told_apart(data: bytes) -> None:
    with pytest.raises(InvalidInput, match=r"t\.txt is not a text file: byte 0x"):
        parse_tum(data, "t.txt")


def test_a_huge_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "MAX_FILE_BYTES", 10)
    (tmp_path / "t.txt").write_text(GOOD)
    with pytest.raises(InvalidInput, match="more than"):
        read_tum(tmp_path / "t.txt")


def test_what_is_not_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(NotFound, match="does not exist"):
        read_tum(tmp_path / "nothing")
    for name in (".", "pipe"):
        with pytest.raises(InvalidInput, match="not a regular file"):
            read_tum(tmp_path / name)
