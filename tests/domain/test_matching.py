"""What parameters take from sensors: values, their order of precedence, and what is said where one is missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage, Input, Requirement
from slamhive.domain.calibration import CameraModel
from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import Origin, check_known, match_of
from slamhive.domain.parameters import Parameter, ParameterType, SensorProperty, check_stored, parse_settings
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind, SensorSetup
from slamhive.packages.run_config import build_run_config

CAMERA, IMU, LIDAR = SensorKind.CAMERA, SensorKind.IMU, SensorKind.LIDAR
FLOAT, INT, MATRIX, STRING = ParameterType.FLOAT, ParameterType.INT, ParameterType.MATRIX, ParameterType.STRING

KITTI_06: dict[str, CalibrationValue] = {
    "width": 1226,
    "height": 370,
    "fx": 707.0912,
    "fy": 707.0912,
    "cx": 601.8873,
    "cy": 183.1104,
    "rectified": True,
}
KITTI_06_BASELINE_M = 379.8145 / 707.0912
"""P1 of ``calib.txt``: -379.8145 is the product of fx and the baseline."""

LEFT = Sensor("cam0", CAMERA, "/cam0/image_raw", 9.622798, calibration=KITTI_06)
RIGHT = replace(
    LEFT, name="cam1", T_body_sensor=(1.0, 0, 0, KITTI_06_BASELINE_M, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0)
)
TURNED = (0.0, -1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 1.0)
"""A quarter turn around z, then 1, 2, 3 m."""
SCANNER = Sensor(
    "lidar0",
    LIDAR,
    "/points",
    10.0,
    calibration={"beams": 4, "vertical_angles_deg": (-15.0, -5.0, 5.0, 15.0), "rotation": "clockwise"},
)
SENSORS = {"left": LEFT, "right": RIGHT, "points": SCANNER, "imu": Sensor("imu0", IMU, "/imu", 200.0, TURNED)}


def value(text: str, **changed: Sensor) -> Any:
    return SensorProperty.parse(text).value({**SENSORS, **changed})


def parameter(key: str, source: str, kind: ParameterType = FLOAT, default: Any = None, **more: Any) -> Parameter:
    return Parameter(key, kind, default, "", source=SensorProperty.parse(source), **more)


def stereo(*parameters: Parameter) -> Algorithm:
    package = AlgorithmPackage("eye", Path("eye"), "Eye", "1", "", "", "")
    inputs = (Input("left", CAMERA), Input("right", CAMERA))
    return Algorithm("eye", package, "stereo", "Eye", SensorSetup.STEREO, inputs, "left", parameters)


def kitti(*sensors: Sensor) -> Dataset:
    return Dataset("kitti_06", Path("k"), "k.bag", 5.2, sensors or (LEFT, RIGHT), None, "sha256:" + "0" * 64)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("left.fx", 707.0912),
        ("left.width", 1226),
        ("left.rate_hz", 9.622798),
        ("left.topic", "/cam0/image_raw"),
        ("right.name", "cam1"),
        ("left.camera_matrix", (707.0912, 0.0, 601.8873, 0.0, 707.0912, 183.1104, 0.0, 0.0, 1.0)),
        ("left.distortion", ()),
        ("left.k1", 0.0),
        ("left.p2", 0.0),
        ("left.bf(right)", pytest.approx(379.8145)),
        ("left.baseline_m(right)", pytest.approx(0.537151)),
        ("imu.T_body_sensor", TURNED),
        # The inverse of a quarter turn around z: a point at the origin of the body lies at -2, 1, -3 m.
        ("imu.T(left)", pytest.approx((0, 1, 0, -2, -1, 0, 0, 1, 0, 0, 1, -3, 0, 0, 0, 1))),
        ("left.T(imu)", pytest.approx(TURNED)),
        ("points.beams", 4),
        ("points.lowest_angle_deg", -15.0),
        ("points.highest_angle_deg", 15.0),
        ("points.ring_distance_deg", 10.0),
        ("points.rotation", "clockwise"),
        ("points.scan_duration_s", 0.1),
        ("points.point_time_unit", "s"),
        ("points.point_time_field", None),
        ("imu.gyroscope_noise_density", None),
        ("left.units_per_m", None),
        ("imu.camera_matrix", None),
    ],
)
def test_properties_of_sensors(text: str, expected: Any) -> None:
    assert value(text) == expected


def test_distortion_coefficients_go_by_the_names_of_their_model() -> None:
    radial = replace(LEFT, calibration={**KITTI_06, "distortion": (-0.28, 0.07, 0.0002, 1.8e-5)})
    fisheye = replace(
        LEFT,
        calibration={**KITTI_06, "model": CameraModel.FISHEYE_KB.value, "distortion": (0.1, 0.2, 0.3, 0.4)},
    )
    assert [value(f"left.{name}", left=radial) for name in ("k1", "k2", "p1", "p2", "k3")] == [
        *(-0.28, 0.07, 0.0002, 1.8e-5),
        0.0,
    ]
    assert [value(f"left.{name}", left=fisheye) for name in ("k3", "k4", "p1")] == [0.3, 0.4, None]


@pytest.mark.parametrize("text", ["fx", "left.", "left.fx(right)", "left.bf", "left.T()", "left fx", "left.T(a.b)", ""])
def test_what_names_no_property_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match=r"propert(y|ies)"):
        SensorProperty.parse(text)


def test_the_sensor_wins_over_the_default_and_the_user_over_the_sensor() -> None:
    eye = stereo(parameter("fx", "left.fx", default=458.654), parameter("fps", "left.rate_hz", INT, default=20))
    match = match_of(eye, kitti(), {})
    assert match.values({}) == {"fx": 707.0912, "fps": 10}
    assert [entry.origin for entry in match.bound] == [Origin.SENSOR, Origin.SENSOR]
    assert match.bound[0].words == "from cam0 (left.fx)"
    (overridden, _) = match_of(eye, kitti(), {"fx": 500.0}).bound
    assert (overridden.value, overridden.origin, overridden.found) == (500.0, Origin.USER, 707.0912)
    assert overridden.words == "overridden: cam0 has 707.0912"


def test_a_default_stands_in_for_what_the_dataset_lacks_and_says_so() -> None:
    eye = stereo(parameter("td", "left.time_offset_s", default=0.0))
    (entry,) = match_of(eye, kitti(), {}).bound
    assert (entry.value, entry.origin) == (0.0, Origin.DEFAULT)
    assert entry.words == "default of the package: cam0 has no time_offset_s"


def test_a_value_that_nobody_knows_is_refused_with_the_key() -> None:
    eye = stereo(parameter("td", "left.time_offset_s"))
    with pytest.raises(InvalidInput) as caught:
        check_known(eye, kitti(), eye.assign(kitti()), ())
    assert caught.value.message == (
        "eye takes td from left.time_offset_s, but cam0 of dataset kitti_06 has no time_offset_s"
    )
    assert caught.value.remedy == "add time_offset_s to the calibration of cam0 in dataset.yaml, or set td"
    check_known(eye, kitti(), eye.assign(kitti()), ("td",))


def test_a_value_outside_the_range_names_the_sensor() -> None:
    eye = stereo(parameter("fx", "left.fx", maximum=600))
    with pytest.raises(InvalidInput, match=r"cam0 of dataset kitti_06: parameter fx=707.0912 is not allowed"):
        match_of(eye, kitti(), {})
    assert match_of(stereo(parameter("K", "left.camera_matrix", MATRIX)), kitti(), {}).bound[0].value != ()


def test_configurations_hold_only_what_the_user_set() -> None:
    eye = stereo(parameter("fx", "left.fx", default=458.654), Parameter("features", INT, 1000, ""))
    assert parse_settings("eye", eye.parameters, {}) == {"features": 1000}
    assert parse_settings("eye", eye.parameters, {"fx": ""}) == {"features": 1000}
    assert parse_settings("eye", eye.parameters, {"fx": "500"}) == {"fx": 500.0, "features": 1000}
    check_stored("eye", eye.parameters, {"features": 1000})


def test_the_configuration_of_a_run_has_every_value() -> None:
    eye = stereo(parameter("fx", "left.fx", general="focal_length"), Parameter("features", INT, 1000, ""))
    configuration = Configuration("eye", "kitti_06", {"features": 500})
    half = {**KITTI_06, "width": 613, "fx": 353.5456}
    seen = kitti(replace(LEFT, calibration=half), replace(RIGHT, calibration=half))
    config = build_run_config(eye, seen, configuration, 1, 0, kitti())
    assert config.algorithm_parameters == {"features": 500, "fx": 353.5456}
    assert config.general_parameter["focal_length"] == 353.5456


ONE_OF_THEM = "choose another for one of them"
CAMERAS = [replace(LEFT, name=f"cam{place}", topic=f"/cam{place}") for place in range(4)]


@pytest.mark.parametrize(
    ("chosen", "assigned", "stated"),
    [
        ({}, ["cam0", "cam1"], {}),
        ({"left": "cam0"}, ["cam0", "cam1"], {}),
        ({"left": "cam2"}, ["cam2", "cam3"], {"left": "cam2", "right": "cam3"}),
        ({"left": "cam3"}, ["cam3", "cam0"], {"left": "cam3", "right": "cam0"}),
        ({"right": "cam0"}, ["cam1", "cam0"], {"left": "cam1", "right": "cam0"}),
        ({"right": "cam2"}, ["cam0", "cam2"], {"left": "cam0", "right": "cam2"}),
    ],
)
def test_choosing_among_several_sensors(chosen: dict[str, str], assigned: list[str], stated: dict[str, str]) -> None:
    eye, dataset = stereo(), kitti(*CAMERAS)
    assert [sensor.name for sensor in eye.assign(dataset, chosen).values()] == assigned
    assert eye.stated_choice(dataset, chosen) == stated
    assert eye.stated_choice(dataset, stated) == stated
    assert eye.assign(dataset, stated) == eye.assign(dataset, chosen)


@pytest.mark.parametrize(
    ("chosen", "message", "remedy"),
    [
        (
            {"left": "imu0"},
            "'imu0' is no sensor of dataset kitti_06 that fits left of eye",
            "use cam0, cam1, cam2, cam3",
        ),
        ({"lefd": "cam0"}, "eye has no role 'lefd'; did you mean 'left'?", ""),
        (
            {"left": "cam1", "right": "cam1"},
            "sensor cam1 is chosen for two roles of eye",
            "choose another for one of them",
        ),
    ],
)
def test_a_choice_that_makes_no_sense_is_refused(chosen: dict[str, str], message: str, remedy: str) -> None:
    with pytest.raises(SlamHiveError) as caught:
        stereo().assign(kitti(*CAMERAS), chosen)
    assert (caught.value.message, caught.value.remedy or "") == (message, remedy)


def test_the_choice_is_part_of_the_identity_only_if_the_rule_says_otherwise() -> None:
    plain = Configuration("eye", "kitti_06", {})
    assert plain.content_hash == "bbf3b6cc2e95d84df40eca182ddfdc747c3a9085d6220b5c7029595dbb43d741"
    assert replace(plain, sensors={"left": "cam2"}).content_hash != plain.content_hash


def required(*entries: tuple[str, tuple[str, ...]]) -> Algorithm:
    requires = tuple(Requirement(SensorProperty.parse(text), allowed) for text, allowed in entries)
    return replace(stereo(), requires=requires)


def test_what_a_package_has_to_know_is_said_with_the_key() -> None:
    eye = required(("left.exposure_s", ()), ("left.gamma", ()), ("right.fx", ()))
    with pytest.raises(InvalidInput) as caught:
        eye.assign(kitti())
    assert caught.value.message == (
        "eye needs exposure_s, gamma of its left; cam0 of dataset kitti_06 does not state them"
    )
    assert caught.value.remedy == "add exposure_s, gamma to the calibration of cam0 in dataset.yaml"


def test_a_sensor_that_has_what_is_needed_goes_first() -> None:
    known = replace(CAMERAS[2], calibration={**KITTI_06, "exposure_s": 0.01})
    eye, dataset = required(("left.exposure_s", ())), kitti(*CAMERAS[:2], known, CAMERAS[3])
    assert [sensor.name for sensor in eye.fitting(dataset)["left"]] == ["cam2"]
    assert eye.assign(dataset)["left"].name == "cam2"


def test_a_lens_that_a_package_has_no_model_for_is_refused() -> None:
    eye = required(("left.model", ("pinhole", "pinhole-radtan")))
    fisheye = replace(LEFT, calibration={**KITTI_06, "model": "fisheye-kb", "distortion": (0.1, 0.2, 0.3, 0.4)})
    assert eye.assign(kitti())["left"].name == "cam0"
    with pytest.raises(InvalidInput, match=r"needs left\.model to be pinhole or pinhole-radtan; it is fisheye-kb"):
        eye.assign(kitti(fisheye, replace(fisheye, name="cam1")))
