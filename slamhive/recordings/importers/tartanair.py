"""Importer of TartanAir (Wang et al., "TartanAir: A dataset to push the limits of visual SLAM", IROS 2020).

https://github.com/castacks/tartanair_tools, data_type.md: images of 640x480 pixels, fx = fy = 320, cx = 320, cy = 240,
baseline 0.25 m. Depth is in m as ``.npy``. Poses are ``tx ty tz qx qy qz qw`` in a NED frame: x
forward, y right, z down.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.recordings.geometry import Array, flat, transform
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    matched_truth,
)
from slamhive.recordings.rgbd import (
    camera_stream,
    depth_stream,
    nominal_note,
    nominal_times_ns,
    numbered,
    read_frame_poses,
    timed,
)
from slamhive.trajectory.model import find_problem

_LEFT, _RIGHT, _DEPTH, _POSES = "image_left", "image_right", "depth_left", "pose_left.txt"
_BASELINE_M = 0.25
_FRAMES_PER_S = 10.0
_R_NED_OPTICAL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_MOST_BYTES = 100_000_000


class TartanAirImporter:
    """Stereo images, depth and poses to a dataset. The body is the left camera in NED: x forward, y right, z down."""

    title = "TartanAir trajectory: image_left, image_right, depth_left (.npy), pose_left.txt"
    options = frozenset({"frame_rate_hz"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The folders of the trajectory."""
        there = {name: (path / name).is_dir() for name in (_LEFT, _RIGHT, _DEPTH)}
        there[_POSES] = (path / _POSES).is_file()
        missing = [name for name in (_LEFT, _POSES) if not there[name]]
        return Detection(tuple(name for name, is_there in there.items() if is_there), tuple(missing))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the trajectory; raises InvalidInput naming the file, the line and the remedy."""
        frames_per_s = options.frame_rate_hz or _FRAMES_PER_S
        left, right = (numbered(source / name, "*.png", "*.jpg") for name in (_LEFT, _RIGHT))
        if not left:
            raise InvalidInput(f"{source / _LEFT} has no images", "give the folder of a trajectory, P000")
        intrinsics = CameraIntrinsics(640, 480, 320.0, 320.0, 320.0, 240.0, distortion=(0.0,) * 4, rectified=True)
        streams: list[PlannedStream] = []
        for name, frames, x_m in (("cam0", left, 0.0), ("cam1", right, _BASELINE_M)):
            if frames:
                T_body_camera = transform(_R_NED_OPTICAL, _R_NED_OPTICAL @ [x_m, 0.0, 0.0])
                T_numbers = flat(T_body_camera)
                stream = camera_stream(name, timed(frames, frames_per_s), intrinsics, T_numbers, baseline_m=x_m)
                streams.append(stream)
        depth = numbered(source / _DEPTH, "*.npy")
        if depth:
            streams.append(depth_stream(streams[0].sensor, timed(depth, frames_per_s), 1.0, read=_read_depth))
        truth = _truth(source / _POSES, list(left), frames_per_s)
        notes = (nominal_note(frames_per_s), *matched_truth(truth, streams))
        return ImportPlan(tuple(streams), truth, _text(source), notes=notes)


def _read_depth(path: Path, _encoding: str) -> Array:
    """Depth in m, float32 (h, w)."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InvalidInput(f"frame {path} has more than {_MOST_BYTES // 1_000_000} MB", "give a depth image")
        pixels = np.load(path, allow_pickle=False, mmap_mode="r")
        found: Array = np.array(pixels, dtype=np.float32)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise InvalidInput(f"frame {path} cannot be read: {error}", "copy or download the frame again") from None
    if found.ndim != 2:
        raise InvalidInput(f"frame {path} has {found.ndim} dimensions", "a depth image has 2")
    return found


def _truth(path: Path, numbers: list[int], frames_per_s: float) -> PlannedTruth:
    frames, table = read_frame_poses(path, 7, "tx ty tz qx qy qz qw", numbers)
    poses, times_s = table.values, nominal_times_ns(frames, frames_per_s) / 1e9
    problem = find_problem(times_s, poses[:, :3], poses[:, 3:])
    if problem is not None:
        raise table.error(problem.index, problem.found, problem.remedy)
    quats_xyzw = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return PlannedTruth(times_s, poses[:, :3], quats_xyzw, gravity_aligned=False, source="rendering")


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"TartanAir, {source.resolve().parent.name} {source.resolve().name}",
        description="Rendered stereo and depth images; the body is the left camera, x forward, y right, z down.",
        licence="CC BY 4.0",
        citation="Wang et al.: TartanAir: A dataset to push the limits of visual SLAM. IROS 2020",
        source="https://theairlab.org/tartanair-dataset/",
        attributes=("synthetic",),
    )
