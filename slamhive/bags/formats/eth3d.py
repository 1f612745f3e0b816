"""Importer of the ETH3D SLAM benchmark (Schöps et al., "BAD SLAM", CVPR 2019): https://www.eth3d.net/slam_documentation."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.ground_truth import matched_truth, tum_truth
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan, Stream
from slamhive.bags.numbered_frames import read_pose_table
from slamhive.bags.rgbd import camera_stream, depth_stream, listed_frames, size_of
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.errors import InvalidInput, NotFound

_COLOUR, _DEPTH, _CAMERA, _TRUTH = "rgb.txt", "depth.txt", "calibration.txt", "groundtruth.txt"
_UNITS_PER_M = 5000.0


class Eth3dImporter:
    """Colour images, registered depth and poses of the camera, which is the body, to a dataset."""

    title = "ETH3D SLAM sequence: rgb.txt, depth.txt, calibration.txt, groundtruth.txt"
    options = frozenset({"depth_units_per_m", "groundtruth"})
    refines = frozenset({"tum-rgbd"})

    def detect(self, path: Path) -> Detection:
        """The lists of the sequence."""
        found = [name for name in (_COLOUR, _DEPTH, _CAMERA, _TRUTH) if (path / name).is_file()]
        return Detection(tuple(found), tuple(name for name in (_COLOUR, _CAMERA) if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """What the sequence becomes; raises InvalidInput naming the file, the line and the remedy."""
        colour, notes = listed_frames(source, _COLOUR)
        streams: list[Stream] = [camera_stream("cam0", colour, _intrinsics(source / _CAMERA, colour.paths[0]))]
        if (source / _DEPTH).is_file():
            depth, remarks = listed_frames(source, _DEPTH)
            notes += remarks
            units_per_m = options.depth_units_per_m or _UNITS_PER_M
            streams.append(depth_stream(streams[0].sensor, depth, units_per_m))
        others = [name for name in ("rgb2", "imu.txt") if (source / name).exists()]
        if others:
            notes += (f"{', '.join(others)} is left out",)
        path = options.groundtruth or source / _TRUTH
        known = options.groundtruth is not None or path.is_file()
        truth = tum_truth(path, "motion capture", gravity_aligned=False) if known else None
        return ImportPlan(tuple(streams), truth, _text(source), notes=(*notes, *matched_truth(truth, streams)))


def _intrinsics(path: Path, image: Path) -> CameraIntrinsics:
    """``fx fy cx cy`` on one line; images are undistorted."""
    try:
        fx, fy, cx, cy = read_pose_table(path, 4, "fx fy cx cy")[0].tolist()
    except NotFound as error:
        raise InvalidInput(error.message, "complete the folder") from None
    if not 0 < min(fx, fy) <= max(fx, fy, abs(cx), abs(cy)) < 1e6:
        raise InvalidInput(f"{path}: {fx:g} {fy:g} {cx:g} {cy:g} are no intrinsics", "expected fx fy cx cy in pixels")
    width, height = size_of(image)
    return CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4)


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"ETH3D SLAM, {source.resolve().name}",
        description="Colour and registered depth images of global-shutter cameras; the body is the colour camera.",
        licence="CC BY-NC-SA 4.0",
        citation="Schöps, Sattler, Pollefeys: BAD SLAM: Bundle adjusted direct RGB-D SLAM. CVPR 2019",
        source="https://www.eth3d.net/slam_overview",
        attributes=("real", "indoor", "handheld"),
    )
