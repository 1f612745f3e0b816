"""Exports to the ASL layout of EuRoC (Burri et al., IJRR 2016): ``mav0/cam0/data/*.png``, ``imu0/data.csv``, ...."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind
from slamhive.recordings.exporters.base import (
    ELSEWHERE,
    ExportPlan,
    ImageSink,
    ImuSink,
    Sink,
    export_frames,
    image_bytes,
    left_out,
    message_counts,
    number,
    numbers,
    read_truth,
    truth_left_out,
)
from slamhive.recordings.staging import Progress

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_TRUTH_HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
_DISTORTION_MODELS = {
    CameraModel.PINHOLE: "radial-tangential",
    CameraModel.PINHOLE_RADTAN: "radial-tangential",
    CameraModel.PINHOLE_EQUIDISTANT: "equidistant",
    CameraModel.FISHEYE_KB: "equidistant",
}
_SAMPLE_BYTES = 160


class EurocExporter:
    """Cameras and IMUs with poses of the body. The ground truth has no velocities and biases: nobody measured them."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Raises InvalidInput for a dataset without cameras, or with a camera model that EuRoC has no name for."""
        cameras, imus = dataset.of_kind(SensorKind.CAMERA), dataset.of_kind(SensorKind.IMU)
        if not cameras:
            raise InvalidInput(f"dataset {dataset.name} has no camera, which euroc is about", "export to mcap")
        for camera in cameras:
            _distortion_model(camera)
        counts = message_counts(dataset)
        needed_bytes = sum(counts[camera.name] * image_bytes(camera) for camera in cameras)
        needed_bytes += sum(counts[imu.name] * _SAMPLE_BYTES for imu in imus)
        return ExportPlan(
            partial(_write, dataset),
            needed_bytes,
            left_out(dataset, (*cameras, *imus)) + truth_left_out(dataset),
        )


def _write(dataset: Dataset, folder: Path, progress: Progress) -> None:
    mav = folder / "mav0"
    mav.mkdir()
    (mav / "body.yaml").write_text(f"%YAML:1.0\ncomment: {dataset.name}\n", encoding="utf-8")
    with ExitStack() as stack:
        sinks: dict[str, Sink] = {}
        images: list[ImageSink] = []
        for place, camera in enumerate(dataset.of_kind(SensorKind.CAMERA)):
            images.append(ImageSink(camera, mav / f"cam{place}" / "data", lambda stamp_ns, _: f"{stamp_ns}.png"))
            sinks[camera.name] = images[-1]
            seen = CameraIntrinsics.of(camera)
            lines = [
                *_sensor_lines("camera", camera.name, camera.T_body_sensor),
                f"rate_hz: {number(camera.rate_hz)}",
                f"resolution: [{seen.width}, {seen.height}]",
                "camera_model: pinhole",
                f"intrinsics: {numbers((seen.fx, seen.fy, seen.cx, seen.cy))} #fu, fv, cu, cv",
                f"distortion_model: {_distortion_model(camera)}",
                f"distortion_coefficients: {numbers(seen.distortion or (0.0, 0.0, 0.0, 0.0))}",
            ]
            lines += ["rectified: true"] if seen.rectified else []
            (mav / f"cam{place}" / "sensor.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        for place, imu in enumerate(dataset.of_kind(SensorKind.IMU)):
            samples = ImuSink(mav / f"imu{place}" / "data.csv", _IMU_HEADER)
            stack.callback(samples.close)
            sinks[imu.name] = samples
            noise = [f"{key}: {number(value)}" for key, value in ImuNoise.of(imu).calibration().items()]
            lines = [*_sensor_lines("imu", imu.name, imu.T_body_sensor), f"rate_hz: {number(imu.rate_hz)}", *noise]
            (mav / f"imu{place}" / "sensor.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        export_frames(dataset, sinks, progress)
    for sink in images:
        lines = ["#timestamp [ns],filename", *(f"{stamp_ns},{file}" for stamp_ns, file in sink.entries)]
        (sink.folder.parent / "data.csv").write_text("\n".join(lines) + "\n", encoding="ascii")
    truth = read_truth(dataset)
    if truth is not None:
        truth_folder = mav / "state_groundtruth_estimate0"
        truth_folder.mkdir()
        rows = zip(
            truth.times_ns.tolist(), truth.positions_m.tolist(), truth.quats_xyzw[:, [3, 0, 1, 2]].tolist(), strict=True
        )
        lines = [",".join([str(time_ns), *map(repr, position), *map(repr, quat)]) for time_ns, position, quat in rows]
        (truth_folder / "data.csv").write_text("\n".join([_TRUTH_HEADER, *lines]) + "\n", encoding="ascii")
        (truth_folder / "sensor.yaml").write_text(
            "\n".join([*_sensor_lines("visual-inertial", "ground truth of the body", IDENTITY4)]) + "\n",
            encoding="utf-8",
        )


def _sensor_lines(kind: str, comment: str, T_body_sensor: Matrix4) -> list[str]:
    return [
        "%YAML:1.0",
        f"sensor_type: {kind}",
        f"comment: {comment}",
        "T_BS:",
        "  cols: 4",
        "  rows: 4",
        f"  data: {numbers(T_body_sensor)}",
    ]


def _distortion_model(camera: Sensor) -> str:
    model = CameraIntrinsics.of(camera).model
    if model not in _DISTORTION_MODELS:
        raise InvalidInput(f"{camera.name} has the camera model {model}, which euroc has no name for", ELSEWHERE)
    return _DISTORTION_MODELS[model]
