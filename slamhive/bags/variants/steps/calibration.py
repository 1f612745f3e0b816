"""The step ``calibration``: intrinsics stated by hand, instead of those that follow from the resize."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

from pydantic import model_validator

from slamhive.bags.variants.step import Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind

_MOST_PX = 1e6


class Calibration(Step):
    """The focal lengths and the principal point that are announced; no pixel changes.

    What is not given stays as the steps before have left it. The variant's ``dataset.yaml``, the algorithm's settings
    and ``CameraInfo`` in the recording all get the values. In ``CameraInfo`` the matrices K and P keep their relation
    to ``dataset.yaml``, so P keeps the stereo baseline. After ``resolution`` it overrides the intrinsics that follow
    from the resize: linked to the scale in an experiment, each scale has values of its own, as in the published system.
    """

    kind: ClassVar[str] = "calibration"

    fx: float | None = option("Focal length along the rows.", unit="px", default=None, gt=0, le=_MOST_PX)
    fy: float | None = option("Focal length along the columns.", unit="px", default=None, gt=0, le=_MOST_PX)
    cx: float | None = option(
        "Principal point along the rows; pixel centres are whole.", unit="px", default=None, ge=-_MOST_PX, le=_MOST_PX
    )
    cy: float | None = option(
        "Principal point along the columns; pixel centres are whole.",
        unit="px",
        default=None,
        ge=-_MOST_PX,
        le=_MOST_PX,
    )

    @model_validator(mode="after")
    def _states_something(self) -> Self:
        if not self._stated():
            raise ValueError("give at least one of fx, fy, cx, cy")
        return self

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras and depth images."""
        return sensor.kind in {SensorKind.CAMERA, SensorKind.DEPTH}

    def is_identity(self, sensor: Sensor) -> bool:
        """What the sensor has anyway."""
        return all(sensor.calibration[key] == value for key, value in self._stated().items())

    def calibrate(self, sensor: Sensor) -> Sensor:
        """The sensor with the values stated."""
        return replace(sensor, calibration={**sensor.calibration, **self._stated()})

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - the data stays
        """Nothing: images are copied as they are."""
        return Operation()

    def _stated(self) -> dict[str, float]:
        values = {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy}
        return {key: value for key, value in values.items() if value is not None}
