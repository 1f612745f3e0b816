"""Trajectories as systems and datasets write them: each format gives the poses that were written."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.formats import FORMATS
from slamhive.trajectory.layout import UNKNOWN, QuaternionOrder, TimeUnit
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.pose_file import TrajectoryFormat, read_pose_file
from tests.fuzzing import mutated

COUNT = 40
ANGLES = np.linspace(0.1, 2.0, COUNT)
TIMES_S = 1_500_000_000 + 0.5 * np.arange(COUNT)
POSITIONS_M = np.column_stack((5 * np.cos(ANGLES), 5 * np.sin(ANGLES), 0.3 * ANGLES))
ROTATIONS = Rotation.from_euler("ZYX", np.column_stack((ANGLES, 0.2 * np.sin(ANGLES), 0.1 * np.cos(3 * ANGLES))))
QUATS = ROTATIONS.as_quat()
UP = np.diag([1.0, -1.0, -1.0])
MATRICES = np.tile(np.eye(4), (COUNT, 1, 1))
MATRICES[:, :3, :3], MATRICES[:, :3, 3] = ROTATIONS.as_matrix(), POSITIONS_M
SYMBOL = ord("x") << 56


def lines(values: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(f"{number:.12f}" for number in row) + "\n" for row in values.tolist())


def colmap(names: list[str]) -> str:
    inverse = ROTATIONS.inv()
    wxyz, t = np.roll(inverse.as_quat(), 1, axis=1), -inverse.apply(POSITIONS_M)
    text = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
    # images stand in any order, and one without points has a blank line
    for number in np.random.default_rng(0).permutation(COUNT):
        numbers = " ".join(f"{value:.12f}" for value in (*wxyz[number], *t[number]))
        points = "" if number % 3 == 0 else "10.5 20.5 -1 7 8 99"
        text += f"{number + 1} {numbers} 1 {names[number]}\n{points}\n"
    return text


def g2o(keys: list[int]) -> str:
    vertices = "".join(
        f"VERTEX_SE3:QUAT {key} {row}"
        for key, row in zip(keys, lines(np.column_stack((POSITIONS_M, QUATS))).splitlines(keepends=True), strict=True)
    )
    return f"VERTEX_TRACKXYZ 900 1 2 3\n{vertices}EDGE_SE3:QUAT {keys[0]} {keys[1]} 1 0 0 0 0 0 1 1\n"


def nclt() -> str:
    down = Rotation.from_matrix(UP @ ROTATIONS.as_matrix() @ UP).as_euler("ZYX")[:, ::-1]
    rows = np.column_stack((POSITIONS_M @ UP, down))
    head = f"{int(TIMES_S[0] * 1e6) - 1},nan,nan,nan,nan,nan,nan\n"
    return head + "".join(
        f"{int(time * 1e6)},{row}"
        for time, row in zip(TIMES_S, lines(rows, ",").splitlines(keepends=True), strict=True)
    )


def boreas() -> str:
    """By the functions of pyboreas: C = roll(r) @ pitch(p) @ yaw(y), each the transpose of the usual one."""
    names = (
        "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,angvel_z,angvel_y,angvel_x\n"
    )
    yaw, pitch, roll = ROTATIONS.inv().as_euler("ZYX").T
    zero = np.zeros((COUNT, 3))
    rows = np.column_stack((POSITIONS_M, zero, roll, pitch, yaw, zero))
    return names + "".join(
        f"{int(time * 1e6)},{row}"
        for time, row in zip(TIMES_S, lines(rows, ",").splitlines(keepends=True), strict=True)
    )


def nuscenes() -> str:
    rows = zip(TIMES_S, POSITIONS_M.tolist(), np.roll(QUATS, 1, axis=1).tolist(), strict=True)
    records = [
        {"token": str(place), "timestamp": int(time * 1e6), "translation": position, "rotation": rotation}
        for place, (time, position, rotation) in enumerate(rows)
    ]
    return json.dumps([*records[::-1], records[3]])  # in no order, one twice


def fast_lio() -> str:
    zero = np.zeros((COUNT, 3))
    rows = np.column_stack(
        (TIMES_S - TIMES_S[0], ROTATIONS.as_rotvec(), POSITIONS_M, zero, zero + 0.4, zero, *[zero + 9] * 3)
    )
    return lines(rows).replace("\n", "\r\n")


FILES: dict[str, str] = {
    "colmap": colmap([f"left/{int(time * 1e9)}.png" for time in TIMES_S]),
    "g2o": g2o([int(time * 1e9) for time in TIMES_S]),
    "nclt": nclt(),
    "boreas": boreas(),
    "nuscenes": nuscenes(),
    "fast-lio": fast_lio(),
}
WITHOUT_TIMES: dict[str, str] = {
    "colmap": colmap([f"frame_{number:06d}.jpg" for number in range(COUNT)]),
    "g2o": g2o(list(range(COUNT))),
    "replica": lines(MATRICES.reshape(COUNT, 16)),
    "tartanair": lines(np.column_stack((POSITIONS_M, QUATS))),
}


def read(path: Path, times: Path | None = None, wanted: TrajectoryFormat = TrajectoryFormat.AUTO) -> Trajectory:
    file = read_pose_file(path, wanted, times, positions=True)
    unit = file.unit(UNKNOWN, None).value
    assert unit is not None
    assert not file.has_order
    return file.raw.trajectory(unit, QuaternionOrder.XYZW, Duplicates.REFUSE)


def check(found: Trajectory, start_s: float = 0.0, kept: slice = slice(None)) -> None:
    assert found.stamps_s == pytest.approx(TIMES_S[kept] - start_s, abs=1e-6)
    assert found.positions_m == pytest.approx(POSITIONS_M[kept], abs=1e-9)
    assert np.abs((found.quats_xyzw * QUATS[kept]).sum(axis=1)) == pytest.approx(np.ones(len(found)), abs=1e-9)


def times_file(folder: Path) -> Path:
    path = folder / "times.txt"
    path.write_text("".join(f"{time:.6f}\n" for time in TIMES_S))
    return path


@pytest.mark.parametrize("wanted", ["auto", "named"])
@pytest.mark.parametrize("name", FILES)
def test_a_format_with_times_gives_the_poses_that_were_written(tmp_path, name, wanted):
    path = tmp_path / "a.txt"
    path.write_text(FILES[name])
    found = read(path, wanted=TrajectoryFormat.AUTO if wanted == "auto" else TrajectoryFormat(name))
    check(found, TIMES_S[0] if name == "fast-lio" else 0.0)


@pytest.mark.parametrize("name", WITHOUT_TIMES)
def test_a_format_without_times_takes_them_from_the_lines_of_a_file(tmp_path, name):
    path = tmp_path / "a.txt"
    path.write_text(WITHOUT_TIMES[name])
    check(read(path, times_file(tmp_path)))
    with pytest.raises(InvalidInput, match=r"a\.txt holds poses as .* have no timestamps.*--times"):
        read(path)
    (tmp_path / "times.txt").write_text("1\n2\n3\n")
    with pytest.raises(InvalidInput, match=r"a pose of frame 39, .*times\.txt has 3 timestamps"):
        read(path, tmp_path / "times.txt")


def test_keys_of_gtsam_are_numbers_of_lines(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text(g2o([SYMBOL + number for number in range(COUNT)]))
    check(read(path, times_file(tmp_path)))


def test_keys_in_the_place_of_times_are_refused_in_words(tmp_path):
    path = tmp_path / "a.txt"
    rows = lines(np.column_stack((POSITIONS_M, QUATS))).splitlines(keepends=True)
    path.write_text("".join(f"{SYMBOL + number} {row}" for number, row in enumerate(rows)))
    with pytest.raises(InvalidInput, match="timestamps are keys of a pose graph, such as x0"):
        read_pose_file(path, TrajectoryFormat.AUTO, None)
    path.write_text("".join(f"{number} {row}" for number, row in enumerate(rows)))
    unit = read_pose_file(path, TrajectoryFormat.AUTO, None).unit(UNKNOWN, None)
    assert unit.value is None
    assert "numbers of frames or keys of a pose graph" in unit.because


def test_vertices_in_the_plane(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_text("".join(f"VERTEX_SE2 {number} {number} 2 {number / 10}\n" for number in range(COUNT)))
    found = read(path, times_file(tmp_path))
    assert found.positions_m[5] == pytest.approx([5, 2, 0])
    assert found.quats_xyzw[5] == pytest.approx([0, 0, np.sin(0.25), np.cos(0.25)])


def test_a_folder_of_poses_leaves_out_lost_frames(tmp_path):
    folder = tmp_path / "poses"
    folder.mkdir()
    for number, matrix in enumerate(MATRICES):
        text = lines(np.full((4, 4), -np.inf) if number == COUNT - 1 else matrix)
        (folder / f"frame-{number:06d}.pose.txt").write_text(text)
    check(read(folder, times_file(tmp_path)), kept=slice(0, COUNT - 1))
    with pytest.raises(InvalidInput, match="no timestamps"):
        read(folder)


def test_a_matrix_of_four_rows_after_a_time(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(lines(np.column_stack((TIMES_S, MATRICES.reshape(COUNT, 16)))))
    found = read_pose_file(path, TrajectoryFormat.AUTO, None).raw.trajectory(TimeUnit.S, QuaternionOrder.XYZW)
    check(found)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("colmap", FILES["colmap"].replace(" 1 left/", " one left/", 1), r"line 3: .* is no image"),
        ("g2o", FILES["g2o"].replace("VERTEX_SE3:QUAT 15", "VERTEX_SE3:QUAT x", 1), r"line 2: .* is no vertex"),
        ("nuscenes", FILES["nuscenes"].replace('"rotation"', '"turn"'), "record 1 lacks timestamp"),
        ("nuscenes", "[" * 100_000, "is no JSON"),
        ("boreas", FILES["nclt"], "has no header with easting"),
    ],
)
def test_damage_is_named_with_its_place(tmp_path, name, text, match):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=match):
        read_pose_file(path, TrajectoryFormat(name), None)


def test_every_format_says_who_writes_it_and_can_be_asked_for():
    names = [entry.name for entry in FORMATS]
    assert len(set(names)) == len(names)
    assert all(entry.systems and entry.content for entry in FORMATS)
    assert {entry.name for entry in FORMATS if entry.read is not None} <= {entry.value for entry in TrajectoryFormat}


def test_a_mutated_file_in_a_folder_of_poses_is_read_or_refused_in_a_line(tmp_path: Path) -> None:
    folder = tmp_path / "poses"
    folder.mkdir()
    for number, matrix in enumerate(MATRICES[:5]):
        (folder / f"frame-{number:06d}.pose.txt").write_text(lines(matrix))
    path, times = folder / "frame-000002.pose.txt", times_file(tmp_path)
    original = path.read_bytes()
    refused = set()
    for seed in range(80):
        path.write_bytes(mutated(original, random.Random(seed)))
        try:
            read(folder, times)
        except SlamHiveError as error:
            refused.add(str(error))
    assert len(refused) > 5
    assert not [text for text in refused if "\n" in text]


@pytest.mark.parametrize("name", [*FILES, *WITHOUT_TIMES])
def test_mutated_files_are_read_or_refused_in_a_line(tmp_path: Path, name: str) -> None:
    path, times = tmp_path / "a.txt", times_file(tmp_path)
    original = {**FILES, **WITHOUT_TIMES}[name].encode()
    refused = set()
    for seed in range(80):
        path.write_bytes(mutated(original, random.Random(f"{name}{seed}")))
        for wanted in (TrajectoryFormat.AUTO, TrajectoryFormat(name)):
            try:
                read_pose_file(path, wanted, times, positions=True)
            except SlamHiveError as error:
                refused.add(str(error))
    assert len(refused) > 5
    assert not [text for text in refused if "\n" in text]


def test_the_documentation_has_all_formats():
    text = (Path(__file__).parents[2] / "docs" / "importing-runs.md").read_text()
    for entry in FORMATS:
        assert f"| `{entry.name}` | {entry.systems} | {entry.content} |" in text
