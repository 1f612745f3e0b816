"""Importer of the layout of the TUM RGB-D benchmark, which Bonn's dynamic sequences and ICL-NUIM use as well.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.files import visible_files
from slamhive.domain.calibration import CameraIntrinsics, CameraModel
from slamhive.domain.sensors import SensorKind
from slamhive.packages.dataset_file import DATASET_FILE, load_sensors
from slamhive.recordings.importers.calibration import given_camera
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    tum_truth,
)
from slamhive.recordings.rgbd import (
    Frames,
    camera_stream,
    depth_stream,
    listed_frames,
    nominal_times_ns,
    read_pose_table,
    size_of,
)
from slamhive.recordings.text_lists import TimedList, listed_truth, parse_timed_list, read_lines
from slamhive.recordings.writers import NS_PER_S
from slamhive.trajectory.layout import TimeUnit

_UNITS_PER_M = 5000.0
_ICL_ASSOCIATIONS, _ICL_TRUTH = "associations.txt", "*.gt.freiburg"
_ICL_FRAMES_PER_S = 30.0
_SIZE = (640, 480)


@dataclass(frozen=True, slots=True)
class _Family:
    """The sequences of one camera: how their folders are called, intrinsics as published, and who did it."""

    key: str
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    truth: str
    gravity_aligned: bool
    licence: str
    citation: str
    source: str


_TUM = (
    "CC BY 4.0",
    "Sturm et al.: A benchmark for the evaluation of RGB-D SLAM systems. IROS 2012",
    "https://cvg.cit.tum.de/data/datasets/rgbd-dataset",
)
_MOCAP = "motion capture"
_FAMILIES = (
    # https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, "Intrinsic camera calibration of the Kinect"
    _Family(
        "freiburg1",
        (517.3, 516.5, 318.6, 255.3),
        (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
        _MOCAP,
        True,
        *_TUM,
    ),
    _Family(
        "freiburg2",
        (520.9, 521.0, 325.1, 249.7),
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
        _MOCAP,
        True,
        *_TUM,
    ),
    _Family("freiburg3", (535.4, 539.2, 320.1, 247.6), (), _MOCAP, True, *_TUM),
    _Family(
        # https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/
        "bonn",
        (542.822841, 542.576870, 315.593520, 237.756098),
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        _MOCAP,
        False,
        "see the terms of the University of Bonn",
        "Palazzolo et al.: ReFusion: 3D reconstruction in dynamic environments. IROS 2019",
        "https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/",
    ),
    _Family(
        # https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html: y of the camera points up, so fy is negative
        "icl",
        (481.20, -480.00, 319.50, 239.50),
        (),
        "rendering",
        False,
        "CC BY 3.0",
        "Handa et al.: A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM. ICRA 2014",
        "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html",
    ),
)
_KINECT = (525.0, 525.0, 319.5, 239.5)
"""ROS's default for a Kinect, as the benchmark's page says."""


class TumRgbdImporter:
    """Colour and depth images with their own timestamps, and poses of the camera, to a dataset.

    The body frame is that of the colour camera. Depth images are registered to it by the authors.
    """

    title = "TUM RGB-D folder: rgb.txt, depth.txt, groundtruth.txt; also of Bonn and ICL-NUIM"
    options = frozenset({"calibration", "depth_units_per_m", "groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The lists of the folder."""
        if _is_icl(path):
            return Detection((_ICL_ASSOCIATIONS, _ICL_TRUTH), ())
        found = [name for name in ("rgb.txt", "depth.txt", "groundtruth.txt") if (path / name).is_file()]
        return Detection(tuple(found), tuple(name for name in ("rgb.txt", "depth.txt") if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the folder; raises InvalidInput naming the file, the line, and the remedy."""
        # Exports of SLAM Hive describe the cameras in dataset.yaml; it counts unless users say otherwise.
        path = source / DATASET_FILE
        if not options.calibration and path.is_file():
            stated = next((sensor for sensor in load_sensors(path) if sensor.kind is SensorKind.DEPTH), None)
            units_per_m = None if stated is None else float(stated.calibration["units_per_m"])  # type: ignore[arg-type]
            options = replace(options, calibration=(path,), depth_units_per_m=options.depth_units_per_m or units_per_m)
        colour, colour_notes = _frames(source, "rgb.txt", 3)
        depth, depth_notes = _frames(source, "depth.txt", 1)
        resolved = source.resolve()
        names = f"{resolved.parent.name}/{resolved.name}".lower()
        family = next((family for family in _FAMILIES if family.key in names), None)
        if _is_icl(source):
            family = _FAMILIES[-1]
        intrinsics, camera_notes = _intrinsics(colour.paths[0], family, options)
        camera = camera_stream("cam0", colour, intrinsics)
        streams = (camera, depth_stream(camera.sensor, depth, options.depth_units_per_m or _UNITS_PER_M))
        truth = _at_images(_truth(source, family, options), camera)
        notes = (*colour_notes, *depth_notes, *camera_notes, *_left_out(source), *matched_truth(truth, streams))
        return ImportPlan(streams, truth, _text(source, family), notes=notes)


def _at_images(truth: PlannedTruth | None, camera: PlannedStream) -> PlannedTruth | None:
    """The ground truth with the times of the images: ETH3D's tool, which reads such folders, compares at these."""
    return None if truth is None else replace(truth, image_times_s=camera.times_ns / NS_PER_S)


def _is_icl(source: Path) -> bool:
    return (
        (source / _ICL_ASSOCIATIONS).is_file()
        and bool(visible_files(source, _ICL_TRUTH))
        and not (source / "rgb.txt").exists()
    )


def _frames(source: Path, name: str, column: int) -> tuple[Frames, tuple[str, ...]]:
    """The images of a list; ICL-NUIM has one list for both, ``number depth number colour``, and no timestamps."""
    if not _is_icl(source):
        return listed_frames(source, name)
    rows = _icl_rows(source / _ICL_ASSOCIATIONS, "number depth number colour")
    kept, paths = rows.files(source, column - 1)
    return Frames(nominal_times_ns(kept.times_ns.tolist(), _ICL_FRAMES_PER_S), paths), rows.notes(kept)


def _icl_rows(path: Path, layout: str) -> TimedList:
    """Rows whose first column is the number of a frame."""
    return parse_timed_list(read_lines(path), path, layout, TimeUnit.NS, columns=len(layout.split()))


def _intrinsics(
    image: Path, family: _Family | None, options: ImportOptions
) -> tuple[CameraIntrinsics, tuple[str, ...]]:
    given = given_camera(options.calibration)
    if given is not None:
        return given, ()
    width, height = size_of(image)
    if (width, height) != _SIZE:
        raise InvalidInput(
            f"frame {image} is {width}x{height} pixels, the published intrinsics are for {_SIZE[0]}x{_SIZE[1]}",
            "give the intrinsics with --calibration FILE",
        )
    if family is None:
        note = "the name of the folder names no known camera: intrinsics are ROS's default for a Kinect (fx 525)"
        return CameraIntrinsics(width, height, *_KINECT, distortion=(0.0,) * 4), (note,)
    model = CameraModel.PINHOLE_RADTAN if family.distortion else CameraModel.PINHOLE
    intrinsics = CameraIntrinsics(width, height, *family.intrinsics, model, family.distortion or (0.0,) * 4)
    notes = [f"intrinsics are those published for {family.key}"]
    if intrinsics.fy < 0:
        notes.append("fy is negative as published: y of the camera points up, and ground truth uses the same frame")
        notes.append(f"timestamps are nominal: {_ICL_FRAMES_PER_S:g} frames per second")
    return intrinsics, tuple(notes)


def _truth(source: Path, family: _Family | None, options: ImportOptions) -> PlannedTruth | None:
    measured = "" if family is None else family.truth
    upright = family is not None and family.gravity_aligned
    path = options.groundtruth or source / "groundtruth.txt"
    if options.groundtruth is None and _is_icl(source):
        rows = _icl_rows(_only(visible_files(source, _ICL_TRUTH)), "number tx ty tz qx qy qz qw")
        times_ns = nominal_times_ns(rows.times_ns.tolist(), _ICL_FRAMES_PER_S)
        timed = TimedList(rows.path, times_ns, rows.rows, rows.line_numbers)
        return listed_truth(timed, rows.numbers(3, 4), measured, gravity_aligned=upright)
    if options.groundtruth is None and not path.exists():
        return None
    return tum_truth(path, measured, gravity_aligned=upright)


def _only(paths: list[Path]) -> Path:
    if len(paths) > 1:
        names = ", ".join(path.name for path in paths)
        raise InvalidInput(f"there are several ground truths: {names}", "give the right one with --groundtruth FILE")
    return paths[0]


def _left_out(source: Path) -> tuple[str, ...]:
    if not (source / "accelerometer.txt").is_file():
        return ()
    return ("accelerometer.txt is left out: without angular rates it makes no IMU",)


def _text(source: Path, family: _Family | None) -> DatasetText:
    name = source.resolve().name
    title = {"bonn": "Bonn RGB-D Dynamic", "icl": "ICL-NUIM"}.get("" if family is None else family.key, "TUM RGB-D")
    return DatasetText(
        title=f"{title}, {name}",
        description="Colour and registered depth images; the body is the colour camera.",
        licence="" if family is None else family.licence,
        citation="" if family is None else family.citation,
        source="" if family is None else family.source,
        attributes=("synthetic" if family is not None and family.key == "icl" else "real", "indoor", "handheld"),
    )


# Importer of the ETH3D SLAM benchmark (Schöps et al., "BAD SLAM", CVPR 2019):
# https://www.eth3d.net/slam_documentation.


_COLOUR, _DEPTH, _CAMERA, _TRUTH = "rgb.txt", "depth.txt", "calibration.txt", "groundtruth.txt"


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
        """Plan the import of the sequence; raises InvalidInput naming the file, the line and the remedy."""
        colour, notes = listed_frames(source, _COLOUR)
        # ``fx fy cx cy`` on one line; images are undistorted.
        path = source / _CAMERA
        try:
            fx, fy, cx, cy = read_pose_table(path, 4, "fx fy cx cy")[0].tolist()
        except NotFound as error:
            raise InvalidInput(error.message, "complete the folder") from None
        if not 0 < min(fx, fy) <= max(fx, fy, abs(cx), abs(cy)) < 1e6:
            raise InvalidInput(
                f"{path}: {fx:g} {fy:g} {cx:g} {cy:g} are no intrinsics", "expected fx fy cx cy in pixels"
            )
        width, height = size_of(colour.paths[0])
        streams: list[PlannedStream] = [
            camera_stream("cam0", colour, CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4))
        ]
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
        truth = _at_images(truth, streams[0])
        return ImportPlan(
            tuple(streams),
            truth,
            DatasetText(
                title=f"ETH3D SLAM, {source.resolve().name}",
                description=(
                    "Colour and registered depth images of global-shutter cameras; the body is the colour camera."
                ),
                licence="CC BY-NC-SA 4.0",
                citation="Schöps, Sattler, Pollefeys: BAD SLAM: Bundle adjusted direct RGB-D SLAM. CVPR 2019",
                source="https://www.eth3d.net/slam_overview",
                attributes=("real", "indoor", "handheld"),
            ),
            notes=(*notes, *matched_truth(truth, streams)),
        )
