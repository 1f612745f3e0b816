"""``dataset.yaml`` to :class:`~slamhive.domain.dataset.Dataset` and back."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import check_name_in, first_problem
from slamhive.domain.calibration import camera_model
from slamhive.domain.dataset import MOST_UNCERTAIN_M, Dataset, GroundTruth
from slamhive.domain.protocol import check_lever_arm
from slamhive.domain.sensors import IDENTITY4, CalibrationValue, Sensor, SensorKind, is_rigid

DATASET_FILE = "dataset.yaml"
FORMAT = 1

_TOPIC = re.compile(r"/?[A-Za-z0-9_/]{1,200}")
_CHECKSUM = re.compile(r"sha256:[0-9a-f]{64}")
REQUIRED_CALIBRATION: dict[SensorKind, tuple[str, ...]] = {
    SensorKind.CAMERA: ("width", "height", "fx", "fy", "cx", "cy"),
    SensorKind.DEPTH: ("width", "height", "fx", "fy", "cx", "cy", "units_per_m"),
}
_CAMERAS = {SensorKind.CAMERA, SensorKind.DEPTH}


class _SensorModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    name: str
    kind: SensorKind
    topic: str
    rate_hz: float = Field(gt=0, le=100_000)
    T_body_sensor: list[float] = Field(default_factory=lambda: list(IDENTITY4), min_length=16, max_length=16)
    calibration: dict[str, bool | int | float | str | list[float]] = Field(default_factory=dict)

    @field_validator("topic")
    @classmethod
    def _is_a_topic(cls, value: str) -> str:
        if not _TOPIC.fullmatch(value):
            raise ValueError("must be a topic like /cam0/image_raw: letters, digits, '_' and '/', at most 200")
        return value

    @field_validator("T_body_sensor")
    @classmethod
    def _is_rigid(cls, value: list[float]) -> list[float]:
        if not is_rigid(tuple(value)):
            raise ValueError("must be a rigid transform by rows: a rotation, a translation in m, last row 0 0 0 1")
        return value


class _GroundTruthModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    file: str
    gravity_aligned: bool
    positions_only: bool = False
    kitti_poses: str | None = None
    source: str = ""
    lever_arm_m: list[float] | None = None
    uncertainty_m: float | None = Field(default=None, gt=0, le=MOST_UNCERTAIN_M, allow_inf_nan=False)
    uncertainties: str | None = None
    image_times: str | None = None


class _DatasetModel(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)
    format: Literal[1]
    name: str
    title: str = ""
    description: str = ""
    licence: str = ""
    citation: str = ""
    source: str = ""
    attributes: list[str] = Field(default_factory=list)
    bag: str | None = None
    duration_s: float = Field(ge=0)
    checksum: str
    sensors: list[_SensorModel]
    groundtruth: _GroundTruthModel | None = None
    reference_map: str | None = None
    relations: str | None = None

    @field_validator("checksum")
    @classmethod
    def _is_a_checksum(cls, value: str) -> str:
        if not _CHECKSUM.fullmatch(value):
            raise ValueError("must be sha256: and 64 hexadecimal digits, in lower case")
        return value

    @field_validator("bag")
    @classmethod
    def _stays_inside(cls, value: str | None) -> str | None:
        if value is None:
            return None
        path = PurePosixPath(value)
        if path.is_absolute() or ".." in path.parts or not path.parts:
            raise ValueError("must be a path inside the dataset folder")
        return value


def load_sensors(path: Path) -> tuple[Sensor, ...]:
    """The sensors of the ``dataset.yaml`` at ``path``, wherever it lies; raises as :func:`load_dataset`."""
    model = _read(path)
    _check_sensors(path, model.sensors)
    return tuple(_sensor(sensor) for sensor in model.sensors)


def load_dataset(folder: Path) -> Dataset:
    """Read ``folder/dataset.yaml``; raises InvalidInput naming the file and the place."""
    path = folder / DATASET_FILE
    model = _read(path)
    check_name_in(path, "dataset", model.name)
    files = {
        "ground truth": None if model.groundtruth is None else model.groundtruth.file,
        "KITTI poses": None if model.groundtruth is None else model.groundtruth.kitti_poses,
        "uncertainties": None if model.groundtruth is None else model.groundtruth.uncertainties,
        "image times": None if model.groundtruth is None else model.groundtruth.image_times,
        "reference map": model.reference_map,
        "relations": model.relations,
    }
    for kind, file in files.items():
        if file is not None and (PurePosixPath(file).name != file or file in {"", ".", ".."}):
            raise InvalidInput(f"{path}: {kind} file {file!r} must be a plain file name in the dataset folder")
    if model.groundtruth is None and model.bag is None and model.relations is None:
        raise InvalidInput(f"{path}: it has neither a bag nor a groundtruth nor relations", "give one of them at least")
    _check_sensors(path, model.sensors)
    return Dataset(
        name=model.name,
        folder=folder,
        bag=model.bag or "",
        duration_s=model.duration_s,
        sensors=tuple(_sensor(sensor) for sensor in model.sensors),
        groundtruth=None if model.groundtruth is None else _truth(path, model.groundtruth),
        checksum=model.checksum,
        title=model.title,
        description=model.description,
        licence=model.licence,
        citation=model.citation,
        source=model.source,
        attributes=tuple(model.attributes),
        reference_map=model.reference_map,
        relations=model.relations,
    )


def _truth(path: Path, model: _GroundTruthModel) -> GroundTruth:
    arm_m = None if model.lever_arm_m is None else tuple(model.lever_arm_m)
    if arm_m is not None:
        check_lever_arm(arm_m, f"{path}: groundtruth.lever_arm_m")
        if not model.positions_only:
            raise InvalidInput(
                f"{path}: groundtruth.lever_arm_m is for positions; this ground truth has orientations",
                "move its poses to the body frame, or write positions_only: true",
            )
    return GroundTruth(**{**model.model_dump(), "lever_arm_m": arm_m})


def _read(path: Path) -> _DatasetModel:
    content = strict_yaml.load(path)
    try:
        return _DatasetModel.model_validate(content)
    except ValidationError as error:
        raise InvalidInput(f"{path}: {first_problem(error, _DatasetModel)}") from None


def dataset_to_yaml(dataset: Dataset) -> str:
    """The text of ``dataset.yaml`` for ``dataset``; what :func:`load_dataset` reads back to an equal value."""
    content: dict[str, Any] = {
        "format": FORMAT,
        "name": dataset.name,
        "title": dataset.title,
        "description": dataset.description,
        "licence": dataset.licence,
        **({"citation": dataset.citation} if dataset.citation else {}),
        "source": dataset.source,
        "attributes": list(dataset.attributes),
        **({"bag": dataset.bag} if dataset.bag else {}),
        "duration_s": dataset.duration_s,
        "checksum": dataset.checksum,
        "sensors": [
            {
                "name": sensor.name,
                "kind": sensor.kind.value,
                "topic": sensor.topic,
                "rate_hz": sensor.rate_hz,
                "T_body_sensor": list(sensor.T_body_sensor),
                "calibration": {
                    key: list(value) if isinstance(value, tuple) else value for key, value in sensor.calibration.items()
                },
            }
            for sensor in dataset.sensors
        ],
    }
    if dataset.groundtruth is not None:
        truth = asdict(dataset.groundtruth)
        content["groundtruth"] = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in truth.items()
            if value or key in {"file", "gravity_aligned", "positions_only"}
        }
    for key in ("reference_map", "relations"):
        if getattr(dataset, key) is not None:
            content[key] = getattr(dataset, key)
    return strict_yaml.dump(content)


def _sensor(model: _SensorModel) -> Sensor:
    return Sensor(
        name=model.name,
        kind=model.kind,
        topic=model.topic,
        rate_hz=model.rate_hz,
        T_body_sensor=tuple(model.T_body_sensor),
        calibration=_calibration(model),
    )


def _calibration(model: _SensorModel) -> dict[str, CalibrationValue]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in model.calibration.items()}


def _check_sensors(path: Path, sensors: list[_SensorModel]) -> None:
    names = [sensor.name for sensor in sensors]
    for sensor in sensors:
        check_name_in(path, "sensor", sensor.name)
        if names.count(sensor.name) > 1:
            raise InvalidInput(f"{path}: two sensors have the name {sensor.name!r}", "give each a name of its own")
        missing = [key for key in REQUIRED_CALIBRATION.get(sensor.kind, ()) if key not in sensor.calibration]
        if missing:
            raise InvalidInput(f"{path}: sensor {sensor.name} lacks calibration {', '.join(missing)}")
        if sensor.kind in _CAMERAS:
            camera_model(_calibration(sensor), f"{path}: sensor {sensor.name}")
