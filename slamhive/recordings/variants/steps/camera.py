"""Steps on camera images, with the scale of pixel values, and changes that leave transparency alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Literal, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.calibration import image_size, scale_sensor
from slamhive.recordings.variants.step import Array, Message, Operation, SeededStep, Step, Stream, Swing, option

FULL_SCALE_8BIT = 255.0
"""Grey levels are given on the scale of 8 bits, whatever the image has."""


def full_scale(image: Array) -> float:
    """The value of white: the largest of an integer type, 1 for floats."""
    return float(np.iinfo(image.dtype).max) if np.issubdtype(image.dtype, np.integer) else 1.0


def change_light(image: Array, change: Callable[[Array], Array]) -> Array:
    """Apply ``change`` to the pixel values as float32 0..1, clip, round back to the image's type.

    A fourth channel is transparency and stays.
    """
    white = full_scale(image)
    light = image[..., :3] if image.ndim == 3 else image
    changed = np.clip(change(light.astype(np.float32) / np.float32(white)), 0.0, 1.0) * np.float32(white)
    if np.issubdtype(image.dtype, np.integer):
        np.rint(changed, out=changed)
    result = changed.astype(image.dtype)
    if image.ndim == 3 and image.shape[2] == 4:
        return np.concatenate([result, image[..., 3:]], axis=2)
    return result


def lookup(image: Array, curve: Callable[[Array], Array]) -> Array:
    """Apply ``curve`` (0..1 to 0..1, elementwise) to every pixel; integer images through a table."""
    if not np.issubdtype(image.dtype, np.integer):
        return change_light(image, curve)
    white = full_scale(image)
    values = np.clip(curve(np.arange(int(white) + 1) / white), 0.0, 1.0) * white
    table = np.rint(values).astype(image.dtype)
    result: Array = table[image]
    if image.ndim == 3 and image.shape[2] == 4:
        result[..., 3] = image[..., 3]
    return result


# The step ``resolution``: smaller images, and a calibration that stays right.


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


# The step ``calibration``: intrinsics stated by hand, instead of those that follow from the resize.


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
        """Noise that the sensor has anyway."""
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


# The fault ``exposure``: images too bright or too dark, steadily or swinging.


class Exposure(SeededStep):
    """Pixel values times 2^stops, clipped at white: what a different exposure time makes of a linear sensor."""

    kind: ClassVar[str] = "exposure"

    stops: float = option("Change of exposure; 1 doubles the brightness.", unit="stops", default=0.0, ge=-8, le=8)
    swing_stops: float = option("How far it swings around that.", unit="stops", default=0.0, ge=0, le=8)
    period_s: float = option("Duration of one swing.", unit="s", default=4.0, ge=0.1, le=3600)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No change at any time."""
        return self.stops == 0 and self.swing_stops == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A factor on every image."""
        swing = Swing(self.stops, self.swing_stops, self.period_s, self.seed)

        def degrade(image: Array, message: Message) -> Array:
            return expose(image, swing.at(message.stamp_ns))

        return Operation(transform=degrade)


def expose(image: Array, stops: float) -> Array:
    """``image`` times 2^``stops``, clipped to its range."""
    factor = np.float64(2.0**stops)
    return lookup(image, lambda light: light * factor)


# The fault ``gamma``: a tone curve that lifts or drowns the shadows, steadily or swinging.


class Gamma(SeededStep):
    """Pixel values (0..1) to the power of ``gamma``: below 1 brightens the shadows, above 1 darkens them."""

    kind: ClassVar[str] = "gamma"

    gamma: float = option("The exponent.", default=1.0, ge=0.1, le=10)
    swing: float = option("How far its logarithm to base 2 swings.", unit="octaves", default=0.0, ge=0, le=3)
    period_s: float = option("Duration of one swing.", unit="s", default=4.0, ge=0.1, le=3600)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """The exponent 1 at any time."""
        return self.gamma == 1 and self.swing == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A curve on every image."""
        swing = Swing(float(np.log2(self.gamma)), self.swing, self.period_s, self.seed)

        def degrade(image: Array, message: Message) -> Array:
            return bend(image, 2.0 ** swing.at(message.stamp_ns))

        return Operation(transform=degrade)


def bend(image: Array, gamma: float) -> Array:
    """``image`` with each pixel value (0..1) to the power of ``gamma``."""
    return lookup(image, lambda light: np.power(light, gamma))


# The fault ``gaussian_noise``: the noise of the sensor's electronics.


class GaussianNoise(SeededStep):
    """White noise of the same strength everywhere in the image, new in every frame."""

    kind: ClassVar[str] = "gaussian_noise"

    sigma: float = option("Standard deviation on the scale 0 to 255.", unit="grey levels", ge=0, le=255)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No noise."""
        return self.sigma == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """Noise on every image."""
        return Operation(transform=self._degrade)

    def _degrade(self, image: Array, message: Message) -> Array:
        return add_gaussian_noise(image, self.sigma, message.random())


def add_gaussian_noise(image: Array, sigma: float, random: np.random.Generator) -> Array:
    """``image`` with noise of standard deviation ``sigma``, in grey levels of 255; clipped to the image's range."""
    strength = np.float32(sigma / FULL_SCALE_8BIT)

    def change(light: Array) -> Array:
        noisy: Array = light + strength * random.standard_normal(light.shape, dtype=np.float32)
        return noisy

    return change_light(image, change)


# The fault ``shot_noise``: too little light, counted photon by photon.


class ShotNoise(SeededStep):
    """Poisson noise: a pixel of brightness b (0..1) counts ``photons`` * b photons on average, drawn for every frame.

    Dark regions suffer most, relative to what they show (Foi et al., "Practical Poissonian-Gaussian noise modeling and
    fitting for single-image raw-data", 2008).
    """

    kind: ClassVar[str] = "shot_noise"

    photons: float = option("Photons that a white pixel counts; fewer are noisier.", unit="photons", ge=1, le=1e6)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """Noise on every image."""
        return Operation(transform=self._degrade)

    def _degrade(self, image: Array, message: Message) -> Array:
        return add_shot_noise(image, self.photons, message.random())


def add_shot_noise(image: Array, photons: float, random: np.random.Generator) -> Array:
    """``image`` as counted with ``photons`` for white; clipped to the image's range."""
    return change_light(image, lambda light: random.poisson(light * photons).astype(np.float32) / np.float32(photons))


# The fault ``defocus_blur``: a lens out of focus.


_OVERSAMPLING = 8


class DefocusBlur(Step):
    """Every image convolved with a disk, the circle of confusion."""

    kind: ClassVar[str] = "defocus_blur"

    radius_px: float = option("Radius of the disk that a point becomes.", unit="px", ge=0, le=100)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """In focus."""
        return self.radius_px == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A convolution of every image."""
        kernel = disk_kernel(self.radius_px)

        def degrade(image: Array, _message: Message) -> Array:
            blurred: Array = cv2.filter2D(image, -1, kernel)
            return blurred

        return Operation(transform=degrade)


def disk_kernel(radius_px: float) -> Array:
    """Weights (n, n), n odd, with sum 1: how much of each pixel the disk around the middle covers."""
    reach = math.ceil(radius_px - 0.5) if radius_px > 0.5 else 0
    size = 2 * reach + 1
    centres = (np.arange(size * _OVERSAMPLING) + 0.5) / _OVERSAMPLING - size / 2
    inside = centres[:, None] ** 2 + centres[None, :] ** 2 <= radius_px**2
    kernel = inside.reshape(size, _OVERSAMPLING, size, _OVERSAMPLING).sum(axis=(1, 3)).astype(np.float64)
    kernel[reach, reach] = max(kernel[reach, reach], 1.0)
    weights: Array = kernel / kernel.sum()
    return weights


# The fault ``motion_blur``: the camera moved while the shutter was open.


_SAMPLES_PER_PIXEL = 8


class MotionBlur(SeededStep):
    """Every image smeared along a straight line.

    Without ``angle_deg`` each frame has a direction of its own; cameras with the same seed share it, as those of one
    rig do.
    """

    kind: ClassVar[str] = "motion_blur"

    length_px: float = option("Length of the smear.", unit="px", ge=0, le=200)
    angle_deg: float | None = option(
        "Direction, 0 along the rows, 90 downwards; random for each frame if left out.",
        unit="deg",
        default=None,
        ge=-360,
        le=360,
    )

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No smear."""
        return self.length_px == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A convolution of every image."""
        return Operation(transform=self._degrade)

    def _degrade(self, image: Array, message: Message) -> Array:
        angle_deg = self.angle_deg
        if angle_deg is None:
            angle_deg = float(np.random.default_rng((self.seed, message.index)).uniform(0.0, 180.0))
        blurred: Array = cv2.filter2D(image, -1, line_kernel(self.length_px, angle_deg))
        return blurred


def line_kernel(length_px: float, angle_deg: float) -> Array:
    """Weights (n, n), n odd, of a straight smear through the middle; their sum is 1."""
    half = length_px / 2
    count = max(2, math.ceil(length_px * _SAMPLES_PER_PIXEL))
    along = (np.arange(count) + 0.5) / count * length_px - half
    angle_rad = math.radians(angle_deg)
    return splat(along * math.cos(angle_rad), along * math.sin(angle_rad), math.ceil(half))


def splat(x: Array, y: Array, radius: int) -> Array:
    """Points (n,) around the origin, each spread over its four pixels bilinearly, as weights with sum 1."""
    size = 2 * radius + 3
    kernel = np.zeros((size, size))
    columns, rows = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - columns, y - rows
    for dx, wx in ((0, 1 - fx), (1, fx)):
        for dy, wy in ((0, 1 - fy), (1, fy)):
            np.add.at(kernel, (rows + dy + radius + 1, columns + dx + radius + 1), wx * wy)
    weights: Array = kernel / kernel.sum()
    return weights


# The step ``depth_range``: a depth camera that sees less far, or not as near.


class DepthRange(Step):
    """Pixels outside two depths become 0, "no value"."""

    kind: ClassVar[str] = "depth_range"

    minimum_m: float = option("Nearer pixels have no value.", unit="m", default=0.0, ge=0, le=10_000)
    maximum_m: float | None = option("Farther pixels have no value.", unit="m", default=None, gt=0, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:
        """Depth images."""
        return sensor.kind is SensorKind.DEPTH

    def check(self, sensor: Sensor) -> None:
        """Refuse limits between which nothing lies."""
        if self.maximum_m is not None and self.maximum_m <= self.minimum_m:
            raise InvalidInput(
                f"step depth_range: nothing of {sensor.name} lies between {self.minimum_m:g} and {self.maximum_m:g} m",
                "maximum_m must be above minimum_m",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No limits."""
        return self.minimum_m == 0 and self.maximum_m is None

    def operation(self, stream: Stream) -> Operation:
        """A threshold on every image."""
        units_per_m = float(stream.sensor.calibration["units_per_m"])  # type: ignore[arg-type]
        lowest = self.minimum_m * units_per_m
        highest = np.inf if self.maximum_m is None else self.maximum_m * units_per_m

        def cut(depth: Array, _message: Message) -> Array:
            return np.where((depth >= lowest) & (depth <= highest), depth, np.zeros((), depth.dtype))

        return Operation(transform=cut)
