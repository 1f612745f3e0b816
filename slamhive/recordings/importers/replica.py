"""Importer of Replica as NICE-SLAM renders it (Zhu et al., CVPR 2022; Straub et al., "The Replica dataset", 2019).

https://github.com/cvg/nice-slam: ``results/frame000000.jpg`` and ``depth000000.png``, ``traj.txt`` with a
camera-to-world matrix by rows for each frame (x right, y down, z forward), ``cam_params.json`` beside the scenes.
"""

from __future__ import annotations

from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.recordings.importers.calibration import CalibrationFile, read_calibration_file
from slamhive.recordings.importing import DatasetText, Detection, ImportOptions, ImportPlan, PlannedTruth, matched_truth
from slamhive.recordings.rgbd import (
    camera_stream,
    depth_stream,
    is_pose,
    nominal_note,
    nominal_times_ns,
    numbered,
    read_frame_poses,
    timed,
    truth_of_matrices,
)

_IMAGES, _TRAJECTORY, _CAMERA = "results", "traj.txt", "cam_params.json"
_FRAMES_PER_S = 30.0


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
        frames_per_s = options.frame_rate_hz or _FRAMES_PER_S
        parameters = read_calibration_file(_camera_file(source)).part("camera")
        colour = numbered(source / _IMAGES, "frame*.jpg", "frame*.png")
        depth = numbered(source / _IMAGES, "depth*.png")
        if not colour or not depth:
            raise InvalidInput(f"{source / _IMAGES} lacks frame*.jpg or depth*.png", "give the folder of a scene")
        camera = camera_stream("cam0", timed(colour, frames_per_s), _intrinsics(parameters))
        units_per_m = options.depth_units_per_m or parameters.positive("scale")
        streams = (camera, depth_stream(camera.sensor, timed(depth, frames_per_s), units_per_m))
        truth = _truth(source / _TRAJECTORY, list(colour), frames_per_s)
        notes = (nominal_note(frames_per_s), *matched_truth(truth, streams))
        return ImportPlan(streams, truth, _text(source), notes=notes)


def _camera_file(source: Path) -> Path:
    own = source / _CAMERA
    return own if own.is_file() else source.resolve().parent / _CAMERA


def _intrinsics(file: CalibrationFile) -> CameraIntrinsics:
    width, height = file.size("w", "h")
    focal = file.positive("fx"), file.positive("fy")
    return CameraIntrinsics(width, height, *focal, file.number("cx"), file.number("cy"), distortion=(0.0,) * 4)


def _truth(path: Path, numbers: list[int], frames_per_s: float) -> PlannedTruth:
    frames, table = read_frame_poses(path, 16, "a 4x4 matrix by rows", numbers)
    poses = table.values.reshape(-1, 4, 4)
    broken = [row for row, pose in enumerate(poses) if not is_pose(pose)]
    if broken:
        raise table.error(broken[0], "no rigid transform", "expected a 4x4 matrix by rows")
    return truth_of_matrices(nominal_times_ns(frames, frames_per_s), poses, "rendering")


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"Replica, {source.resolve().name}",
        description="Rendered colour and depth images; the body is the camera.",
        licence="Replica Research Terms",
        citation="Straub et al.: The Replica dataset. 2019; Zhu et al.: NICE-SLAM. CVPR 2022",
        source="https://github.com/cvg/nice-slam",
        attributes=("synthetic", "indoor"),
    )
