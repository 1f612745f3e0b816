"""Exports to the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012): ``rgb.txt``, ``depth.txt`` and images."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import IDENTITY4, Sensor, SensorKind
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.exporters.base import (
    ELSEWHERE,
    ExportPlan,
    ImageSink,
    export_frames,
    image_bytes,
    left_out,
    message_counts,
    read_truth,
    share_pixels,
    truth_left_out,
)
from slamhive.recordings.staging import GROUND_TRUTH_FILE, Progress
from slamhive.trajectory.layout import TUM_LAYOUT

_USUAL_UNITS_PER_M = 5000.0
_INTEGER_ENCODINGS = {"16UC1", "mono16"}
_NS_PER_S = 1_000_000_000


class TumRgbdExporter:
    """One colour or grey camera and the depth image that belongs to it. The body is the camera, as in this format."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Raises InvalidInput for a dataset without depth or camera, or with depth that PNG cannot hold."""
        camera, depth = _pair(dataset)
        counts = message_counts(dataset)
        units_per_m = float(depth.calibration["units_per_m"])  # type: ignore[arg-type]
        notes = []
        if units_per_m != _USUAL_UNITS_PER_M:
            notes.append(
                f"A depth pixel of {units_per_m:g} means 1 m; tools for this format expect {_USUAL_UNITS_PER_M:g}."
            )
        return ExportPlan(
            partial(_write, dataset, camera, depth),
            sum(counts[sensor.name] * image_bytes(sensor) for sensor in (camera, depth)),
            left_out(dataset, (camera, depth)) + truth_left_out(dataset),
            tuple(notes),
        )


def _pair(dataset: Dataset) -> tuple[Sensor, Sensor]:
    depths, cameras = dataset.of_kind(SensorKind.DEPTH), dataset.of_kind(SensorKind.CAMERA)
    for sensors, kind in ((depths, "depth"), (cameras, "camera")):
        if not sensors:
            raise InvalidInput(
                f"dataset {dataset.name} has no {kind}, which tum-rgbd is about", "export to euroc or mcap"
            )
    depth = depths[0]
    encoding = depth.calibration.get("encoding", "16UC1")
    if encoding not in _INTEGER_ENCODINGS:
        raise InvalidInput(
            f"{depth.name} has pixels of {encoding}, and tum-rgbd holds integers of 16 bits",
            ELSEWHERE,
        )
    partner = depth.calibration.get("registered_to")
    camera = next((sensor for sensor in cameras if sensor.name == partner), cameras[0])
    if not share_pixels(depth, camera):
        raise InvalidInput(
            f"{depth.name} does not see what {camera.name} sees pixel by pixel, as tum-rgbd requires",
            ELSEWHERE,
        )
    return camera, depth


def _write(dataset: Dataset, camera: Sensor, depth: Sensor, folder: Path, progress: Progress) -> None:
    sinks = {
        sensor.name: ImageSink(sensor, folder / name, lambda stamp_ns, _: f"{_seconds(stamp_ns)}.png")
        for sensor, name in ((camera, "rgb"), (depth, "depth"))
    }
    export_frames(dataset, sinks, progress)
    for sink, kind in zip(sinks.values(), ("color images", "depth maps"), strict=True):
        lines = [f"# {kind}", f"# file: '{dataset.name}'", "# timestamp filename"]
        lines += [f"{_seconds(stamp_ns)} {sink.folder.name}/{file}" for stamp_ns, file in sink.entries]
        (folder / f"{sink.folder.name}.txt").write_text("\n".join(lines) + "\n", encoding="ascii")
    truth = read_truth(dataset)
    if truth is not None:
        poses = truth.of_sensor(camera.T_body_sensor)
        rows = zip(poses.times_ns.tolist(), np.hstack((poses.positions_m, poses.quats_xyzw)).tolist(), strict=True)
        text = "".join(f"{_seconds(time_ns)} {' '.join(f'{value:.9f}' for value in row)}\n" for time_ns, row in rows)
        write_aside(
            folder / GROUND_TRUTH_FILE, f"# ground truth trajectory\n# file: '{dataset.name}'\n# {TUM_LAYOUT}\n{text}"
        )
    (folder / DATASET_FILE).write_text(_description(dataset, camera, depth), encoding="utf-8")


def _description(dataset: Dataset, *sensors: Sensor) -> str:
    """``dataset.yaml`` of the two sensors with the camera as the body: this format has no file for the calibration."""
    described = tuple(replace(sensor, T_body_sensor=IDENTITY4) for sensor in sensors)
    truth = dataset.groundtruth
    if truth is not None:
        alone = replace(truth, file=GROUND_TRUTH_FILE, kitti_poses=None, uncertainties=None, image_times=None)
        truth = None if truth.positions_only else alone
    made = replace(dataset, bag="", sensors=described, groundtruth=truth, reference_map=None, relations=None)
    return dataset_to_yaml(made)


def _seconds(stamp_ns: int) -> str:
    """Nine decimals: the published files have six, and readers take any number."""
    return f"{stamp_ns // _NS_PER_S}.{stamp_ns % _NS_PER_S:09d}"
