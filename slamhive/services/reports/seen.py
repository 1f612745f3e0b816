"""What the images and IMU messages of a run were like: the sensors of its dataset, as its variant leaves them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from slamhive.bags.variants.rules import RegisteredSteps
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import SensorKind
from slamhive.domain.variant import Variant
from slamhive.errors import SlamHiveError
from slamhive.schema.model import load
from slamhive.sweep.variants import seen_dataset

COLUMNS = ("image_width", "image_height", "image_rate_hz", "imu_rate_hz")
Seen = tuple[float | None, ...]
"""The values of :data:`COLUMNS`; None where the dataset has no such sensor or does not state the property."""
_UNKNOWN: Seen = (None,) * len(COLUMNS)


def seen_columns(
    names: Sequence[str], variants: Sequence[Any], datasets: Mapping[str, Dataset]
) -> dict[str, list[float | None]]:
    """The columns of :data:`COLUMNS`, for runs on datasets with these names and stored variants.

    They describe the first camera and the first IMU. Values are None for datasets that are not here any more.
    """

    @cache
    def seen(name: str, variant: str) -> Seen:
        dataset = datasets.get(name)
        if dataset is None:
            return _UNKNOWN
        try:
            return _values(seen_dataset(RegisteredSteps(), dataset, load(Variant, json.loads(variant))))
        except SlamHiveError:
            return _UNKNOWN  # the dataset was edited since, so that its old variants fit it no longer

    rows = [seen(name, json.dumps(variant or [])) for name, variant in zip(names, variants, strict=True)]
    return {column: [row[place] for row in rows] for place, column in enumerate(COLUMNS)}


def _values(dataset: Dataset) -> Seen:
    camera, imu = (next(iter(dataset.of_kind(kind)), None) for kind in (SensorKind.CAMERA, SensorKind.IMU))
    size = [None if camera is None else camera.calibration.get(key) for key in ("width", "height")]
    return (
        *(float(value) if isinstance(value, int | float) else None for value in size),
        None if camera is None else camera.rate_hz,
        None if imu is None else imu.rate_hz,
    )
