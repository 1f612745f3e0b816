"""What ORB-SLAM3 leaves where it loses its way."""

from __future__ import annotations

import importlib.util

import numpy as np

from slamhive.project import project_root


def test_the_last_pose_is_kept_once_however_often_it_is_repeated():
    path = project_root() / "algorithms" / "orb-slam3" / "slamhive" / "orb_trajectory.py"
    found = importlib.util.spec_from_file_location("orb_trajectory", path)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    stamps = [10.0, 20.0, 20.0, 20.0, 30.0, 40.0, 40.0]
    table = np.column_stack([stamps, *[np.arange(7.0)] * 7])
    kept = module.without_repeats(table)
    assert kept[:, 0].tolist() == [10.0, 20.0, 30.0, 40.0]
    assert kept[:, 1].tolist() == [0.0, 1.0, 4.0, 5.0]
