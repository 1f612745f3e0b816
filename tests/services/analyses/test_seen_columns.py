"""Analyses know the size and rate of the images that a run saw."""

from __future__ import annotations

import pytest

from slamhive.documents.model import dump
from slamhive.domain.configuration import Variant, VariantStep
from slamhive.experiments.binding import resolve_variant
from slamhive.recordings.variants.steps import RegisteredSteps
from slamhive.services.analysis.table import seen_columns
from tests.experiments.sweep_world import CAMERA, IMU, LIDAR, dataset

pytestmark = pytest.mark.quick

EUROC = dataset("euroc", ("cam0", CAMERA, 20), ("cam1", CAMERA, 20), ("imu0", IMU, 200))
STREET = dataset("street", ("lidar0", LIDAR, 10))
STEPS = (
    VariantStep("resolution", ("cam0", "cam1"), {"scale": 0.4}),
    VariantStep("rate", ("cam0", "cam1"), {"every": 4}),
    VariantStep("rate", ("imu0",), {"hz": 50.0}),
)


def test_columns_say_what_the_variant_leaves():
    variant = dump(Variant, resolve_variant(RegisteredSteps(), EUROC, STEPS))
    found = seen_columns(
        ["euroc", "euroc", "street", "gone"],
        [variant, None, None, variant],
        {"euroc": EUROC, "street": STREET},
    )
    assert found == {
        "image_width": [256.0, 640.0, None, None],
        "image_height": [192.0, 480.0, None, None],
        "image_rate_hz": [5.0, 20, None, None],
        "imu_rate_hz": [50.0, 200, None, None],
    }


def test_a_variant_that_fits_its_dataset_no_longer_is_unknown():
    variant = dump(Variant, resolve_variant(RegisteredSteps(), EUROC, STEPS))
    assert seen_columns(["euroc"], [variant], {"euroc": STREET})["image_width"] == [None]
