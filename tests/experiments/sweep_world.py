"""Algorithms and datasets that need not be installed, and rules for the steps that the tests use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from slamhive.base.errors import InvalidInput, unknown
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage, Input
from slamhive.domain.calibration import LidarLayout
from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter, ParameterType, Scalar
from slamhive.domain.sensors import Sensor, SensorKind, SensorSetup
from slamhive.experiments.binding import CatalogueView
from slamhive.runtime.point_times import PointTimes, TimeReference

CAMERA, DEPTH, IMU, LIDAR = SensorKind.CAMERA, SensorKind.DEPTH, SensorKind.IMU, SensorKind.LIDAR

FEATURES = Parameter("nFeatures", ParameterType.INT, 1200, "", minimum=100, maximum=10_000, general="features")
SCALE = Parameter("scaleFactor", ParameterType.FLOAT, 1.2, "", minimum=1.01, maximum=2)
VOXEL = Parameter("voxel", ParameterType.FLOAT, 0.3, "", general="voxel_size")
DESKEW = Parameter("deskew", ParameterType.BOOL, True, "", general="deskew")


class PlainRules:
    """Rate and resolution with the options that the real steps have, and one fault."""

    def kinds(self) -> Sequence[str]:
        return ["noise_gaussian", "rate", "resolution"]

    def options(self, kind: str) -> Sequence[str]:
        known = {"rate": ["every", "hz"], "resolution": ["scale"], "noise_gaussian": ["seed", "stddev"]}
        if kind not in known:
            raise unknown("pre-processing step", kind, list(known))
        return known[kind]

    def resolve(self, kind: str, options: Mapping[str, Scalar], sensor: Sensor) -> tuple[VariantStep | None, Sensor]:
        try:
            step = VariantStep(kind, (sensor.name,), {key: float(value) for key, value in options.items()})
        except ValueError:
            raise InvalidInput(f"step {kind}: {dict(options)} holds text") from None
        if kind == "rate":
            every = step.options.get("every")
            hz = sensor.rate_hz / float(every) if every is not None else float(step.options["hz"])
            if hz > sensor.rate_hz:
                raise InvalidInput(f"step rate: {hz:g} Hz is above the {sensor.rate_hz:g} Hz of {sensor.name}")
            return (None if hz == sensor.rate_hz else step), replace(sensor, rate_hz=hz)
        if "width" not in sensor.calibration:
            raise InvalidInput(f"step {kind}: {sensor.name} is not an image")
        if kind == "resolution":
            scale = float(step.options["scale"])
            if not 0 < scale <= 1:
                raise InvalidInput(f"step resolution: scale {scale:g} is outside (0, 1]")
            return (None if scale == 1 else step), sensor
        return (None if step.options["stddev"] == 0 else step), sensor


def algorithm(name: str, roles: Mapping[str, SensorKind], *parameters: Parameter) -> Algorithm:
    package = AlgorithmPackage(name, Path(name), name, "1", "", "", "")
    setup = SensorSetup.LIDAR if LIDAR in roles.values() else SensorSetup.STEREO
    inputs = tuple(Input(role, kind) for role, kind in roles.items())
    return Algorithm(name, package, "m", name, setup, inputs, inputs[0].role, tuple(parameters))


def dataset(name: str, *sensors: tuple[str, SensorKind, float]) -> Dataset:
    entries = tuple(
        Sensor(
            entry,
            kind,
            f"/{entry}",
            rate_hz,
            calibration=_CALIBRATION.get(kind, {}),
        )
        for entry, kind, rate_hz in sensors
    )
    return Dataset(name, Path(name), f"{name}.bag", 30.0, entries, None, "sha256:" + "0" * 64)


_INTRINSICS: dict[str, float | int | str | tuple[float, ...]] = {
    "width": 640,
    "height": 480,
    "fx": 422.4,
    "fy": 422.4,
    "cx": 319.5,
    "cy": 239.5,
}

_NOISE: dict[str, float | int | str | tuple[float, ...]] = {
    "gyroscope_noise_density": 1.7e-4,
    "accelerometer_noise_density": 2e-3,
    "gyroscope_random_walk": 1.9e-5,
    "accelerometer_random_walk": 3e-3,
}

_CALIBRATION = {
    CAMERA: _INTRINSICS,
    DEPTH: _INTRINSICS,
    IMU: _NOISE,
    LIDAR: LidarLayout(PointTimes(0.1, "time", reference=TimeReference.TIMESTAMP)).calibration(),
}

MONO = {"left": CAMERA}
STEREO = {"left": CAMERA, "right": CAMERA}
STEREO_INERTIAL = {**STEREO, "imu": IMU}

ROOM = dataset(
    "room", ("cam0", CAMERA, 20), ("cam1", CAMERA, 20), ("depth0", DEPTH, 20), ("imu0", IMU, 200), ("lidar0", LIDAR, 10)
)
EUROC = [
    dataset(name, ("cam0", CAMERA, 20), ("cam1", CAMERA, 20), ("imu0", IMU, 200))
    for name in ("MH_01", "MH_02", "MH_03", "MH_04", "MH_05")
]


def view(algorithms: Sequence[Algorithm] = (), datasets: Sequence[Dataset] = (ROOM,)) -> CatalogueView:
    chosen = algorithms or (
        algorithm("mono", MONO, FEATURES, SCALE),
        algorithm("stereo", STEREO, FEATURES, SCALE),
        algorithm("icp", {"points": LIDAR}, VOXEL, DESKEW),
    )
    return CatalogueView(
        {entry.name: entry for entry in chosen}, {entry.name: entry for entry in datasets}, PlainRules()
    )
