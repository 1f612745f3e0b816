"""Messages to numpy, trajectories to text, frames in groups."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.runtime.frames import FrameTimes, write_frames_csv
from slamhive.runtime.messages import to_grey, to_image, to_points
from slamhive.runtime.paths import find_recording, run_paths
from slamhive.runtime.trajectory import Poses, quaternions_xyzw, transform_from, write_trajectory
from slamhive.trajectory.layout import read_tum


def image(encoding: str, pixels: np.ndarray, padding: int = 0) -> SimpleNamespace:
    rows = pixels.reshape(pixels.shape[0], -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    return SimpleNamespace(
        encoding=encoding,
        height=pixels.shape[0],
        width=pixels.shape[1],
        step=padded.shape[1],
        is_bigendian=0,
        data=padded.ravel(),
    )


@pytest.mark.parametrize(("encoding", "dtype"), [("mono8", np.uint8), ("16UC1", np.uint16), ("32FC1", np.float32)])
def test_single_channel_images_keep_their_values(encoding: str, dtype: type) -> None:
    pixels: np.ndarray = np.arange(12, dtype=dtype).reshape(3, 4)
    assert np.array_equal(to_image(image(encoding, pixels, padding=3)), pixels)


def test_colour_comes_as_red_green_blue() -> None:
    bgr = np.array([[[1, 2, 3]]], dtype=np.uint8)
    assert to_image(image("bgr8", bgr)).tolist() == [[[3, 2, 1]]]
    assert to_grey(np.full((2, 2, 3), 77, dtype=np.uint8)).tolist() == [[77, 77], [77, 77]]


def test_an_unknown_encoding_and_a_short_image_are_refused() -> None:
    with pytest.raises(InvalidInput, match="yuv422"):
        to_image(image("yuv422", np.zeros((1, 1), np.uint8)))
    short = image("mono8", np.zeros((4, 4), np.uint8))
    short.data = short.data[:5]
    with pytest.raises(InvalidInput, match="holds 5 bytes, 16 expected"):
        to_image(short)


def test_points_lose_what_is_not_finite_and_keep_their_times() -> None:
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    table = np.array([(1, 2, 3, 10), (np.nan, 0, 0, 20), (4, 5, 6, 30)], dtype=layout)
    fields = [
        SimpleNamespace(name=name, offset=4 * index, datatype=7 if name != "t" else 6, count=1)
        for index, name in enumerate("xyzt")
    ]
    message = SimpleNamespace(
        fields=fields, height=1, width=3, point_step=16, row_step=48, is_bigendian=False, data=table.view(np.uint8)
    )
    cloud = to_points(message)
    assert cloud.points_m.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.field("t").tolist() == [10, 30]
    with pytest.raises(InvalidInput, match="the scans have no field 'time'; they have t"):
        cloud.field("time")


def test_quaternions_agree_with_the_rotations_they_come_from() -> None:
    quats = np.random.default_rng(1).standard_normal((200, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    quats *= np.where(quats[:, 3:] < 0, -1, 1)
    matrices = np.array([transform_from(np.zeros(3), quat)[:3, :3] for quat in quats])
    assert quaternions_xyzw(matrices) == pytest.approx(quats, abs=1e-12)


def test_the_written_trajectory_reads_back_in_order_of_time(tmp_path: Path) -> None:
    T = np.array([transform_from(np.array([1, 2, 3]), np.array([0, 0, 0.6, 0.8])), np.eye(4)])
    write_trajectory(tmp_path / "traj.txt", Poses(np.array([1403636580.863555500, 5.0]), T))
    back = read_tum(tmp_path / "traj.txt")
    assert back.stamps_s.tolist() == pytest.approx([5.0, 1403636580.8635555], abs=1e-6)
    assert back.quats_xyzw[1] == pytest.approx([0, 0, 0.6, 0.8])


@pytest.mark.parametrize("spoil", [np.nan, 7.0])
def test_a_pose_that_is_none_is_refused_and_nothing_is_written(tmp_path: Path, spoil: float) -> None:
    T = np.eye(4)[None].copy()
    T[0, 0, 0] = spoil
    with pytest.raises(InvalidInput, match="not a"):
        write_trajectory(tmp_path / "traj.txt", Poses(np.array([1.0]), T))
    assert not list(tmp_path.iterdir())


def test_frames_csv_lists_dropped_frames_in_their_place(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    write_frames_csv(path, [FrameTimes(1, 2.0, 0.2, None), FrameTimes(0, 1.0, 0.1, 0.15)])
    lines = ["timestamp,received,done,dropped", "1.000000000,0.100000,0.150000,0", "2.000000000,0.200000,,1"]
    assert path.read_text().splitlines() == lines


def test_places_come_from_the_contract_or_the_environment(tmp_path: Path) -> None:
    assert str(run_paths({}).config) == "/slamhive/config.yaml"
    assert run_paths({"SLAMHIVE_RESULT": "/elsewhere"}).result == Path("/elsewhere")
    with pytest.raises(InvalidInput, match="found none"):
        find_recording(tmp_path)
    (tmp_path / "a.mcap").touch()
    assert find_recording(tmp_path).name == "a.mcap"
