"""Importer of a video with the intrinsics of its camera. OpenCV decodes it, one frame at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array
from slamhive.recordings.importers.calibration import given_camera
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    Loss,
    PlannedStream,
    matched_truth,
    rate_hz,
    tum_truth,
)
from slamhive.recordings.rgbd import nominal_times_ns
from slamhive.recordings.streams import OVERHEAD_BYTES, check_size
from slamhive.recordings.writers import BagWriter

_ENDINGS = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v"})
_MOST_FRAMES = 1_000_000


@dataclass
class _Video:
    """Decodes the frames of a file in their order; going back starts again."""

    path: Path
    _capture: cv2.VideoCapture | None = field(default=None, init=False)
    _next: int = field(default=0, init=False)

    def frame(self, index: int) -> Array:
        if self._capture is None or index < self._next:
            self._capture, self._next = _open(self.path), 0
        while True:
            there, pixels = self._capture.read()
            if not there:
                self._capture = None
                raise InvalidInput(f"{self.path}: frame {self._next} cannot be decoded", "copy the video again")
            self._next += 1
            if self._next > index:
                return np.asarray(pixels)


class VideoImporter:
    """The frames of a video to a dataset; the body is the camera. Timestamps are those of the container."""

    title = "video file (.mp4, .avi, .mov, .mkv, .webm) with the intrinsics of its camera"
    options = frozenset({"calibration", "frame_rate_hz", "groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The ending of the file."""
        is_video = path.is_file() and path.suffix.lower() in _ENDINGS
        return Detection((path.suffix,) if is_video else (), () if is_video else ("a video file",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the video: it is decoded once for its timestamps. Raises InvalidInput."""
        intrinsics = given_camera(options.calibration)
        if intrinsics is None:
            raise InvalidInput(f"{source} does not say what its camera is", "give intrinsics with --calibration FILE")
        times_ns, notes = _times_ns(source)
        if options.frame_rate_hz is not None:
            times_ns, notes = nominal_times_ns(range(len(times_ns)), options.frame_rate_hz), ()
        stream = _stream(source, times_ns, intrinsics)
        path = options.groundtruth
        truth = None if path is None else tum_truth(path, "", gravity_aligned=False)
        text = DatasetText(title=f"Video {source.name}", description="The frames of a video; the body is the camera.")
        return ImportPlan((stream,), truth, text, notes=(*notes, *matched_truth(truth, [stream])))


def _stream(source: Path, times_ns: Array, intrinsics: CameraIntrinsics) -> PlannedStream:
    calibration = intrinsics.calibration("bgr8")
    sensor = Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", rate_hz(times_ns), calibration=calibration)
    video = _Video(source)

    def write(bag: BagWriter, index: int) -> None:
        pixels, stamp_ns = video.frame(index), int(times_ns[index])
        check_size(source, pixels, sensor.name, intrinsics)
        bag.camera_info(sensor, "/cam0/camera_info", stamp_ns)
        bag.image(sensor, stamp_ns, pixels, "bgr8")

    check_size(source, video.frame(0), sensor.name, intrinsics)
    return PlannedStream(sensor, times_ns, write, 3 * intrinsics.width * intrinsics.height + OVERHEAD_BYTES)


def _times_ns(source: Path) -> tuple[Array, tuple[str, ...]]:
    """The timestamps of the frames that can be decoded, from 0, and notes; raises InvalidInput."""
    capture = _open(source)
    declared = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    times_ms: list[float] = []
    while capture.grab() and len(times_ms) < _MOST_FRAMES:
        times_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    if len(times_ms) < 2:
        raise InvalidInput(f"{source} has {len(times_ms)} frames that can be decoded", "copy the video again")
    times_ns = np.rint((np.array(times_ms) - times_ms[0]) * 1e6).astype(np.int64)
    if not np.isfinite(times_ms).all() or (np.diff(times_ns) <= 0).any():
        raise InvalidInput(f"{source}: the timestamps of its frames do not increase", "give --frame-rate HZ")
    if declared > len(times_ms):
        missing = declared - len(times_ms)
        return times_ns, (
            Loss(missing, declared, f"{missing} of {declared} frames cannot be decoded and are left out"),
        )
    return times_ns, ()


def _open(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InvalidInput(f"{path} cannot be read as a video", "give a file that FFmpeg decodes, or copy it again")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture
