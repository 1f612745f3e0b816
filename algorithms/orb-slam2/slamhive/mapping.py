"""ORB-SLAM2 under the container contract, in three modes: which one follows from the sensors of the run."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from orb_slam2_settings import write_settings

from slamhive.base.errors import InvalidInput
from slamhive.runtime.config import RunConfig
from slamhive.runtime.orb_vocabulary import about_vocabulary, vocabulary_path
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import FiledResults, PoseKind, PoseTopic, Ros1System
from slamhive.runtime.trajectory import Poses, read_poses

MODES = {
    frozenset({"left"}): "mono",
    frozenset({"left", "right"}): "stereo",
    frozenset({"left", "depth"}): "rgbd",
}


def make(config: RunConfig) -> Ros1System:
    """The system for this run; raises InvalidInput for a camera that ORB-SLAM2 cannot describe."""
    roles = frozenset(config.algorithm_remap)
    if roles not in MODES:
        raise InvalidInput(f"ORB-SLAM2 has no mode for {', '.join(sorted(roles))}")
    mode, vocabulary = MODES[roles], vocabulary_path()
    folder = Path(tempfile.mkdtemp(prefix="orb-slam2-"))
    settings = folder / "settings.yaml"
    write_settings(settings, config.parameters, mode)
    return Ros1System(
        launch=Path(__file__).with_name("orb-slam2.launch"),
        poses=PoseTopic("/orb_slam2/pose", PoseKind.POSE),
        frames="left",
        processed="/orb_slam2/processed",
        arguments={
            "mode": mode,
            "vocabulary": str(vocabulary),
            "settings": str(settings),
            "output": str(folder),
            "queue_size": int(config.parameters["queueSize"]),
        },
        results=lambda: results(folder, mode),
        about={"package": "ORB-SLAM2", "version": "f2e6f51", "vocabulary": about_vocabulary(vocabulary)},
    )


def results(folder: Path, mode: str) -> FiledResults:
    """Trajectory that the node saved at its end; nothing if it never tracked a frame.

    With one camera the keyframes are the final trajectory, as upstream has it.
    """
    points = folder / "points.f32"
    keyframes = _poses(folder / "keyframes.txt")
    return FiledResults(
        poses=keyframes if mode == "mono" else _poses(folder / "trajectory.txt"),
        keyframes=keyframes,
        map_points_m=np.fromfile(points, dtype=np.float32).reshape(-1, 3) if points.is_file() else None,
    )


def _poses(path: Path) -> Poses:
    return read_poses(path.read_text() if path.is_file() else "")


if __name__ == "__main__":
    sys.exit(run(make))
