import contextlib
import struct

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.evaluation.evaluators.map_quality import MAX_POINTS, read_pcd, unpack_lzf
from slamhive.runtime.pcd import format_pcd, write_pcd

POINTS_M = np.array([[1.0, 2.0, 3.0], [-4.5, 0.25, 8.0], [0.0, -1.0, 1e3]])
HEAD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {data}\n"


def literal_lzf(data: bytes) -> bytes:
    """LZF that only copies."""
    parts = [data[start : start + 32] for start in range(0, len(data), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


def read(tmp_path, content: bytes | str):
    path = tmp_path / "Map.pcd"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_pcd(path, "Map.pcd")


def test_what_is_written_is_read(tmp_path):
    write_pcd(tmp_path / "Map.pcd", POINTS_M)
    np.testing.assert_array_equal(read_pcd(tmp_path / "Map.pcd", "Map.pcd"), POINTS_M)


def test_points_that_are_not_finite_are_left_out(tmp_path):
    holes = np.vstack([POINTS_M, [np.nan, 0, 0], [0, np.inf, 0]])
    np.testing.assert_array_equal(read(tmp_path, format_pcd(holes)), POINTS_M)


def test_ascii_with_more_fields_in_another_order(tmp_path):
    text = (
        "# .PCD v.7\nVERSION .7\nFIELDS intensity z normal x y\nSIZE 4 4 4 8 4\nTYPE U F F F F\nCOUNT 1 1 3 1 1\n"
        "WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n7 3 0 0 1 1 2\n8 nan 0 0 1 1 2\n"
    )
    np.testing.assert_array_equal(read(tmp_path, text), [[1, 2, 3]])


def test_binary_with_padding_and_colours_as_pcl_writes_it(tmp_path):
    head = (
        "VERSION 0.7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 4 1\n"
        "WIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary\n"
    )
    rows = b"".join(struct.pack("<fff4sf", *point, b"\xff" * 4, 1.0) for point in POINTS_M)
    np.testing.assert_array_equal(read(tmp_path, head.encode() + rows), POINTS_M)


def test_compressed(tmp_path):
    data = POINTS_M.astype("<f4").T.tobytes()
    packed = literal_lzf(data)
    head = HEAD.format(n=3, data="binary_compressed").encode() + struct.pack("<II", len(packed), len(data))
    np.testing.assert_array_equal(read(tmp_path, head + packed), POINTS_M)


def test_lzf_back_references():
    packed = bytes([2]) + b"abc" + bytes([(1 << 5) | 0, 2]) + bytes([(7 << 5) | 0, 10, 0])
    # "abc", then 3 bytes from 3 back, then 7 + 10 + 2 bytes from 1 back.
    assert unpack_lzf(packed, 25, "x") == b"abcabc" + b"c" * 19


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "its header has no DATA line"),
        ("hello\n", "its header has no DATA line"),
        ("x" * 30_000 + "\nDATA ascii\n", "its header has no DATA line"),
        ("DATA ascii\n", "its header names 0 fields"),
        (HEAD.format(n=1, data="ascii").replace("x y z", "x y w") + "1 2 3\n", "it has no field z"),
        (HEAD.format(n=1, data="ascii").replace("SIZE 4 4 4", "SIZE 4 4"), "differ in length"),
        (HEAD.format(n=1, data="ascii").replace("SIZE 4 4 4", "SIZE 4 4 3"), "type F and size 3 is not known"),
        (HEAD.format(n=1, data="ascii").replace("COUNT 1 1 1", "COUNT 1 1 999999"), "COUNT is 999999, more than"),
        (HEAD.format(n=1, data="ascii").replace("COUNT 1 1 1", "COUNT 1 1 2"), "x, y and z must have one number"),
        (HEAD.format(n=MAX_POINTS + 1, data="binary"), f"POINTS is {MAX_POINTS + 1}, more than"),
        (HEAD.format(n=10**14, data="binary"), "more than"),
        (HEAD.format(n="-5", data="binary"), "POINTS is '-5', not a whole number"),
        (HEAD.format(n=5, data="binary") + "abc", "is cut off: it holds 3 of 60 bytes"),
        (HEAD.format(n=2, data="ascii") + "1 2 3\n", "is cut off: it holds 1 of 2 points"),
        (HEAD.format(n=1, data="ascii") + "1 2 three\n", "a line of its points is not numbers"),
        (HEAD.format(n=1, data="zip"), "DATA is 'zip', not one of"),
        (HEAD.format(n=0, data="binary"), "has no finite point"),
        (HEAD.format(n=1, data="ascii") + "nan nan nan\n", "has no finite point"),
        (HEAD.format(n=1, data="binary_compressed") + "abc", "is cut off: it holds 3 bytes"),
        (HEAD.format(n=1, data="binary_compressed").encode() + struct.pack("<II", 5, 4_000_000_000), "it unpacks to"),
        (HEAD.format(n=1, data="binary_compressed").encode() + struct.pack("<II", 50, 12) + b"a", "1 of 50 bytes"),
        (HEAD.format(n=1, data="binary_compressed").encode() + struct.pack("<II", 3, 12) + b"\xff\xff\xff", "damaged"),
        (HEAD.format(n=1, data="binary_compressed").encode() + struct.pack("<II", 2, 12) + b"\x1fa", "damaged"),
    ],
)
def test_a_file_that_is_no_cloud_is_one_clear_line(tmp_path, content, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        read(tmp_path, content)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_no_file_and_a_link(tmp_path):
    with pytest.raises(InvalidInput, match=r"Map\.pcd does not exist"):
        read_pcd(tmp_path / "Map.pcd", "Map.pcd")
    (tmp_path / "Map.pcd").symlink_to("/etc/passwd")
    with pytest.raises(InvalidInput, match="is a link"):
        read_pcd(tmp_path / "Map.pcd", "Map.pcd")


@pytest.mark.parametrize("seed", range(20))
def test_damaged_bytes_are_never_more_than_invalid_input(tmp_path, seed):
    rng = np.random.default_rng(seed)
    data = POINTS_M.astype("<f4").T.tobytes()
    packed = literal_lzf(data)
    kinds = (
        format_pcd(POINTS_M),
        HEAD.format(n=3, data="binary_compressed").encode() + struct.pack("<II", len(packed), len(data)) + packed,
        HEAD.format(n=2, data="ascii").encode() + b"1 2 3\n4 5 6\n",
    )
    for whole in kinds:
        damaged = bytearray(whole[: rng.integers(1, len(whole) + 1)])
        for place in rng.integers(0, len(damaged), 5):
            damaged[place] = rng.integers(0, 256)
        with contextlib.suppress(InvalidInput):
            assert read(tmp_path, bytes(damaged)).shape[1] == 3
