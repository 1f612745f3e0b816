"""The data of 3D views: paths as JSON, points of maps as bytes, and what sensors saw at a moment."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from flask import url_for

from slamhive.analysis.chart import OKABE_ITO, colour_of, on_dark
from slamhive.analysis.plotly_chart import numbers
from slamhive.base.errors import NotFound, SlamHiveError
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.run_folder.point_cloud import MapCloud
from slamhive.services.hive import Hive
from slamhive.services.runs import Array, FrameFate, Moment, RunScene, ScenePath
from slamhive.store import RunRecord
from slamhive.trajectory.alignment import IDENTITY, Similarity
from slamhive.web.figures import best_plane
from slamhive.web.formatting import significant
from slamhive.web.presenters.catalogue import match_of_run

TRUTH = "ground truth"
TRUTH_COLOUR, TRUTH_ON_DARK = "#3d4247", "#c3c9d0"
_UP = {"xy": (0, 0, 1), "xz": (0, -1, 0), "yz": (1, 0, 0)}
"""What points up if the body moves in this plane; where it moves in xz, y is that of a camera and points down."""
_LEVELS = 65_535
_ALIGNMENT_BYTES = 4
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ShownPath:
    """A path with the name and the colour that it has on the page."""

    name: str
    colour: str
    path: ScenePath


@dataclass(frozen=True, slots=True)
class ShownMap:
    """A map: where its points can be had, how many there are, and whether a reference map exists."""

    address: str
    points: int
    reference: bool = False

    @property
    def document(self) -> Json:
        """The map as JSON has it."""
        return {"address": self.address, "points": self.points, "reference": self.reference}


def scene_json(
    title: str,
    paths: Sequence[ShownPath],
    cloud: ShownMap | None = None,
    notes: Sequence[str] = (),
    *,
    z_up: bool = False,
) -> Json:
    """The scene of a page.

    Positions are relative to ``centre_m``, times to ``from_s``, so that single precision is enough.

    Args:
        title: What the view is called.
        paths: All paths, in one frame and on one clock.
        cloud: The map; None without one.
        notes: What is not shown, and why.
        z_up: Whether z is known to point up; otherwise it follows from the plane in which the body moves.
    """
    tracks = [shown.path.track for shown in paths]
    centre_m: Array = np.zeros(3)
    if tracks:
        ends = [part for track in tracks for part in (track.positions_m.min(axis=0), track.positions_m.max(axis=0))]
        centre_m = (np.min(ends, axis=0) + np.max(ends, axis=0)) / 2
    from_s = min((float(track.times_s.min()) for track in tracks), default=0.0)
    until_s = max((float(track.times_s.max()) for track in tracks), default=0.0)
    up = _UP["xy" if z_up or not tracks else best_plane(tracks[0])]
    return {
        "title": title,
        "up": up,
        "centre_m": centre_m.tolist(),
        "from_s": from_s,
        "duration_s": until_s - from_s,
        "paths": [_path(shown, centre_m, from_s) for shown in paths],
        "map": None if cloud is None else cloud.document,
        "notes": list(notes),
    }


def truth_path(path: ScenePath) -> ShownPath:
    """The ground truth, which looks the same on all pages."""
    return ShownPath(TRUTH, TRUTH_COLOUR, path)


def truth_paths(scene: RunScene) -> list[ShownPath]:
    """The ground truth of a run, if it has one."""
    return [] if scene.groundtruth is None else [truth_path(scene.groundtruth)]


def run_paths(algorithm: str, scene: RunScene, algorithms: Iterable[str]) -> list[ShownPath]:
    """The paths of a run: the first in the algorithm's colour, the others in further ones."""
    colour = colour_of(algorithm, algorithms)
    colours = [colour, *(other for other in OKABE_ITO if other != colour)]
    several = len(scene.paths) > 1
    return [
        ShownPath(f"{algorithm}, {path.kind}" if several else algorithm, colours[place], path)
        for place, path in enumerate(scene.paths)
    ]


def algorithm_names(services: Hive) -> Iterator[str]:
    """Those of the catalogue, on which colours depend."""
    return (entry.name for entry in services.catalogue.algorithms())


def dataset_of(services: Hive, name: str) -> Dataset | None:
    """The dataset of a run; None if it no longer exists."""
    try:
        return services.catalogue.dataset(name)
    except NotFound:
        return None


def reference_of(dataset: Dataset | None) -> Path | None:
    """The reference map of a dataset."""
    return None if dataset is None or dataset.reference_map is None else dataset.folder / dataset.reference_map


def is_z_up(dataset: Dataset | None) -> bool:
    """True if z of the ground truth is known to point up."""
    return dataset is not None and dataset.groundtruth is not None and dataset.groundtruth.gravity_aligned


def cloud_bytes(cloud: MapCloud, to_scene: Similarity = IDENTITY) -> bytes:
    """Points for the page: the length of a JSON header, the header, positions, and values of the points.

    The length is a uint32, positions are float32 x, y, z in m from ``origin_m``. Each of ``values`` is uint16 for each
    point, from ``low`` to ``high``. Numbers have the least significant byte first. All parts begin at multiples of 4.
    """
    positions_m = to_scene.points(cloud.positions_m)
    origin_m = np.median(positions_m, axis=0)
    values = {"intensity": cloud.intensities, "error": cloud.errors_m}
    known = {name: array for name, array in values.items() if array is not None and np.isfinite(array).any()}
    header = {
        "points": len(positions_m),
        "total": cloud.total,
        "voxel_m": None if cloud.voxel_m is None else cloud.voxel_m * to_scene.scale,
        "origin_m": origin_m.tolist(),
        "values": [{"name": name, "low": _low(array), "high": _high(array)} for name, array in known.items()],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % _ALIGNMENT_BYTES)
    parts = [struct.pack("<I", len(text)), text, (positions_m - origin_m).astype("<f4").tobytes()]
    return b"".join([*parts, *map(_levels, known.values())])


def _path(shown: ShownPath, centre_m: Array, from_s: float) -> Json:
    path = shown.path
    is_truth = path.kind == TRUTH
    return {
        "name": shown.name,
        "kind": path.kind,
        "truth": is_truth,
        "colour": shown.colour,
        "dark": TRUTH_ON_DARK if is_truth else on_dark(shown.colour),
        "poses": path.track.poses,
        "times_s": numbers(path.track.times_s - from_s),
        "positions_m": numbers(path.track.positions_m - centre_m),
        "pieces": numbers(path.track.pieces),
        "speeds_mps": numbers(path.speeds_mps),
        "errors_m": None if path.errors_m is None else numbers(path.errors_m),
    }


def _low(values: Array) -> float:
    return float(np.nanmin(np.where(np.isfinite(values), values, np.nan)))


def _high(values: Array) -> float:
    return float(np.nanmax(np.where(np.isfinite(values), values, np.nan)))


def _levels(values: Array) -> bytes:
    """Each value as one of 65,536 levels; what is not finite is the lowest."""
    low, high = _low(values), _high(values)
    shares = (np.where(np.isfinite(values), values, low) - low) / ((high - low) or 1.0)
    content = np.round(shares * _LEVELS).astype("<u2").tobytes()
    return content + b"\0" * (-len(content) % _ALIGNMENT_BYTES)


# -- a moment of a run, in words, and the images and sweeps of that moment ---------------------------------------------

_IMAGES = frozenset({SensorKind.CAMERA, SensorKind.DEPTH})


def words(moment: Moment) -> str:
    """The error and the fate of the frame, as a sentence each."""
    error = "No matched pose is near"
    if moment.error_m is not None:
        error = f"The position error is {significant(moment.error_m)} m"
    return f"{error}. {_fate(moment.frame)}."


def _fate(frame: FrameFate | None) -> str:
    if frame is None:
        return "The algorithm reported no frame near this time"
    if frame.dropped:
        return "This frame was dropped"
    if frame.latency_s is None:
        return "This frame gave no result"
    return f"The frame took {significant(1e3 * frame.latency_s)} ms"


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
