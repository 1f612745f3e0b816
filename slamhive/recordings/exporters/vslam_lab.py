"""Exports to the folders of VSLAM-LAB (Fontan et al., 2025): ``rgb.csv``, ``calibration.yaml`` and images."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics, CameraModel
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
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
    share_pixels,
    truth_left_out,
)
from slamhive.recordings.staging import Progress

_IMU_HEADER = "ts (ns),wx (rad s^-1),wy (rad s^-1),wz (rad s^-1),ax (m s^-2),ay (m s^-2),az (m s^-2)"
_TRUTH_HEADER = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw"
_DISTORTION_TYPES = {
    CameraModel.PINHOLE: "radtan",
    CameraModel.PINHOLE_RADTAN: "radtan",
    CameraModel.PINHOLE_EQUIDISTANT: "equid",
    CameraModel.FISHEYE_KB: "equid",
}
_NOISE_KEYS = {
    "sigma_g_c": "gyroscope_noise_density",
    "sigma_a_c": "accelerometer_noise_density",
    "sigma_gw_c": "gyroscope_random_walk",
    "sigma_aw_c": "accelerometer_random_walk",
}
_MOST_CAMERAS = 2
_SAMPLE_BYTES = 160


@dataclass(frozen=True, slots=True)
class _Chosen:
    """The sensors that the format holds."""

    cameras: tuple[Sensor, ...]
    depth: Sensor | None
    imu: Sensor | None

    @property
    def images(self) -> dict[str, Sensor]:
        """The sensors of images by the name that the format gives them."""
        named = {f"rgb_{place}": camera for place, camera in enumerate(self.cameras)}
        return named if self.depth is None else {**named, "depth_0": self.depth}

    @property
    def all(self) -> tuple[Sensor, ...]:
        return (*self.images.values(), *([] if self.imu is None else [self.imu]))


class VslamLabExporter:
    """One or two cameras, a depth image and an IMU. A row of ``rgb.csv`` holds the images that belong together."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Raises InvalidInput for a dataset without cameras, or with a camera model that the format has no name for.

        A camera with another number of images than the first one is left out, and depth with another geometry.
        """
        counts = message_counts(dataset)
        chosen = _choose(dataset, counts)
        for camera in chosen.images.values():
            _distortion_type(camera)
        needed_bytes = sum(counts[sensor.name] * image_bytes(sensor) for sensor in chosen.images.values())
        needed_bytes += 0 if chosen.imu is None else counts[chosen.imu.name] * _SAMPLE_BYTES
        missing = left_out(dataset, chosen.all) + truth_left_out(dataset)
        return ExportPlan(partial(_write, dataset, chosen), needed_bytes, missing)


def _choose(dataset: Dataset, counts: dict[str, int]) -> _Chosen:
    cameras = dataset.of_kind(SensorKind.CAMERA)
    if not cameras:
        raise InvalidInput(f"dataset {dataset.name} has no camera, which vslam-lab is about", "export to mcap")
    frames = counts[cameras[0].name]
    paired = tuple(camera for camera in cameras if counts[camera.name] == frames)[:_MOST_CAMERAS]
    depths = (sensor for sensor in dataset.of_kind(SensorKind.DEPTH) if counts[sensor.name] == frames)
    depth = next((sensor for sensor in depths if share_pixels(sensor, cameras[0])), None)
    return _Chosen(paired, depth, next(iter(dataset.of_kind(SensorKind.IMU)), None))


def _write(dataset: Dataset, chosen: _Chosen, folder: Path, progress: Progress) -> None:
    images = {
        name: ImageSink(sensor, folder / name, lambda stamp_ns, _: f"{stamp_ns}.png")
        for name, sensor in chosen.images.items()
    }
    with ExitStack() as stack:
        sinks: dict[str, Sink] = {sink.sensor.name: sink for sink in images.values()}
        if chosen.imu is not None:
            samples = ImuSink(folder / "imu_0.csv", _IMU_HEADER)
            stack.callback(samples.close)
            sinks[chosen.imu.name] = samples
        export_frames(dataset, sinks, progress)
    rows = [",".join(f"ts_{name} (ns),path_{name}" for name in images)]
    for entries in zip(*(sink.entries for sink in images.values()), strict=True):
        pairs = zip(images, entries, strict=True)
        rows.append(",".join(f"{stamp_ns},{name}/{file}" for name, (stamp_ns, file) in pairs))
    (folder / "rgb.csv").write_text("\n".join(rows) + "\n", encoding="ascii")
    (folder / "calibration.yaml").write_text(_calibration(chosen), encoding="ascii")
    truth = read_truth(dataset)
    if truth is not None:
        poses = zip(truth.times_ns.tolist(), truth.positions_m.tolist(), truth.quats_xyzw.tolist(), strict=True)
        lines = [",".join([str(time_ns), *map(repr, position), *map(repr, quat)]) for time_ns, position, quat in poses]
        (folder / "groundtruth.csv").write_text("\n".join([_TRUTH_HEADER, *lines]) + "\n", encoding="ascii")


def _calibration(chosen: _Chosen) -> str:
    cameras = [_camera(name, sensor, chosen) for name, sensor in chosen.images.items() if name != "depth_0"]
    text = "%YAML 1.2\n---\ncameras:\n" + "\n".join(cameras) + "\n"
    return text if chosen.imu is None else f"{text}imus:\n{_imu(chosen.imu)}\n"


def _camera(name: str, sensor: Sensor, chosen: _Chosen) -> str:
    seen = CameraIntrinsics.of(sensor)
    kind = "gray" if str(sensor.calibration.get("encoding", "")).startswith("mono") else "rgb"
    distortion = seen.distortion or (0.0, 0.0, 0.0, 0.0)
    values = {
        "cam_name": name,
        "cam_type": kind,
        "cam_model": "pinhole",
        "distortion_type": f"{_distortion_type(sensor)}{len(distortion)}",
        "focal_length": numbers((seen.fx, seen.fy)),
        "principal_point": numbers((seen.cx, seen.cy)),
        "distortion_coefficients": numbers(distortion),
        "image_dimension": f"[{seen.width}, {seen.height}]",
        "fps": number(sensor.rate_hz),
        "T_BS": numbers(sensor.T_body_sensor),
    }
    if name == "rgb_0" and chosen.depth is not None:
        values["cam_type"] = f"{kind}+depth"
        values["depth_name"] = "depth_0"
        values["depth_factor"] = number(chosen.depth.calibration["units_per_m"])
    return _entry(values)


def _imu(imu: Sensor) -> str:
    noise = {key: number(imu.calibration[own]) for key, own in _NOISE_KEYS.items() if own in imu.calibration}
    return _entry({"imu_name": "imu_0", **noise, "fps": number(imu.rate_hz), "T_BS": numbers(imu.T_body_sensor)})


def _entry(values: dict[str, str]) -> str:
    return "  - {" + ",\n     ".join(f"{key}: {value}" for key, value in values.items()) + "\n    }"


def _distortion_type(camera: Sensor) -> str:
    model = CameraIntrinsics.of(camera).model
    if model not in _DISTORTION_TYPES:
        raise InvalidInput(
            f"{camera.name} has the camera model {model}, which vslam-lab has no name for",
            ELSEWHERE,
        )
    return _DISTORTION_TYPES[model]
