"""Recordings of hardly anything, and messages that make no sense: checks report or decline, they never break."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.checks.faulty_rooms import CAM0, DEPTH, IMU, LIDAR, Room, altered, on, turned_imu, with_points
from tests.checks.test_dataset_faults import room, shown

pytestmark = pytest.mark.integration

__all__ = ["room"]

Change = Callable[[Room], dict[str, Any]]


def few(count: int) -> Change:
    """The first ``count`` messages of every topic."""

    def change(room: Room) -> dict[str, Any]:
        left: dict[str, int] = {}
        kept = []
        for entry in room.messages:
            left[entry[0]] = left.get(entry[0], 0) + 1
            if left[entry[0]] <= count:
                kept.append(entry)
        return {"recording": kept}

    return change


def each(topic: str, change: Callable[[Any], Any]) -> Change:
    return lambda room: {"recording": on(room, topic, lambda _, t, m: [(t, change(m))])}


def replaced(**fields: Any) -> Callable[[Any], Any]:
    return lambda message: dataclasses.replace(message, **fields)


NOTHING = np.zeros(0, dtype=np.uint8)
UNTURNED = np.eye(3)

ODD: dict[str, Change] = {
    "one message each": few(1),
    "two messages each": few(2),
    "ten messages each": few(10),
    "images without pixels": each(CAM0, replaced(width=0, height=0, step=0, data=NOTHING)),
    "truncated images": each(CAM0, lambda m: dataclasses.replace(m, data=m.data[:100])),
    "an unknown encoding": each(CAM0, replaced(encoding="bayer_rggb8")),
    "depth images without pixels": each(DEPTH, replaced(width=0, height=0, step=0, data=NOTHING)),
    "sweeps without points": each(LIDAR, lambda m: with_points(m, lambda table: table[:0])),
    "sweeps of one point": each(LIDAR, lambda m: with_points(m, lambda table: table[:1])),
    "sweeps without fields": each(LIDAR, replaced(fields=[])),
    "sweeps that are cut off": each(LIDAR, lambda m: dataclasses.replace(m, data=m.data[:50])),
    "an IMU of NaN": each(IMU, lambda m: turned_imu(m, UNTURNED * np.nan, UNTURNED * np.nan)),
    "an IMU of zeros": each(IMU, lambda m: turned_imu(m, UNTURNED * 0, UNTURNED * 0)),
    "one pose": lambda room: {"truth": room.truth[:1]},
    "two poses": lambda room: {"truth": room.truth[:2]},
    "a pose of NaN": lambda room: {"truth": np.where(room.truth == room.truth[5, 0], np.nan, room.truth)},
    "poses of zeros": lambda room: {"truth": room.truth * 0},
    "poses at one place": lambda room: {"truth": room.truth * ([1] + [0] * 6 + [0]) + ([0] * 7 + [1])},
    "an unknown unit of times": lambda room: {"dataset": altered(room, "lidar0", calibration={"point_time_unit": "h"})},
}


@pytest.mark.parametrize("name", ODD)
def test_what_makes_no_sense_is_reported_or_declined(name: str, room: Room, tmp_path: Path):
    report = room.check(tmp_path, **ODD[name](room))
    assert report.findings or report.not_checked, name
    assert all(np.isfinite(finding.value or 0.0) for finding in report.findings), shown(report)
