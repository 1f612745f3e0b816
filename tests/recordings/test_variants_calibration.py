"""Calibration after a resize: what is projected lands where the image shows it."""

from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage, Input
from slamhive.domain.configuration import Configuration, VariantStep
from slamhive.domain.sensors import Sensor, SensorKind, SensorSetup
from slamhive.packages.run_config import build_run_config
from slamhive.recordings.variants.calibration import pixel_map, scale_camera_info, scale_sensor
from slamhive.recordings.variants.steps import RegisteredSteps
from tests.recordings.variant_bags import (
    SIZE,
    START_NS,
    build,
    camera,
    dataset,
    image,
    info,
    on_topic,
    pixels_of,
    stereo,
    write_bag,
)

pytestmark = pytest.mark.quick

SIZES = [(32, 24), (44, 33), (16, 12), (51, 38), (12, 9)]


def project(sensor: Sensor, points: Any) -> Any:
    c: Any = sensor.calibration
    return np.stack(
        [c["fx"] * points[:, 0] / points[:, 2] + c["cx"], c["fy"] * points[:, 1] / points[:, 2] + c["cy"]], axis=1
    )


@pytest.mark.parametrize("size", SIZES)
def test_a_point_lands_on_the_scaled_pixel(size):
    """Pixel edges are at halves: the image's corners stay its corners, so places in it scale from there."""
    points = np.random.default_rng(0).uniform([-2, -2, 1], [2, 2, 9], (50, 3))
    scale = np.array(size) / np.array(SIZE)
    expected = (project(camera(), points) + 0.5) * scale - 0.5
    np.testing.assert_allclose(project(scale_sensor(camera(), size), points), expected, atol=1e-9)


@pytest.mark.parametrize("size", [(32, 24), (16, 12)])
def test_the_convention_is_that_of_the_resize(size):
    """In an image whose values are its own coordinates, a new pixel shows the place that the map says it is at."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    A = np.linalg.inv(pixel_map(SIZE, size))
    for image_, axis in ((u, 0), (v, 1)):
        small = cv2.resize(image_, size, interpolation=cv2.INTER_AREA)
        new_u, new_v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        expected = A[axis, axis] * (new_u, new_v)[axis] + A[axis, 2]
        np.testing.assert_allclose(small, expected, atol=1e-4)


def test_what_is_no_size_or_intrinsic_is_kept():
    scaled = scale_sensor(camera(distortion=(0.1, 0.2, 0.0, 0.0), rectified=False, encoding="bgr8"), (32, 24))
    assert scaled.calibration["distortion"] == (0.1, 0.2, 0.0, 0.0)
    assert scaled.calibration["rectified"] is False
    assert scaled.calibration["encoding"] == "bgr8"


@pytest.mark.parametrize("size", SIZES)
def test_camera_info_projects_as_the_sensor_does(size):
    sensor = scale_sensor(camera(), size)
    before = info(camera(), START_NS)
    after = scale_camera_info(before, size, "/cam0/camera_info")
    points = np.random.default_rng(0).uniform([-2, -2, 1], [2, 2, 9], (50, 3))
    homogeneous = points @ after.K.reshape(3, 3).T
    np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], project(sensor, points), atol=1e-9)
    assert (after.width, after.height) == size
    np.testing.assert_array_equal(after.D, before.D)
    np.testing.assert_array_equal(after.R, before.R)
    baseline_before, baseline_after = (-content.P[3] / content.P[0] for content in (before, after))
    assert baseline_after == pytest.approx(baseline_before)


def test_binned_images_are_refused():
    with pytest.raises(InvalidInput, match="binned or cropped"):
        scale_camera_info(info(camera(), START_NS, binning_x=2), (32, 24), "/cam0/camera_info")


def test_camera_info_in_the_bag_follows_its_images(tmp_path):
    entries = []
    for frame in range(4):
        stamp_ns = START_NS + frame * 50_000_000
        entries += [
            ("/cam0/camera_info", stamp_ns, info(camera(), stamp_ns)),
            ("/cam0/image_raw", stamp_ns, image(pixels_of(frame), stamp_ns)),
        ]
    write_bag(tmp_path / "d.bag", entries)
    steps = (VariantStep("rate", ("cam0",), {"every": 2}), VariantStep("resolution", ("cam0",), {"scale": 0.35}))
    made = build(dataset(tmp_path, (camera(),)), tmp_path / "v", *steps)
    infos = [entry.message for entry in on_topic(made.bag_path, "/cam0/camera_info")]
    c: Any = made.sensor("cam0").calibration
    assert len(infos) == 2
    for content in infos:
        assert (content.width, content.height) == (c["width"], c["height"]) == (22, 16)
        np.testing.assert_allclose(content.K, [c["fx"], 0, c["cx"], 0, c["fy"], c["cy"], 0, 0, 1])
        assert c["fx"] / 50.0 == pytest.approx(22 / 64)
        assert c["fy"] / 51.0 == pytest.approx(16 / 48)


def test_depth_takes_the_nearest_pixel_and_goes_with_its_camera(tmp_path):
    near_far = np.where(np.arange(SIZE[0]) < 31, 1000, 5000).astype(np.uint16)[None, :].repeat(SIZE[1], 0)
    depth = Sensor(
        "depth0",
        SensorKind.DEPTH,
        "/depth0/image_raw",
        20.0,
        calibration={**camera().calibration, "encoding": "16UC1", "units_per_m": 1000, "registered_to": "cam0"},
    )
    entries = [
        ("/depth0/image_raw", START_NS, image(near_far, START_NS, "16UC1")),
        ("/cam0/image_raw", START_NS, image(pixels_of(0), START_NS)),
    ]
    write_bag(tmp_path / "d.bag", entries)
    source = dataset(tmp_path, (camera(), depth))
    made = build(source, tmp_path / "v", VariantStep("resolution", ("cam0", "depth0"), {"scale": 0.5}))
    (entry,) = on_topic(made.bag_path, "/depth0/image_raw")
    assert set(entry.message.data.view(np.uint16).tolist()) == {1000, 5000}
    with pytest.raises(InvalidInput, match="give both the same resolution"):
        build(source, tmp_path / "w", VariantStep("resolution", ("depth0",), {"scale": 0.5}))


STATED = {"fx": 26.0, "fy": 24.5, "cx": 15.0, "cy": 11.25}
HALF_AND_STATED = (
    VariantStep("resolution", ("cam0",), {"scale": 0.5}),
    VariantStep("calibration", ("cam0",), STATED),
)


def stereo_dataset(folder):
    write_bag(folder / "d.bag", stereo(frames=2))
    return dataset(folder)


def test_stated_intrinsics_override_those_that_follow_from_the_resize(tmp_path):
    made = build(stereo_dataset(tmp_path), tmp_path / "v", *HALF_AND_STATED)
    c: Any = made.sensor("cam0").calibration
    assert {key: c[key] for key in STATED} == STATED
    assert (c["width"], c["height"]) == (SIZE[0] // 2, SIZE[1] // 2)
    for entry in on_topic(made.bag_path, "/cam0/camera_info"):
        content = entry.message
        assert (content.width, content.height) == (c["width"], c["height"])
        np.testing.assert_allclose(content.K, [26.0, 0, 15.0, 0, 24.5, 11.25, 0, 0, 1], atol=1e-12)
        assert -content.P[3] / content.P[0] == pytest.approx(5.5 / 50.0), "the baseline stays"
    assert made.sensor("cam1") == camera("cam1")


def test_the_settings_of_the_algorithm_get_the_stated_intrinsics(tmp_path):
    source = stereo_dataset(tmp_path)
    made = build(source, tmp_path / "v", *HALF_AND_STATED)
    package = AlgorithmPackage("p", tmp_path, "p", "1", "", "", "")
    inputs = (Input("left", SensorKind.CAMERA), Input("right", SensorKind.CAMERA))
    algorithm = Algorithm("a", package, "m", "a", SensorSetup.STEREO, inputs, "left", ())
    configuration = Configuration("a", "d", {}, variant=HALF_AND_STATED)
    settings = build_run_config(algorithm, made, configuration, 1, 0, source).dataset_parameters
    assert {key: settings[f"left_{key}"] for key in STATED} == STATED
    assert settings["left_width"] == SIZE[0] // 2
    assert settings["right_fx"] == 50.0


def test_without_a_resize_the_images_are_copied_and_only_the_calibration_changes(tmp_path):
    source = stereo_dataset(tmp_path)
    made = build(source, tmp_path / "v", VariantStep("calibration", ("cam0",), {"fx": 40.0}))
    before, after = (on_topic(path, "/cam0/image_raw") for path in (source.bag_path, made.bag_path))
    assert [entry.raw for entry in before] == [entry.raw for entry in after]
    (first, _) = on_topic(made.bag_path, "/cam0/camera_info")
    np.testing.assert_allclose(first.message.K, [40.0, 0, 31.25, 0, 51.0, 22.5, 0, 0, 1], atol=1e-12)
    assert [e.raw for e in on_topic(made.bag_path, "/cam1/camera_info")] == [
        e.raw for e in on_topic(source.bag_path, "/cam1/camera_info")
    ]


def test_two_resizes_in_a_row_leave_camera_info_to_the_resize_alone(tmp_path):
    """What is equal but for rounding is not stated by hand: the bytes stay those of the resize."""
    half = VariantStep("resolution", ("cam0",), {"scale": 0.5})
    made = build(stereo_dataset(tmp_path), tmp_path / "v", half, half)
    expected = scale_camera_info(info(camera(), START_NS), (16, 12), "/cam0/camera_info")
    (first, _) = on_topic(made.bag_path, "/cam0/camera_info")
    np.testing.assert_array_equal(first.message.K, expected.K)


def test_a_calibration_that_states_nothing_or_nothing_new():
    rules = RegisteredSteps()
    assert rules.resolve("calibration", {"fx": 50.0, "cy": 22.5}, camera()) == (None, camera())
    for options, words in (
        ({}, "give at least one of fx, fy, cx, cy"),
        ({"fx": 0.0}, "greater than 0"),
        ({"cx": "middle"}, "must be a number"),
        ({"fz": 1.0}, "unknown key 'fz'"),
    ):
        with pytest.raises(InvalidInput, match=words):
            rules.resolve("calibration", options, camera())
    lidar = Sensor("l", SensorKind.LIDAR, "/l", 10.0)
    with pytest.raises(InvalidInput, match="cannot be used on l"):
        rules.resolve("calibration", {"fx": 1.0}, lidar)
