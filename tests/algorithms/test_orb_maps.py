"""Maps of ORB-SLAM3: settings of the atlas, points that follow the poses, and when a run is in the map of another."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from slamhive.runtime.localisation import Localisation
from slamhive.runtime.pcd import MOST_POINTS, write_pcd

pytestmark = pytest.mark.integration

FOLDER = Path(__file__).resolve().parents[2] / "algorithms" / "orb-slam3" / "slamhive"
spec = importlib.util.spec_from_file_location("orb_maps", FOLDER / "orb_maps.py")
assert spec is not None
assert spec.loader is not None
orb_maps = importlib.util.module_from_spec(spec)
sys.modules["orb_maps"] = orb_maps
spec.loader.exec_module(orb_maps)


def transform(angle_rad: float, position_m: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    T[:3, 3] = position_m
    return T


def test_the_atlas_is_named_relative_to_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    text = orb_maps.atlas_settings(tmp_path / "result" / ".session.osa", tmp_path / "map" / "session.osa")
    assert text.splitlines() == [
        'System.SaveAtlasToFile: "../result/.session"',
        'System.LoadAtlasFromFile: "../map/session"',
    ]
    assert orb_maps.atlas_settings(None, None) == ""


def test_points_follow_their_frames_when_poses_are_optimised():
    live, final = transform(0.3, (1, 2, 3)), transform(1.0, (-4, 0, 2))
    points = orb_maps.MapPoints()
    seen = np.array([[1, 0, 0], [np.nan, 0, 0], [3, 4, 5]], dtype=np.float32)
    assert points.due(10.0)
    points.add(10.0, seen, live)
    assert not points.due(10.0 + orb_maps.POINTS_EVERY_S / 2)
    points.add(11.0, seen, live)
    found = points.in_world(np.array([10.0]), final[None])
    local = (np.c_[seen[[0, 2]], np.ones(2)] @ np.linalg.inv(live).T) @ final.T
    np.testing.assert_allclose(found, local[:, :3], atol=1e-5)


def test_a_run_is_localised_from_the_merge_until_it_begins_another_map(capfd):
    watch = orb_maps.Relocalisation()
    try:
        found = []
        for line in (
            b"Creation of new map with id: 1\nFirst KF:30",
            b"\nNew Map created\n*Merge detected\nChange to map ",
            b"with id: 0\n",
            b"Merge finished!\n",
            b"Creation of new map with id: 2\n",
        ):
            os.write(1, line)
            found.append(watch.look())
    finally:
        watch.close()
    assert found == [False, False, True, True, False]
    assert "Merge finished!\nCreation of new map with id: 2\n" in capfd.readouterr().out


@pytest.mark.parametrize("ends", ["well", "badly"])
def test_a_crash_while_saving_costs_the_atlas_only(tmp_path, ends):
    class Slam:
        def shutdown(self) -> None:
            orb_maps.aside_of(tmp_path).write_bytes(b"atlas")
            if ends == "badly":
                os.abort()

    assert orb_maps.save_session(Slam(), tmp_path) is (ends == "well")
    assert [path.name for path in tmp_path.iterdir()] == (["session.osa"] if ends == "well" else [])


def test_the_share_of_localised_frames_is_written(tmp_path):
    found = Localisation()
    for stamp_s in range(10):
        found.add(100.0 + stamp_s, localised=stamp_s > 6)
    found.write(tmp_path)
    text = (tmp_path / "localisation.json").read_text().split()
    assert " ".join(text) == (
        '{ "first_frame_s": 100.0, "localised_at_s": 107.0, "frames": 10, "frames_localised": 3 }'
    )


def test_a_map_has_at_most_so_many_points(tmp_path):
    write_pcd(tmp_path / "Map.pcd", np.zeros((MOST_POINTS + 5, 3), np.float32))
    assert f"POINTS {MOST_POINTS}\n".encode() in (tmp_path / "Map.pcd").read_bytes()[:300]
