"""The step ``resolution``: smaller images, and a calibration that stays right."""

from __future__ import annotations

from typing import ClassVar, Literal

import cv2
from pydantic import Field

from slamhive.bags.variants.calibration import image_size, scale_sensor
from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput

_SMALLEST = 8
"""Pixels along the shorter side below which nothing is left to see, and codecs misbehave."""


class Resolution(Step):
    """Images of ``int(width * scale)`` x ``int(height * scale)`` pixels, as the published system cuts them.

    Pixel values are averages over the area that a new pixel covers (OpenCV's ``INTER_AREA``): a real sensor with larger
    pixels sees those. ``bilinear`` is what the published system does; it skips pixels below half size and aliases; at
    half it is the same. Depth takes the nearest pixel: the mean of a near and a far surface is where nothing is.
    """

    kind: ClassVar[str] = "resolution"

    scale: float = Field(gt=0, le=1, description="Width and height times this.")
    interpolation: Literal["area", "bilinear"] = Field(default="area", description="How camera pixels are made.")

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras and depth images."""
        return sensor.kind in {SensorKind.CAMERA, SensorKind.DEPTH}

    def check(self, sensor: Sensor) -> None:
        """Refuse what would leave no image."""
        width, height = image_size(sensor)
        if min(self.size(width, height)) < _SMALLEST:
            new_width, new_height = self.size(width, height)
            raise InvalidInput(
                f"step resolution: scale {self.scale:g} leaves {new_width}x{new_height} pixels of {sensor.name} "
                f"({width}x{height})",
                f"at least {_SMALLEST} pixels each way are needed",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the factor decides alone
        """The factor 1."""
        return self.scale == 1

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height in pixels afterwards."""
        return int(width * self.scale), int(height * self.scale)

    def calibrate(self, sensor: Sensor) -> Sensor:
        """Size and intrinsics scaled by the sizes actually made, which rounding leaves unequal in x and y."""
        return sensor if self.is_identity(sensor) else scale_sensor(sensor, self.size(*image_size(sensor)))

    def operation(self, stream: Stream) -> Operation:
        """A resize of every image."""
        if self.is_identity(stream.sensor):
            return Operation()
        size = self.size(*image_size(stream.sensor))
        method = cv2.INTER_AREA if self.interpolation == "area" else cv2.INTER_LINEAR
        if stream.sensor.kind is SensorKind.DEPTH:
            method = cv2.INTER_NEAREST_EXACT

        def resize(image: Array, _message: Message) -> Array:
            return cv2.resize(image, size, interpolation=method)

        return Operation(transform=resize)
