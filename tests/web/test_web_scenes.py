"""The data of the 3D views: paths in one frame, points of maps, and what is said where something is missing."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamhive.base.settings import Mode
from slamhive.domain.protocol import TrajectoryKind
from slamhive.run_folder.point_cloud import MOST_POINTS
from slamhive.runtime.pcd import format_pcd, write_pcd
from slamhive.services.runs.series import read_whole_track
from tests.web import web_world as world
from tests.web.web_world import PROTOCOL, RUNS, Web, make_web

pytestmark = pytest.mark.quick

DONE, BARE = RUNS["done"], RUNS["bare"]
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def scene(web: Web, address: str) -> dict[str, Any]:
    answer = web.client.get(address)
    assert answer.status_code == 200, answer.text
    content: dict[str, Any] = answer.get_json()
    return content


def numbers(packed: dict[str, str]) -> np.ndarray:
    flat = np.frombuffer(base64.b64decode(packed["bdata"]), f"<{packed['dtype']}")
    return flat.reshape([int(part) for part in packed["shape"].split(",")]) if "shape" in packed else flat


def points(web: Web, address: str) -> tuple[dict[str, Any], np.ndarray, dict[str, np.ndarray]]:
    """Header, positions in m and values of a map, read as the page reads them."""
    answer = web.client.get(address)
    assert answer.status_code == 200, answer.text
    data = answer.data
    (size,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + size])
    at, count = 4 + size, header["points"]
    assert at % 4 == 0
    positions_m = np.frombuffer(data, "<f4", 3 * count, at).reshape(-1, 3) + header["origin_m"]
    at += 12 * count
    values = {}
    for entry in header["values"]:
        levels = np.frombuffer(data, "<u2", count, at)
        values[entry["name"]] = entry["low"] + levels / 65_535 * (entry["high"] - entry["low"])
        at += -(-2 * count // 4) * 4
    assert at == len(data)
    return header, positions_m, values


def in_frame_of_algorithm(web: Web, run_id: int) -> np.ndarray:
    """Write the trajectory as the algorithm has it: turned, half as large, elsewhere. Returns its positions."""
    rows = world.loop_path(noise_m=0.02)
    rows[:, 1:4] = 0.5 * (rows[:, 1:4] - [5.0, 0.0, 1.0]) @ TURN
    np.savetxt(web.hive.runs.folder(run_id).trajectory, rows)
    return rows[:, 1:4]


def test_a_run_is_shown_with_its_ground_truth(shown: Web):
    content = scene(shown, f"/runs/{DONE}/scene.json")
    estimate, truth = content["paths"]
    assert (estimate["name"], truth["name"]) == ("eye-slam-stereo", "ground truth")
    assert [estimate["truth"], truth["truth"]] == [False, True]
    assert content["up"] == [0, 0, 1]
    assert content["from_s"] == pytest.approx(1000.0)
    assert content["duration_s"] == pytest.approx(39.9)
    there_m = numbers(truth["positions_m"]) + content["centre_m"]
    np.testing.assert_allclose(there_m, world.loop_path()[:, 1:4], atol=1e-5)
    errors_m = numbers(estimate["errors_m"])
    apart_m = np.linalg.norm(numbers(estimate["positions_m"]) - numbers(truth["positions_m"]), axis=1)
    np.testing.assert_allclose(errors_m, apart_m, atol=1e-5)
    speeds_mps = numbers(truth["speeds_mps"])
    steps_m = np.linalg.norm(np.diff(world.loop_path()[:, 1:4], axis=0), axis=1)
    assert np.median(speeds_mps) == pytest.approx(np.median(steps_m) / 0.1, rel=0.02)
    assert content["map"] is None
    assert content["notes"] == ["There is no Map.pcd, so no map is shown."]


def test_every_trajectory_and_the_map_are_moved_to_the_ground_truth(web: Web):
    folder = web.hive.runs.folder(DONE)
    own_m = in_frame_of_algorithm(web, DONE)
    live = np.column_stack([1000 + 0.1 * np.arange(400), own_m + 0.25, np.tile([0, 0, 0, 1.0], (400, 1))])
    np.savetxt(folder.trajectory_of(TrajectoryKind.LIVE), live)
    write_pcd(folder.map, own_m)
    content = scene(web, f"/runs/{DONE}/scene.json")
    paths = {path["name"]: path for path in content["paths"]}
    assert list(paths) == ["eye-slam-stereo, estimate", "eye-slam-stereo, live", "ground truth"]
    assert len({path["colour"] for path in paths.values()}) == 3
    main_m, live_m = (numbers(paths[f"eye-slam-stereo, {kind}"]["positions_m"]) for kind in ("estimate", "live"))
    offset_m = 2 * np.array([0.25, 0.25, 0.25]) @ TURN.T
    np.testing.assert_allclose(live_m - main_m, np.tile(offset_m, (400, 1)), atol=1e-4)
    header, positions_m, _ = points(web, content["map"]["address"])
    assert (content["map"]["points"], header["total"], header["points"]) == (400, 400, 400)
    np.testing.assert_allclose(positions_m, main_m + content["centre_m"], atol=1e-4)


def test_a_map_that_nothing_moves_is_not_shown(web: Web):
    folder = web.hive.runs.folder(DONE)
    write_pcd(folder.map, np.eye(3))
    folder.trajectory.write_text("not a trajectory\n")
    content = scene(web, f"/runs/{DONE}/scene.json")
    assert content["map"] is None
    assert "what moved the trajectory to the ground truth is not known" in content["notes"][0]
    assert web.client.get(f"/runs/{DONE}/map.bin").status_code == 404


def test_a_run_that_is_not_evaluated_is_shown_in_its_own_frame(web: Web):
    own_m = in_frame_of_algorithm(web, BARE)
    write_pcd(web.hive.runs.folder(BARE).map, own_m)
    content = scene(web, f"/runs/{BARE}/scene.json")
    (estimate,) = content["paths"]
    assert estimate["errors_m"] is None
    _, positions_m, _ = points(web, content["map"]["address"])
    np.testing.assert_allclose(positions_m, own_m, atol=1e-5)


def test_runs_without_anything_say_so(shown: Web):
    content = scene(shown, f"/runs/{RUNS['failed']}/scene.json")
    assert content["paths"] == []
    assert content["notes"][0] == "The run has left no trajectory that can be read."
    assert shown.client.get("/runs/999/scene.json").status_code == 404
    assert shown.client.get("/runs/999/map.bin").status_code == 404


@pytest.mark.integration
def test_a_sample_comes_first_and_voxels_follow(web: Web):
    rng = np.random.default_rng(5)
    write_pcd(web.hive.runs.folder(BARE).map, rng.uniform(-50, 50, (150_000, 3)) * [1, 1, 0.01])
    sample, first_m, _ = points(web, f"/runs/{BARE}/map.bin?detail=sample")
    thinned, then_m, _ = points(web, f"/runs/{BARE}/map.bin?detail=thinned")
    assert (sample["voxel_m"], sample["total"]) == (None, 150_000)
    assert len(first_m) <= MOST_POINTS
    assert thinned["voxel_m"] > 0
    assert MOST_POINTS / 4 < len(then_m) <= MOST_POINTS


def test_intensities_and_distances_to_the_reference_come_with_the_points(web: Web):
    folder = web.hive.runs.folder(DONE)
    rows = np.column_stack([np.zeros((50, 2)), np.linspace(0, 1, 50), np.arange(50)]).astype("<f4")
    head = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS 50\nWIDTH 50\nDATA binary\n"
    folder.map.write_bytes(head.encode() + rows.tobytes())
    room = web.hive.settings.datasets_folder / "room"
    write_pcd(room / "reference.pcd", np.zeros((1, 3)))
    with (room / "dataset.yaml").open("a") as stream:
        stream.write("reference_map: reference.pcd\n")
    content = scene(web, f"/runs/{DONE}/scene.json")
    assert content["map"]["reference"] is True
    header, positions_m, values = points(web, content["map"]["address"] + "?detail=compared")
    assert [entry["name"] for entry in header["values"]] == ["intensity", "error"]
    np.testing.assert_allclose(values["intensity"], np.arange(50), atol=1e-3)
    np.testing.assert_allclose(values["error"], np.linalg.norm(positions_m, axis=1), atol=1e-3)
    _, reference_m, _ = points(web, scene(web, "/datasets/room/scene.json")["map"]["address"])
    assert reference_m.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("detail", ["everything", "", "../../etc/passwd", "compared"])
def test_bad_questions_about_a_map_get_one_line(web: Web, detail: str):
    write_pcd(web.hive.runs.folder(BARE).map, np.eye(3))
    answer = web.client.get(f"/runs/{BARE}/map.bin?detail={detail}", headers={"Accept": "application/json"})
    assert answer.status_code in {400, 404}
    assert "\n" not in answer.get_json()["error"]["message"]


@pytest.mark.parametrize("content", [b"", b"\x00" * 3000, format_pcd(np.eye(3))[:-2], b"DATA binary\n"])
def test_a_damaged_map_leaves_the_paths(web: Web, content: bytes):
    web.hive.runs.folder(DONE).map.write_bytes(content)
    found = scene(web, f"/runs/{DONE}/scene.json")
    assert len(found["paths"]) == 2
    assert found["map"] is None
    (note,) = found["notes"]
    assert note.startswith("The map is not shown: Map.pcd ")
    answer = web.client.get(f"/runs/{DONE}/map.bin")
    assert answer.status_code == 400
    assert "Traceback" not in answer.text


def test_a_link_in_place_of_a_map_is_not_followed(web: Web, tmp_path: Path):
    write_pcd(tmp_path / "other.pcd", np.eye(3))
    web.hive.runs.folder(DONE).map.symlink_to(tmp_path / "other.pcd")
    assert scene(web, f"/runs/{DONE}/scene.json")["map"] is None
    assert web.client.get(f"/runs/{DONE}/map.bin").status_code == 404


def test_a_changed_map_is_read_again(web: Web):
    path = web.hive.runs.folder(BARE).map
    for count in (3, 5):
        write_pcd(path, np.arange(3.0 * count).reshape(-1, 3))
        assert len(points(web, f"/runs/{BARE}/map.bin")[1]) == count


def test_points_of_a_map_read_the_trajectories_once(web: Web, monkeypatch: pytest.MonkeyPatch):
    write_pcd(web.hive.runs.folder(DONE).map, in_frame_of_algorithm(web, DONE))
    read: list[str] = []

    def counted(path: Path, *more: Any) -> Any:
        read.append(path.name)
        return read_whole_track(path, *more)

    monkeypatch.setattr("slamhive.services.runs.scene.read_whole_track", counted)
    address = f"/runs/{DONE}/map.bin"
    _, first_m, _ = points(web, f"{address}?detail=sample")
    _, then_m, _ = points(web, address)
    assert sorted(read) == ["traj.tum", "traj.txt"]
    assert np.allclose(first_m, then_m)
    in_frame = np.loadtxt(web.hive.runs.folder(DONE).trajectory)
    in_frame[:, 1:4] *= 2
    np.savetxt(web.hive.runs.folder(DONE).trajectory, in_frame)
    assert not np.allclose(points(web, address)[1], then_m)
    assert len(read) == 4


def test_a_comparison_shows_what_is_evaluated(web: Web):
    (third,) = world.add_runs(web.hive)
    world.finish_run(web.hive, third)
    world.evaluate_run(web.hive, third)
    content = scene(web, f"/compare/scene.json?runs={DONE},{BARE},{third}&protocol={PROTOCOL.fingerprint}")
    names = [path["name"] for path in content["paths"]]
    assert names == [f"run {DONE}, eye-slam-stereo", f"run {third}, eye-slam-stereo", "ground truth"]
    assert content["notes"] == [f"Not shown, because not evaluated under this protocol: run {BARE}."]
    assert web.client.get("/compare/scene.json?runs=1").status_code == 400


def test_a_dataset_shows_its_ground_truth(shown: Web):
    content = scene(shown, "/datasets/room/scene.json")
    assert [path["name"] for path in content["paths"]] == ["ground truth"]
    assert shown.client.get("/datasets/hall/scene.json").status_code == 404
    assert shown.client.get("/datasets/room/map.bin").status_code == 404


def test_an_archive_shows_everything_and_writes_nothing(filled: Path, tmp_path: Path):
    import shutil  # noqa: PLC0415

    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    web = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    write_pcd(web.hive.runs.folder(DONE).map, np.eye(3))
    before = sorted(path for path in (tmp_path / "data" / "runs").rglob("*"))
    content = scene(web, f"/runs/{DONE}/scene.json")
    assert len(points(web, content["map"]["address"])[1]) == 3
    assert sorted(path for path in (tmp_path / "data" / "runs").rglob("*")) == before
    assert web.client.post(f"/runs/{DONE}/scene.json").status_code in {403, 405}
    web.hive.close()
