"""Importers of frames with a pose each and no timestamps: 7-Scenes, Replica and TartanAir.

Frames are numbered at a nominal rate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.recordings.frame_files import read_image
from slamhive.recordings.geometry import Array, flat, transform
from slamhive.recordings.importers.calibration import CalibrationFile, given_camera, read_calibration_file
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
    is_pose,
    nominal_note,
    nominal_times_ns,
    numbered,
    read_frame_poses,
    read_pose_table,
    size_of,
    timed,
    truth_of_matrices,
)
from slamhive.trajectory.model import find_problem

# 7-Scenes (Shotton et al., "Scene coordinate regression forests for camera relocalization", CVPR 2013).
#
# https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/: frames of a Kinect with poses of the camera,
# depth in mm, 65535 where there is none, principal point (320, 240) and focal length (585, 585) for both cameras.


_COLOUR, _SCENES_DEPTH, _POSE = ("frame-*.color.png", "frame-*.color.jpg"), "frame-*.depth.png", "frame-*.pose.txt"
_SCENES_FRAMES_PER_S = 30.0
_UNITS_PER_M = 1000.0
_NO_DEPTH = 65535


class SevenScenesImporter:
    """Colour and depth images and poses of the camera, which is the body, to a dataset. Timestamps are nominal."""

    title = "7-Scenes sequence: frame-000000.color.png, .depth.png and .pose.txt"
    options = frozenset({"calibration", "depth_units_per_m", "frame_rate_hz"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The kinds of files in the folder."""
        kinds = {"color images": any(visible_files(path, pattern) for pattern in _COLOUR)}
        kinds |= {"depth images": bool(visible_files(path, _SCENES_DEPTH)), "poses": bool(visible_files(path, _POSE))}
        missing = [kind for kind in ("color images", "depth images") if not kinds[kind]]
        return Detection(tuple(f"frame-* {kind}" for kind, there in kinds.items() if there), tuple(missing))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the sequence; raises InvalidInput naming the file and the remedy."""
        frames_per_s = options.frame_rate_hz or _SCENES_FRAMES_PER_S
        colour, depth = numbered(source, *_COLOUR), numbered(source, _SCENES_DEPTH)
        if not colour or not depth:
            raise InvalidInput(
                f"{source} lacks frame-*.color.png or {_SCENES_DEPTH}", "give the folder of a sequence, seq-01"
            )
        width, height = size_of(next(iter(colour.values())))
        intrinsics = given_camera(options.calibration) or CameraIntrinsics(
            width, height, 585.0, 585.0, 320.0, 240.0, distortion=(0.0,) * 4
        )
        camera = camera_stream("cam0", timed(colour, frames_per_s), intrinsics)
        far = timed(depth, frames_per_s)
        streams = (
            camera,
            depth_stream(camera.sensor, far, options.depth_units_per_m or _UNITS_PER_M, read=_scenes_read_depth),
        )
        files = numbered(source, _POSE)
        poses = {number: read_pose_table(path, 4, "a 4x4 matrix by rows") for number, path in files.items()}
        for number, pose in poses.items():
            if pose.shape != (4, 4):
                raise InvalidInput(f"{files[number]} has {len(pose)} rows", "expected a 4x4 matrix by rows")
        known = {number: pose for number, pose in poses.items() if is_pose(pose)}
        unknown = len(poses) - len(known)
        left_out = (f"{unknown} of {len(poses)} poses are not rigid and left out",) if unknown else ()
        truth = None
        if known:
            times_ns = nominal_times_ns(list(known), frames_per_s)
            truth = truth_of_matrices(times_ns, np.array(list(known.values())), "KinectFusion")
        published = "depth is taken as registered to colour, with one focal length for both, as the authors say"
        notes = (nominal_note(frames_per_s), published, *left_out, *matched_truth(truth, streams))
        return ImportPlan(
            streams,
            truth,
            DatasetText(
                title=f"7-Scenes, {source.resolve().name}",
                description="Colour and depth images of a Kinect; the body is the camera.",
                licence="Microsoft 7-Scenes: non-commercial research",
                citation="Shotton et al.: Scene coordinate regression forests for camera relocalization. CVPR 2013",
                source="https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
                attributes=("real", "indoor", "handheld"),
            ),
            notes=notes,
        )


def _scenes_read_depth(path: Path, encoding: str) -> Array:
    pixels = read_image(path, encoding)
    return np.where(pixels == _NO_DEPTH, np.uint16(0), pixels)


# Replica as NICE-SLAM renders it (Zhu et al., CVPR 2022; Straub et al., "The Replica dataset", 2019).
#
# https://github.com/cvg/nice-slam: ``results/frame000000.jpg`` and ``depth000000.png``, ``traj.txt`` with a
# camera-to-world matrix by rows for each frame (x right, y down, z forward), ``cam_params.json`` beside the scenes.


_IMAGES, _TRAJECTORY, _CAMERA = "results", "traj.txt", "cam_params.json"
_REPLICA_FRAMES_PER_S = 30.0


class ReplicaImporter:
    """Rendered colour and depth images and exact poses of the camera, which is the body, to a dataset."""

    title = "Replica scene as of NICE-SLAM: results/frame*.jpg, results/depth*.png, traj.txt, cam_params.json"
    options = frozenset({"depth_units_per_m", "frame_rate_hz"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The files of the scene; ``cam_params.json`` may lie beside its folder."""
        there = {_IMAGES: (path / _IMAGES).is_dir(), _TRAJECTORY: (path / _TRAJECTORY).is_file()}
        there[_CAMERA] = _camera_file(path).is_file()
        found = tuple(name for name, is_there in there.items() if is_there)
        return Detection(found, tuple(name for name in there if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the scene; raises InvalidInput naming the file, the line or key, and the remedy."""
        frames_per_s = options.frame_rate_hz or _REPLICA_FRAMES_PER_S
        parameters = read_calibration_file(_camera_file(source)).part("camera")
        colour = numbered(source / _IMAGES, "frame*.jpg", "frame*.png")
        depth = numbered(source / _IMAGES, "depth*.png")
        if not colour or not depth:
            raise InvalidInput(f"{source / _IMAGES} lacks frame*.jpg or depth*.png", "give the folder of a scene")
        camera = camera_stream("cam0", timed(colour, frames_per_s), _intrinsics(parameters))
        units_per_m = options.depth_units_per_m or parameters.positive("scale")
        streams = (camera, depth_stream(camera.sensor, timed(depth, frames_per_s), units_per_m))
        frames, table = read_frame_poses(source / _TRAJECTORY, 16, "a 4x4 matrix by rows", list(colour))
        poses = table.values.reshape(-1, 4, 4)
        broken = [row for row, pose in enumerate(poses) if not is_pose(pose)]
        if broken:
            raise table.error(broken[0], "no rigid transform", "expected a 4x4 matrix by rows")
        truth = truth_of_matrices(nominal_times_ns(frames, frames_per_s), poses, "rendering")
        notes = (nominal_note(frames_per_s), *matched_truth(truth, streams))
        return ImportPlan(
            streams,
            truth,
            DatasetText(
                title=f"Replica, {source.resolve().name}",
                description="Rendered colour and depth images; the body is the camera.",
                licence="Replica Research Terms",
                citation="Straub et al.: The Replica dataset. 2019; Zhu et al.: NICE-SLAM. CVPR 2022",
                source="https://github.com/cvg/nice-slam",
                attributes=("synthetic", "indoor"),
            ),
            notes=notes,
        )


def _camera_file(source: Path) -> Path:
    own = source / _CAMERA
    return own if own.is_file() else source.resolve().parent / _CAMERA


def _intrinsics(file: CalibrationFile) -> CameraIntrinsics:
    width, height = file.size("w", "h")
    focal = file.positive("fx"), file.positive("fy")
    return CameraIntrinsics(width, height, *focal, file.number("cx"), file.number("cy"), distortion=(0.0,) * 4)


# TartanAir (Wang et al., "TartanAir: A dataset to push the limits of visual SLAM", IROS 2020).
#
# https://github.com/castacks/tartanair_tools, data_type.md: images of 640x480 pixels, fx = fy = 320, cx = 320,
# cy = 240, baseline 0.25 m. Depth is in m as ``.npy``. Poses are ``tx ty tz qx qy qz qw`` in a NED frame: x forward,
# y right, z down.


_LEFT, _RIGHT, _TARTAN_DEPTH, _POSES = "image_left", "image_right", "depth_left", "pose_left.txt"
_BASELINE_M = 0.25
_TARTAN_FRAMES_PER_S = 10.0
_R_NED_OPTICAL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_MOST_BYTES = 100_000_000


class TartanAirImporter:
    """Stereo images, depth and poses to a dataset. The body is the left camera in NED: x forward, y right, z down."""

    title = "TartanAir trajectory: image_left, image_right, depth_left (.npy), pose_left.txt"
    options = frozenset({"frame_rate_hz"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The folders of the trajectory."""
        there = {name: (path / name).is_dir() for name in (_LEFT, _RIGHT, _TARTAN_DEPTH)}
        there[_POSES] = (path / _POSES).is_file()
        missing = [name for name in (_LEFT, _POSES) if not there[name]]
        return Detection(tuple(name for name, is_there in there.items() if is_there), tuple(missing))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the trajectory; raises InvalidInput naming the file, the line and the remedy."""
        frames_per_s = options.frame_rate_hz or _TARTAN_FRAMES_PER_S
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
        depth = numbered(source / _TARTAN_DEPTH, "*.npy")
        if depth:
            streams.append(depth_stream(streams[0].sensor, timed(depth, frames_per_s), 1.0, read=_tartan_read_depth))
        posed, table = read_frame_poses(source / _POSES, 7, "tx ty tz qx qy qz qw", list(left))
        poses, times_s = table.values, nominal_times_ns(posed, frames_per_s) / 1e9
        problem = find_problem(times_s, poses[:, :3], poses[:, 3:])
        if problem is not None:
            raise table.error(problem.index, problem.found, problem.remedy)
        quats_xyzw = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        truth = PlannedTruth(times_s, poses[:, :3], quats_xyzw, gravity_aligned=False, source="rendering")
        notes = (nominal_note(frames_per_s), *matched_truth(truth, streams))
        return ImportPlan(
            tuple(streams),
            truth,
            DatasetText(
                title=f"TartanAir, {source.resolve().parent.name} {source.resolve().name}",
                description="Rendered stereo and depth images; the body is the left camera, "
                "x forward, y right, z down.",
                licence="CC BY 4.0",
                citation="Wang et al.: TartanAir: A dataset to push the limits of visual SLAM. IROS 2020",
                source="https://theairlab.org/tartanair-dataset/",
                attributes=("synthetic",),
            ),
            notes=notes,
        )


def _tartan_read_depth(path: Path, _encoding: str) -> Array:
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
