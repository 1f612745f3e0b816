"""Calibration after a resize: what is projected lands where the image shows it."""

from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.bags.variants.calibration import pixel_map, scale_camera_info, scale_sensor
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.domain.variant import VariantStep
from slamhive.errors import InvalidInput
from tests.bags.variant_bags import SIZE, START_NS, build, camera, dataset, image, info, on_topic, pixels_of, write_bag

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
