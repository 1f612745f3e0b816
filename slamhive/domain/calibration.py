"""Typed views of a sensor's calibration, which ``dataset.yaml`` holds as plain keys.

:attr:`~slamhive.domain.sensors.Sensor.calibration` keeps keys that only some packages know. What several parts of SLAM
Hive need has a name and a type here.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import CalibrationValue, Sensor
from slamhive.runtime.point_times import PointTimes, choice


class CameraModel(StrEnum):
    """Projection of a point in the camera's frame to a pixel.

    ``PINHOLE`` is the pinhole camera with radial-tangential distortion if there are coefficients: the files of earlier
    versions use it for both. ``FISHEYE_KB`` is the model of Kannala and Brandt, which ROS and Kalibr call equidistant.
    """

    PINHOLE = "pinhole"
    PINHOLE_RADTAN = "pinhole-radtan"
    PINHOLE_EQUIDISTANT = "pinhole-equidistant"
    FISHEYE_KB = "fisheye-kb"
    DOUBLE_SPHERE = "double-sphere"


COEFFICIENTS: dict[CameraModel, tuple[int, ...]] = {
    CameraModel.PINHOLE: (0, 4, 5, 8),
    CameraModel.PINHOLE_RADTAN: (4, 5, 8),
    CameraModel.PINHOLE_EQUIDISTANT: (4,),
    CameraModel.FISHEYE_KB: (4,),
    CameraModel.DOUBLE_SPHERE: (2,),
}
"""How many numbers ``distortion`` holds: k1 k2 p1 p2 (k3 (k4 k5 k6)); k1 k2 k3 k4; xi and alpha."""

TIME_OFFSET = "time_offset_s"
"""The key of a camera for the seconds that its timestamps need added, to be on the clock of the IMU."""

_NAMES = {
    CameraModel.PINHOLE_EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    CameraModel.FISHEYE_KB: ("k1", "k2", "k3", "k4"),
    CameraModel.DOUBLE_SPHERE: ("xi", "alpha"),
}

_ROS_MODELS = {
    CameraModel.PINHOLE: "plumb_bob",
    CameraModel.PINHOLE_RADTAN: "plumb_bob",
    CameraModel.PINHOLE_EQUIDISTANT: "equidistant",
    CameraModel.FISHEYE_KB: "equidistant",
    CameraModel.DOUBLE_SPHERE: "double_sphere",
}
_RATIONAL_COEFFICIENTS = 8


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """The intrinsics of a camera or depth camera, in pixels.

    Attributes:
        width: Columns of an image.
        height: Rows of an image.
        fx: Focal length, horizontally.
        fy: Focal length, vertically.
        cx: Column of the principal point; the centre of the first pixel is 0.
        cy: Row of the principal point.
        model: How points become pixels.
        distortion: The coefficients of the model, see :data:`COEFFICIENTS`.
        rectified: Images are undistorted, and rows of a stereo pair match.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: CameraModel = CameraModel.PINHOLE
    distortion: tuple[float, ...] = ()
    rectified: bool = False

    @classmethod
    def of(cls, sensor: Sensor) -> CameraIntrinsics:
        """The intrinsics of ``sensor``; raises InvalidInput naming what is missing or makes no sense."""
        values = sensor.calibration
        try:
            fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))  # type: ignore[arg-type]
            width, height = int(values["width"]), int(values["height"])  # type: ignore[arg-type]
        except KeyError as error:
            raise InvalidInput(f"sensor {sensor.name} lacks calibration {error.args[0]}") from None
        model = camera_model(values, f"sensor {sensor.name}")
        rectified = bool(values.get("rectified", False))
        return cls(width, height, fx, fy, cx, cy, model, distortion_of(values), rectified)

    @property
    def ros_model(self) -> str:
        """``distortion_model`` of a ``sensor_msgs/CameraInfo``."""
        if len(self.distortion) == _RATIONAL_COEFFICIENTS:
            return "rational_polynomial"
        return _ROS_MODELS[self.model]

    def calibration(self, encoding: str, **more: CalibrationValue) -> dict[str, CalibrationValue]:
        """The keys of ``dataset.yaml``; ``more`` follows them."""
        return {
            "width": self.width,
            "height": self.height,
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "encoding": encoding,
            "model": self.model.value,
            "distortion": self.distortion,
            "rectified": self.rectified,
            **more,
        }


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of an IMU in continuous time; None is unknown.

    Attributes:
        gyroscope_noise_density: White noise in rad/s/√Hz.
        accelerometer_noise_density: White noise in m/s²/√Hz.
        gyroscope_random_walk: Drift of the bias in rad/s²/√Hz.
        accelerometer_random_walk: Drift of the bias in m/s³/√Hz.
    """

    gyroscope_noise_density: float | None = None
    accelerometer_noise_density: float | None = None
    gyroscope_random_walk: float | None = None
    accelerometer_random_walk: float | None = None

    @classmethod
    def of(cls, sensor: Sensor) -> ImuNoise:
        """Known noise parameters of ``sensor``."""
        known = {key: sensor.calibration.get(key) for key in cls.__slots__}
        return cls(**{key: None if value is None else float(value) for key, value in known.items()})  # type: ignore[arg-type]

    def calibration(self) -> dict[str, CalibrationValue]:
        """The keys of ``dataset.yaml``, without those that are unknown."""
        return {key: value for key in self.__slots__ if (value := getattr(self, key)) is not None}


@dataclass(frozen=True, slots=True)
class LaserLayout:
    """The geometry of a laser scanner that measures in one plane, counter-clockwise around its z axis.

    Attributes:
        angle_min_rad: The direction of the first range; 0 is the sensor's x axis.
        angle_increment_rad: From one range to the next.
        minimum_range_m: Nearer ranges mean "nothing".
        maximum_range_m: Further ranges mean "nothing".
        scan_duration_s: From the first range to the last; 0 if it is not known.
    """

    angle_min_rad: float
    angle_increment_rad: float
    minimum_range_m: float
    maximum_range_m: float
    scan_duration_s: float = 0.0

    @classmethod
    def of(cls, sensor: Sensor) -> LaserLayout:
        """The geometry of ``sensor``; raises InvalidInput naming what is missing or no number."""
        found = {key: number_of(sensor.calibration, key, f"sensor {sensor.name}") for key in cls.__slots__}
        known = {key: float(value) for key, value in found.items() if value is not None}
        missing = [key for key in cls.__slots__ if key not in known and key != "scan_duration_s"]
        if missing:
            raise InvalidInput(f"sensor {sensor.name} lacks calibration {', '.join(missing)}")
        return cls(**known)

    def calibration(self) -> dict[str, CalibrationValue]:
        """The keys of ``dataset.yaml``."""
        return {key: getattr(self, key) for key in self.__slots__}


def camera_model(values: dict[str, CalibrationValue], owner: str) -> CameraModel:
    """The model that a calibration names; raises InvalidInput if the coefficients do not fit it."""
    name = values.get("model", CameraModel.PINHOLE.value)
    try:
        model = CameraModel(str(name))
    except ValueError:
        raise InvalidInput(
            f"{owner}: camera model {name!r} is unknown", f"use one of {', '.join(CameraModel)}"
        ) from None
    count = len(distortion_of(values))
    if count not in COEFFICIENTS[model]:
        allowed = " or ".join(str(number) for number in COEFFICIENTS[model])
        raise InvalidInput(f"{owner}: model {model.value} takes {allowed} distortion coefficients, not {count}")
    return model


def distortion_names(model: CameraModel) -> tuple[str, ...]:
    """Names of the coefficients of a model, in the order of ``distortion``."""
    return _NAMES.get(model, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))


def distortion_of(values: dict[str, CalibrationValue]) -> tuple[float, ...]:
    """The distortion coefficients of a calibration."""
    found = values.get("distortion", ())
    return tuple(float(number) for number in found) if isinstance(found, tuple | list) else ()


def number_of(values: dict[str, CalibrationValue], key: str, owner: str) -> float | None:
    """The number under ``key``, None if there is none; raises InvalidInput naming ``owner`` for anything else."""
    value = values.get(key)
    if value is None or isinstance(value, int | float):
        return value
    raise InvalidInput(f"{owner}: {key} {value!r} is no number")


# The typed view of a LiDAR's calibration: what it measures, and how its points lie in a message.


class PointOrder(StrEnum):
    """Order of the points in a scan."""

    COLUMNS = "columns"
    """All rings at one azimuth, then the next azimuth: nearly in the order of time."""
    ROWS = "rows"
    """One ring after the other."""
    UNKNOWN = ""


class Rotation(StrEnum):
    """The direction in which a LiDAR turns, seen from above."""

    CLOCKWISE = "clockwise"
    COUNTER_CLOCKWISE = "counter-clockwise"
    UNKNOWN = ""


@dataclass(frozen=True, slots=True)
class LidarLayout:
    """Measurements of a LiDAR, and the layout of its points in ``PointCloud2``.

    Attributes:
        times: Where the time of a point is, what it counts from, and what the message's timestamp means.
        ring_field: The field with the number of the ring (beam); empty if there is none.
        point_order: How points follow each other.
        organised: The scan is an image of ranges, one row for each ring; points without return are NaN or 0.
        beams: The number of rings.
        minimum_range_m: The nearest distance that is measured.
        maximum_range_m: The furthest distance that is measured.
        vertical_angles_deg: The elevation of each ring, in the order of their numbers; empty if it is not known.
        points_per_ring: How many points one turn gives, those without return included.
        rotation: The direction in which it turns.
    """

    times: PointTimes
    ring_field: str = ""
    point_order: PointOrder = PointOrder.UNKNOWN
    organised: bool = False
    beams: int | None = None
    minimum_range_m: float | None = None
    maximum_range_m: float | None = None
    vertical_angles_deg: tuple[float, ...] = ()
    points_per_ring: int | None = None
    rotation: Rotation = Rotation.UNKNOWN

    @classmethod
    def of(cls, sensor: Sensor) -> LidarLayout:
        """The layout of ``sensor``; raises InvalidInput naming what makes no sense."""
        values, owner = sensor.calibration, f"sensor {sensor.name}"
        angles_deg = values.get("vertical_angles_deg", ())
        if not isinstance(angles_deg, tuple | list):
            raise InvalidInput(f"{owner}: vertical_angles_deg {angles_deg!r} is no list", "give the angle of each ring")
        beams = _whole(values, "beams", owner)
        if angles_deg and beams is not None and len(angles_deg) != beams:
            found = f"{len(angles_deg)} vertical angles for {beams} beams"
            raise InvalidInput(f"{owner}: {found}", "give one for each ring")
        return cls(
            PointTimes.of(values, sensor.rate_hz, owner),
            str(values.get("ring_field", "")),
            choice(PointOrder, values, "point_order", PointOrder.UNKNOWN, owner),
            bool(values.get("organised", False)),
            beams,
            number_of(values, "minimum_range_m", owner),
            number_of(values, "maximum_range_m", owner),
            tuple(float(angle) for angle in angles_deg),
            _whole(values, "points_per_ring", owner),
            choice(Rotation, values, "rotation", Rotation.UNKNOWN, owner),
        )

    def calibration(self, **more: CalibrationValue) -> dict[str, CalibrationValue]:
        """The keys of ``dataset.yaml``, without those that are unknown; ``more`` follows them."""
        optional = ("beams", "vertical_angles_deg", "points_per_ring", "rotation", "minimum_range_m", "maximum_range_m")
        known = {key: getattr(self, key) for key in optional}
        return {
            **{key: value for key, value in known.items() if value not in (None, (), "")},
            "point_time_field": self.times.field,
            "point_time_unit": self.times.unit.value,
            "point_time_reference": self.times.reference.value,
            "stamp": self.times.stamp.value,
            "scan_duration_s": self.times.scan_duration_s,
            "ring_field": self.ring_field,
            "point_order": self.point_order.value,
            "organised": self.organised,
            **more,
        }


def _whole(values: dict[str, CalibrationValue], key: str, owner: str) -> int | None:
    number = number_of(values, key, owner)
    return None if number is None else int(number)
