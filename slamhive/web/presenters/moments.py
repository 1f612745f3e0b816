"""A moment of a run: what is known of it in words, and where the images and sweeps of that moment are."""

from __future__ import annotations

import math
from typing import Any

from flask import url_for

from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import SlamHiveError
from slamhive.services.hive import Hive
from slamhive.services.runs import FrameFate, Moment
from slamhive.store import RunRecord
from slamhive.web.formatting import significant
from slamhive.web.presenters.matching import match_of_run

_IMAGES = frozenset({SensorKind.CAMERA, SensorKind.DEPTH})


def words(moment: Moment) -> str:
    """The error and the fate of the frame, as a sentence each."""
    error = "No matched pose is near"
    if moment.error_m is not None:
        error = f"The position error is {significant(moment.error_m, 3)} m"
    return f"{error}. {_fate(moment.frame)}."


def _fate(frame: FrameFate | None) -> str:
    if frame is None:
        return "The algorithm reported no frame near this time"
    if frame.dropped:
        return "This frame was dropped"
    if frame.latency_s is None:
        return "This frame gave no result"
    return f"The frame took {significant(1e3 * frame.latency_s, 3)} ms"


def sensor_views(services: Hive, run: RunRecord, timestamp_s: float) -> list[dict[str, Any]]:
    """For each camera and LiDAR of the run: its name, and the address of its frame or sweep, or why there is none.

    They show the recording, before any pre-processing.
    """
    match = match_of_run(services, services.runs.record(run.id), run.configuration_id)
    try:
        dataset = services.catalogue.dataset(run.dataset)
        sensors = dataset.sensors  # an imported run does not say which it used
        if match is not None:
            sensors = tuple(
                dataset.sensor(name) for name in dict.fromkeys(used.name for used in match.sensors.values())
            )
    except SlamHiveError as error:
        return [{"sensor": run.dataset, "problem": error.message}]
    shown = [sensor for sensor in sensors if sensor.kind in _IMAGES or sensor.kind is SensorKind.LIDAR]
    return [_view(services, dataset, sensor, timestamp_s) for sensor in shown]


def _view(services: Hive, dataset: Dataset, sensor: Sensor, timestamp_s: float) -> dict[str, Any]:
    try:
        time_s = services.dataset_views.received_s(dataset, sensor.name, timestamp_s)
    except SlamHiveError as error:
        return {"sensor": sensor.name, "problem": error.message}
    if time_s is None:
        return {"sensor": sensor.name, "problem": "the recording has nothing at this time or later"}
    kind = "frame" if sensor.kind in _IMAGES else "sweep"
    time = f"{math.floor(time_s * 1e6) / 1e6:.6f}"  # rounding up would skip the message
    return {
        "sensor": sensor.name,
        kind: url_for(f"datasets.{kind}", name=dataset.name, sensor=sensor.name, time=time),
        "time_s": time_s,
    }
