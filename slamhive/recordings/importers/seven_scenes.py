"""Importer of 7-Scenes (Shotton et al., "Scene coordinate regression forests for camera relocalization", CVPR 2013).

https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/: frames of a Kinect with poses of the camera,
depth in mm, 65535 where there is none, principal point (320, 240) and focal length (585, 585) for both cameras.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.recordings.frame_files import read_image
from slamhive.recordings.geometry import Array
from slamhive.recordings.importers.calibration import given_camera
from slamhive.recordings.importing import DatasetText, Detection, ImportOptions, ImportPlan, PlannedTruth, matched_truth
from slamhive.recordings.rgbd import (
    camera_stream,
    depth_stream,
    is_pose,
    nominal_note,
    nominal_times_ns,
    numbered,
    read_pose_table,
    size_of,
    timed,
    truth_of_matrices,
)

_COLOUR, _DEPTH, _POSE = ("frame-*.color.png", "frame-*.color.jpg"), "frame-*.depth.png", "frame-*.pose.txt"
_FRAMES_PER_S = 30.0
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
        kinds |= {"depth images": bool(visible_files(path, _DEPTH)), "poses": bool(visible_files(path, _POSE))}
        missing = [kind for kind in ("color images", "depth images") if not kinds[kind]]
        return Detection(tuple(f"frame-* {kind}" for kind, there in kinds.items() if there), tuple(missing))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the sequence; raises InvalidInput naming the file and the remedy."""
        frames_per_s = options.frame_rate_hz or _FRAMES_PER_S
        colour, depth = numbered(source, *_COLOUR), numbered(source, _DEPTH)
        if not colour or not depth:
            raise InvalidInput(f"{source} lacks frame-*.color.png or {_DEPTH}", "give the folder of a sequence, seq-01")
        width, height = size_of(next(iter(colour.values())))
        intrinsics = given_camera(options.calibration) or CameraIntrinsics(
            width, height, 585.0, 585.0, 320.0, 240.0, distortion=(0.0,) * 4
        )
        camera = camera_stream("cam0", timed(colour, frames_per_s), intrinsics)
        far = timed(depth, frames_per_s)
        streams = (
            camera,
            depth_stream(camera.sensor, far, options.depth_units_per_m or _UNITS_PER_M, read=_read_depth),
        )
        truth, notes = _truth(source, frames_per_s)
        published = "depth is taken as registered to colour, with one focal length for both, as the authors say"
        notes = (nominal_note(frames_per_s), published, *notes, *matched_truth(truth, streams))
        return ImportPlan(streams, truth, _text(source), notes=notes)


def _read_depth(path: Path, encoding: str) -> Array:
    pixels = read_image(path, encoding)
    return np.where(pixels == _NO_DEPTH, np.uint16(0), pixels)


def _truth(source: Path, frames_per_s: float) -> tuple[PlannedTruth | None, tuple[str, ...]]:
    files = numbered(source, _POSE)
    poses = {number: read_pose_table(path, 4, "a 4x4 matrix by rows") for number, path in files.items()}
    for number, pose in poses.items():
        if pose.shape != (4, 4):
            raise InvalidInput(f"{files[number]} has {len(pose)} rows", "expected a 4x4 matrix by rows")
    known = {number: pose for number, pose in poses.items() if is_pose(pose)}
    unknown = len(poses) - len(known)
    notes = (f"{unknown} of {len(poses)} poses are not rigid and left out",) if unknown else ()
    if not known:
        return None, notes
    times_ns = nominal_times_ns(list(known), frames_per_s)
    return truth_of_matrices(times_ns, np.array(list(known.values())), "KinectFusion"), notes


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"7-Scenes, {source.resolve().name}",
        description="Colour and depth images of a Kinect; the body is the camera.",
        licence="Microsoft 7-Scenes: non-commercial research",
        citation="Shotton et al.: Scene coordinate regression forests for camera relocalization. CVPR 2013",
        source="https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        attributes=("real", "indoor", "handheld"),
    )
