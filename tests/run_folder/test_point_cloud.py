"""Maps for a screen: samples, voxels, and files that an algorithm damaged or made to do harm."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.run_folder import point_cloud
from slamhive.run_folder.point_cloud import MapCloud, map_size, sampled_cloud, thinned_cloud
from slamhive.runtime.pcd import format_pcd

pytestmark = pytest.mark.quick

HEAD = "VERSION .7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {data}\n"


def head(points: int, data: str, fields: str = "x y z") -> bytes:
    many = len(fields.split())
    sizes, types = " ".join(["4"] * many), " ".join(["F"] * many)
    return HEAD.format(n=points, data=data, fields=fields, sizes=sizes, types=types).encode()


def plane(count: int) -> np.ndarray:
    """Points on a floor of 20 m x 20 m, dense in one corner."""
    return np.column_stack([20 * np.random.default_rng(3).random((count, 2)) ** 3, np.zeros(count)])


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read in so many pieces that every seam is crossed."""
    monkeypatch.setattr(point_cloud, "PIECE_BYTES", 1000)


def written(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "Map.pcd"
    path.write_bytes(content)
    return path


def rows_of(cloud: MapCloud) -> set[tuple[float, ...]]:
    return set(map(tuple, cloud.positions_m.tolist()))


@pytest.mark.usefixtures("small_pieces")
def test_a_sample_is_spread_over_the_file_and_always_the_same(tmp_path: Path):
    points_m = np.column_stack([np.arange(1000.0)] * 3)
    path = written(tmp_path, format_pcd(points_m))
    cloud = sampled_cloud(path, "Map.pcd", most=100)
    assert (len(cloud.positions_m), cloud.total, cloud.voxel_m) == (100, 1000, None)
    assert (cloud.positions_m[:, 0] // 10).tolist() == list(range(100)), "one of each ten"
    assert rows_of(cloud) == rows_of(sampled_cloud(path, "Map.pcd", most=100))
    assert map_size(path, "Map.pcd") == 1000


@pytest.mark.integration
@pytest.mark.usefixtures("small_pieces")
def test_no_voxel_holds_two_points_and_sparse_places_are_kept(tmp_path: Path):
    points_m = np.vstack([plane(20_000), [[60.0, 60.0, 5.0]]]).astype(np.float32)
    cloud = thinned_cloud(written(tmp_path, format_pcd(points_m)), "Map.pcd", most=500)
    assert 200 < len(cloud.positions_m) <= 500
    assert cloud.voxel_m is not None
    middle_m = np.median(sampled_cloud(tmp_path / "Map.pcd", "Map.pcd", most=500).positions_m, axis=0)
    cells = np.floor((cloud.positions_m - middle_m) / cloud.voxel_m)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert rows_of(cloud) <= set(map(tuple, points_m.astype(float).tolist())), "points of the map, not means"
    assert (60.0, 60.0, 5.0) in rows_of(cloud)


def test_a_small_map_is_shown_whole(tmp_path: Path):
    path = written(tmp_path, format_pcd(plane(50)))
    assert len(sampled_cloud(path, "Map.pcd").positions_m) == 50
    assert thinned_cloud(path, "Map.pcd").voxel_m is None


@pytest.mark.usefixtures("small_pieces")
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_intensities_come_with_every_encoding(tmp_path: Path, encoding: str):
    rows = np.column_stack([plane(300), np.arange(300) / 300, np.arange(300)]).astype("<f4")
    data = {
        "ascii": "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode() + b"\n",
        "binary": rows.tobytes(),
        "binary_compressed": compressed(rows.T.tobytes()),
    }[encoding]
    path = written(tmp_path, head(300, encoding, "x y z ring intensity") + data)
    cloud = sampled_cloud(path, "Map.pcd")
    np.testing.assert_allclose(cloud.positions_m, rows[:, :3], atol=1e-6)
    assert cloud.intensities is not None
    assert cloud.intensities.tolist() == list(range(300))


def compressed(data: bytes) -> bytes:
    """LZF that only copies."""
    parts = [data[start : start + 32] for start in range(0, len(data), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return struct.pack("<II", len(packed), len(data)) + packed


def test_points_that_are_nowhere_are_left_out(tmp_path: Path):
    points_m = np.array([[1.0, 2, 3], [np.nan, 0, 0], [0, np.inf, 0], [4, 5, 6]])
    assert rows_of(sampled_cloud(written(tmp_path, format_pcd(points_m)), "Map.pcd")) == {(1, 2, 3), (4, 5, 6)}


def test_one_point_far_away_does_not_blur_the_rest(tmp_path: Path):
    points_m = np.vstack([plane(5000), [[3e38, 0.0, 0.0]]])
    cloud = thinned_cloud(written(tmp_path, format_pcd(points_m)), "Map.pcd", most=500)
    assert len(cloud.positions_m) > 200
    assert cloud.voxel_m is not None
    assert cloud.voxel_m < 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no DATA line"),
        (b"\x00" * 100_000, "no DATA line"),
        (format_pcd(plane(100))[:-1], "is cut off"),
        (head(100, "ascii") + b"1 2 3\n", "cut off: it holds 1 of 100 points"),
        (head(2, "ascii") + b"1 2 3\none two three\n", "not numbers"),
        (head(2, "ascii") + b"1" * 30_000_000, "a line of more than"),
        (head(10**14, "binary"), "POINTS is 100000000000000, more than"),
        (head(1, "binary").replace(b"FIELDS x", b"FIELDS q"), "no field x"),
        (head(5, "zipped"), "DATA is 'zipped'"),
        (head(20_000_000, "binary_compressed"), "save it with DATA binary"),
        (head(0, "binary"), "no finite point"),
        (format_pcd(np.full((3, 3), np.nan)), "no finite point"),
    ],
)
def test_a_damaged_map_gives_one_line(tmp_path: Path, content: bytes, words: str):
    path = written(tmp_path, content)
    for read in (sampled_cloud, thinned_cloud):
        with pytest.raises(InvalidInput) as caught:
            read(path, "Map.pcd")
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
        assert "Map.pcd" in str(caught.value)


def test_a_link_is_not_followed(tmp_path: Path):
    (tmp_path / "secret.pcd").write_bytes(format_pcd(plane(5)))
    (tmp_path / "Map.pcd").symlink_to(tmp_path / "secret.pcd")
    with pytest.raises(NotFound):
        sampled_cloud(tmp_path / "Map.pcd", "Map.pcd")


def test_memory_does_not_grow_with_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(point_cloud, "PIECE_BYTES", 100_000)
    peaks = []
    for count in (30_000, 300_000):
        path = written(tmp_path, format_pcd(plane(count)))
        tracemalloc.start()
        thinned_cloud(path, "Map.pcd", most=2000)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0], peaks
