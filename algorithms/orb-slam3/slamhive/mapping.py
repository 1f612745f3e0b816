"""ORB-SLAM3 under the container contract, in five modes: which one follows from the sensors of the run."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from orb_maps import MapPoints, Relocalisation, aside_of, atlas_settings, input_map, save_session
from orb_settings import settings_text
from orb_trajectory import KEYFRAMES, read_tum, save_trajectory
from pyorbslam3 import Sensor, Slam, TrackResult

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import camera_matrix, distortion, transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.localisation import Localisation
from slamhive.runtime.messages import to_grey
from slamhive.runtime.orb_vocabulary import about_vocabulary, vocabulary_path
from slamhive.runtime.paths import run_paths
from slamhive.runtime.pcd import write_pcd
from slamhive.runtime.trajectory import Poses, Trajectories

SENSORS = {
    frozenset({"left"}): Sensor.MONOCULAR,
    frozenset({"left", "right"}): Sensor.STEREO,
    frozenset({"left", "depth"}): Sensor.RGBD,
    frozenset({"left", "imu"}): Sensor.IMU_MONOCULAR,
    frozenset({"left", "right", "imu"}): Sensor.IMU_STEREO,
}


class OrbSlam3:
    """Tracks frame by frame; the main trajectory is the one after all optimisation.

    ORB-SLAM3's final trajectory (``SaveTrajectoryEuRoC``) is used in every mode: the live poses of the inertial modes
    jump between world frames, and ``SaveTrajectoryTUM`` does not serve monocular runs. It describes the left camera,
    in the inertial modes the IMU. The live poses and those of the keyframes are given besides.
    """

    def __init__(self, config: RunConfig) -> None:
        self._roles = set(config.algorithm_remap)
        self._values = config.parameters
        vocabulary = vocabulary_path()
        self._about_vocabulary = about_vocabulary(vocabulary)  # before the system, which crashes on a wrong one
        self._work = tempfile.TemporaryDirectory(prefix="orb-slam3-")
        settings = Path(self._work.name) / "settings.yaml"
        self._result = run_paths().result
        self._save_map = bool(self._values.get("save_map", False))
        started_with = input_map()
        maps = atlas_settings(aside_of(self._result) if self._save_map else None, started_with)
        settings.write_text(settings_text(self._values, self._roles, maps), encoding="utf-8")
        self._points = MapPoints()
        self._relocalisation = None if started_with is None else Relocalisation()
        self._localisation = Localisation()
        try:
            sensor = SENSORS[frozenset(self._roles)]
        except KeyError:
            raise InvalidInput(f"ORB-SLAM3 has no mode for {', '.join(sorted(self._roles))}") from None
        self._slam = Slam(vocabulary, settings, sensor)
        self._track = self._tracker()
        self._imu = np.empty((0, 7))
        self._stamps_s: list[float] = []
        self._live: list[np.ndarray] = []
        self._live_stamps_s: list[float] = []
        self._tracked = False

    def process(self, frame: Frame) -> bool:
        """Track one frame with the IMU samples up to its timestamp; later ones are kept for the next."""
        samples = np.concatenate([self._imu, frame.imu])
        due = samples[:, 0] <= frame.stamp_s
        self._imu = samples[~due]
        result = self._track(frame, samples[due] if "imu" in self._roles else None)
        self._stamps_s.append(frame.stamp_s)
        self._tracked = self._tracked or bool(result.pose_valid)
        if self._save_map and result.ok and self._points.due(frame.stamp_s):
            self._points.add(frame.stamp_s, self._slam.tracked_map_points(), np.asarray(result.pose_wc))
        if self._relocalisation is not None:
            localised = self._relocalisation.look() and bool(result.ok)
            self._localisation.add(frame.stamp_s, localised=localised)
        # A pose is "valid" also while it is guessed (RECENTLY_LOST), which is not tracking.
        if result.ok:
            self._live_stamps_s.append(frame.stamp_s)
            self._live.append(np.array(result.pose_wc, dtype=np.float64))
        return bool(result.ok)

    def finish(self) -> Trajectories:
        """Stop all threads, then take the final trajectory: none where nothing was tracked, or the map was lost."""
        self._end()
        folder = Path(self._work.name)
        final = self._final(save_trajectory(self._slam, folder) if self._tracked else None)
        T = self._T_tracked_main()
        live = Poses(np.array(self._live_stamps_s), np.array(self._live).reshape(-1, 4, 4) @ T)
        stamps_s, keyframes = read_tum(folder / KEYFRAMES)
        at_frames = Poses(self._nearest_stamps_s(stamps_s), keyframes @ T)
        return Trajectories(final, {"live": live, "keyframes": at_frames})

    def _end(self) -> None:
        """Stop all threads; save the atlas, and how the run found itself in that of another, where there is one."""
        if not self._save_map:
            self._slam.shutdown()
        elif not save_session(self._slam, self._result):
            print("the atlas could not be saved: no run can start with this map", flush=True)
        if self._relocalisation is not None:
            self._relocalisation.close()
            self._localisation.write(self._result)

    def _final(self, path: Path | None) -> Poses:
        if path is None:
            return Poses(np.empty(0), np.empty((0, 4, 4)))
        # For a frame that it could not place, ORB-SLAM3 writes the last pose once more, timestamp and all.
        stamps_ns, poses = read_tum(path)
        stamps_s = self._nearest_stamps_s(stamps_ns * 1e-9)
        if self._save_map:
            T_main_tracked = np.linalg.inv(self._T_tracked_main()) if "imu" in self._roles else np.eye(4)
            write_pcd(self._result / "Map.pcd", self._points.in_world(stamps_s, poses @ T_main_tracked))
        if self._roles == {"left", "right"}:
            poses = poses @ self._T_rectified_left()
        return Poses(stamps_s, poses)

    def _T_tracked_main(self) -> np.ndarray:
        """The frame of the trajectory in that of the camera that ORB-SLAM3 tracks, which is rectified in stereo."""
        T = self._T_rectified_left() if "right" in self._roles else np.eye(4)
        return T @ transform(self._values, "left", "imu") if "imu" in self._roles else T

    def about(self) -> dict[str, Any]:
        """The package that ran and the vocabulary it used."""
        return {
            "package": "pyorbslam3",
            "version": version("pyorbslam3"),
            "vocabulary": self._about_vocabulary,
        }

    def _tracker(self) -> Callable[[Frame, np.ndarray | None], TrackResult]:
        if "right" in self._roles:
            return lambda frame, imu: self._slam.track_stereo(
                to_grey(frame.image("left")), to_grey(frame.image("right")), frame.stamp_s, imu=imu
            )
        if "depth" in self._roles:
            return lambda frame, imu: self._slam.track_rgbd(
                to_grey(frame.image("left")), frame.image("depth").astype(np.float32), frame.stamp_s, imu=imu
            )
        return lambda frame, imu: self._slam.track_monocular(to_grey(frame.image("left")), frame.stamp_s, imu=imu)

    def _nearest_stamps_s(self, stamps_s: np.ndarray) -> np.ndarray:
        """The frames' own timestamps: the file's have been through single nanoseconds in floating point."""
        known = np.array(self._stamps_s)
        after = np.clip(np.searchsorted(known, stamps_s), 1, max(len(known) - 1, 1))
        before = np.maximum(after - 1, 0)
        after = np.minimum(after, len(known) - 1)
        nearer = np.abs(known[before] - stamps_s) <= np.abs(known[after] - stamps_s)
        return np.where(nearer, known[before], known[after])

    def _T_rectified_left(self) -> np.ndarray:
        """ORB-SLAM3 rectifies stereo images itself and tracks the rectified camera: its pose in terms of the left."""
        values = self._values
        matrices = [camera_matrix(values, role) for role in ("left", "right")]
        T_right_left = transform(values, "right", "left")
        rotation = cv2.stereoRectify(
            matrices[0],
            np.array(distortion(values, "left") or [0.0] * 4),
            matrices[1],
            np.array(distortion(values, "right") or [0.0] * 4),
            (int(values["left_width"]), int(values["left_height"])),
            T_right_left[:3, :3],
            T_right_left[:3, 3:],
        )[0]
        T = np.eye(4)
        T[:3, :3] = rotation
        return T


if __name__ == "__main__":
    code = run(OrbSlam3)
    sys.stdout.flush()
    # The library's threads and destructors crash at interpreter exit now and then; all results are on disk.
    os._exit(code)
