"""Importer of nuScenes (Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020).

Tables, frames and timestamps: https://www.nuscenes.org/nuscenes and its development kit. The body is the car's
``ego_pose``: x to the front, y to the left, z up, at the middle of the rear axle.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import LidarLayout
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array, flat
from slamhive.recordings.importers.calibration import pose_matrix
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    Loss,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    rate_hz,
)
from slamhive.recordings.rgbd import Frames, camera_stream, rectified_intrinsics
from slamhive.recordings.streams import point_stream, read_records
from slamhive.recordings.writers import NS_PER_S
from slamhive.runtime.point_times import PointTimes, SweepInstant

_TABLES = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
_CAMERAS = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
_LIDAR = "LIDAR_TOP"
_FILE_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<f4")])
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")])
_NS_PER_US = 1000
_CHUNK_CHARACTERS = 1 << 20
_SPACE = re.compile(r"[\s,]*")
_LONGEST_RECORD = 1 << 20
Record = dict[str, Any]


class NuScenesImporter:
    """Images of six cameras, scans of the LiDAR and the car's poses to a dataset; all at their full rates.

    Radars are left out, and so is the IMU: it lies in the CAN bus expansion.
    """

    title = "nuScenes: v1.0-*/ with scene.json and the other tables, samples/, sweeps/"
    options = frozenset({"sequence"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The tables of a version, and the folder of samples."""
        tables = [file for file in visible_files(path, "v1.0-*/sample_data.json") if path.is_dir()]
        there = {"v1.0-*/sample_data.json": bool(tables), "samples": (path / "samples").is_dir()}
        return Detection(
            tuple(name for name, is_there in there.items() if is_there),
            tuple(name for name, is_there in there.items() if not is_there),
        )

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of a scene; raises InvalidInput naming the table, the key and the remedy."""
        tables, scene = _scene(source, options.sequence)
        samples = {
            record["token"] for record in _records(tables, "sample", {"token": str, "scene_token": str})
            if record["scene_token"] == scene["token"]
        }  # fmt: skip
        sensors = {
            record["token"]: record["channel"] for record in _records(tables, "sensor", {"token": str, "channel": str})
        }
        mounted = {
            record["token"]: record
            for record in _records(tables, "calibrated_sensor", {"token": str, "sensor_token": str})
        }
        keys = {
            "sample_token": str, "ego_pose_token": str, "calibrated_sensor_token": str, "timestamp": int,
            "filename": str,
        }  # fmt: skip
        frames: dict[str, list[Record]] = {}
        for record in _records(tables, "sample_data", keys):
            if record["sample_token"] not in samples:
                continue
            channel = sensors.get(mounted.get(record["calibrated_sensor_token"], {}).get("sensor_token", ""), "")
            if channel in (*_CAMERAS, _LIDAR):
                frames.setdefault(channel, []).append(record)
        if not frames:
            raise InvalidInput(f"{tables}: no camera or LiDAR belongs to scene {scene['name']}", "unpack all tables")
        notes = ["radars are left out; the IMU lies in the CAN bus expansion, which is not read"]
        streams: list[PlannedStream] = []
        for channel, records in frames.items():
            records.sort(key=lambda record: record["timestamp"])
            streams += _stream(source, tables, channel, records, mounted, notes)
        streams.sort(key=lambda stream: stream.sensor.name)
        if not streams:
            raise InvalidInput(f"{source}: no file of scene {scene['name']} is there", "unpack its samples and sweeps")
        reference = frames.get(_LIDAR) or max(frames.values(), key=len)
        truth = _truth(tables, {record["ego_pose_token"] for record in reference})
        notes.extend(matched_truth(truth, streams))
        return ImportPlan(tuple(streams), truth, _text(scene), notes=tuple(notes))


def _scene(source: Path, wanted: str | None) -> tuple[Path, Record]:
    """The folder of tables and the record of the scene; raises InvalidInput unless exactly one is meant."""
    found = [
        (path.parent, record)
        for path in visible_files(source, "v1.0-*/scene.json")
        for record in _records(path.parent, "scene", {"token": str, "name": str})
    ]
    named = [entry for entry in found if wanted in (None, entry[1]["name"])]
    if len(named) == 1:
        return named[0]
    names = [record["name"] for _, record in found]
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    if not names:
        raise InvalidInput(f"{source} has no v1.0-*/scene.json with a scene", "unpack the metadata")
    if wanted is not None and named:
        raise InvalidInput(f"scene {wanted} is in several versions of {source}", "keep the folder of one version")
    problem = f"{source} has {len(names)} scenes" + (f", none called {wanted!r}" if wanted is not None else "")
    raise InvalidInput(problem, f"name one with --sequence: {shown}")


def _records(tables: Path, name: str, keys: Mapping[str, type]) -> Iterator[Record]:
    """The records of a table with at least ``keys``, one at a time: a table of the whole dataset has a gigabyte.

    Raises InvalidInput.
    """
    path = tables / f"{name}.json"
    for number, record in enumerate(_objects(path), start=1):
        bad = [key for key, kind in keys.items() if not isinstance(record.get(key), kind)]
        if bad:
            raise InvalidInput(f"{path}: record {number} has no proper {bad[0]}", "unpack the metadata again")
        yield record


def _objects(path: Path) -> Iterator[Record]:
    """The objects of a JSON list, read in pieces."""
    decoder = json.JSONDecoder()
    bad = InvalidInput(f"{path} is no list of records", "unpack the metadata again")
    try:
        file = path.open(encoding="utf-8")
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}", "unpack the metadata") from None
    with file:
        try:
            text, place = file.read(_CHUNK_CHARACTERS), 0
            if not text.lstrip().startswith("["):
                raise bad
            place = text.index("[") + 1
            while True:
                place = _SPACE.match(text, place).end()  # type: ignore[union-attr]
                if text[place : place + 1] == "]":
                    return
                try:
                    record, place = decoder.raw_decode(text, place)
                except (ValueError, RecursionError):
                    more = file.read(_CHUNK_CHARACTERS)
                    if not more or len(text) - place > _LONGEST_RECORD:
                        raise bad from None
                    text, place = text[place:] + more, 0
                    continue
                if not isinstance(record, dict):
                    raise bad
                yield record
        except UnicodeDecodeError:
            raise bad from None


def _stream(
    source: Path,
    tables: Path,
    channel: str,
    records: Sequence[Record],
    mounted: Mapping[str, Record],
    notes: list[str],
) -> list[PlannedStream]:
    """The stream of a sensor with the files that are there; none if all are missing."""
    paths: list[Path] = []
    for record in records:
        named = PurePosixPath(record["filename"])
        # The name comes from outside: it must not lead out of the dataset.
        if named.is_absolute() or ".." in named.parts or "\0" in record["filename"] or not named.parts:
            name = record["filename"][:80]
            raise InvalidInput(f"{tables / 'sample_data.json'}: {name!r} is no file below the dataset")
        paths.append(source / named)
    there = [(record, path) for record, path in zip(records, paths, strict=True) if path.is_file()]
    missing = len(records) - len(there)
    if missing == len(records):
        notes.append(f"{channel} is left out: none of its {len(records)} files is there")
        return []
    if missing:
        notes.append(Loss(missing, len(records), f"{missing} of {len(records)} files of {channel} are missing"))
    times_ns = np.array([record["timestamp"] * _NS_PER_US for record, _ in there], dtype=np.int64)
    if (np.diff(times_ns) <= 0).any() or not 0 <= times_ns[0] <= times_ns[-1] < 2**31 * NS_PER_S:
        raise InvalidInput(f"{tables}: timestamps of {channel} are no increasing times", "unpack the metadata again")
    calibrated = mounted[records[0]["calibrated_sensor_token"]]
    T_body_sensor = _pose(calibrated, f"the calibration of {channel}", tables)
    files = [path for _, path in there]
    if channel == _LIDAR:
        # "The time when the full rotation of the current lidar frame is achieved" (nuScenes' description of its data).
        layout = LidarLayout(PointTimes(0.05, stamp=SweepInstant.END), ring_field="ring", beams=32)
        sensor = Sensor(
            "lidar0", SensorKind.LIDAR, "/points", rate_hz(times_ns), flat(T_body_sensor), layout.calibration()
        )
        return [point_stream(sensor, times_ns, files, _read_scan, _POINT.itemsize / _FILE_POINT.itemsize)]
    K = _numbers(calibrated.get("camera_intrinsic"), (3, 3), f"camera_intrinsic of {channel}", tables)
    if not (0 < K[0, 0] < 1e6 and 0 < K[1, 1] < 1e6):
        raise InvalidInput(
            f"{tables}: {channel} has focal lengths {K[0, 0]:g}, {K[1, 1]:g}", "unpack the metadata again"
        )
    intrinsics = rectified_intrinsics(K, files[0])
    name = f"cam{_CAMERAS.index(channel)}"
    return [camera_stream(name, Frames(times_ns, files), intrinsics, flat(T_body_sensor))]


def _read_scan(path: Path) -> Array:
    given = read_records(path, _FILE_POINT)
    points: Array = np.zeros(len(given), dtype=_POINT)
    for field in ("x", "y", "z", "intensity"):
        points[field] = given[field]
    if not all(np.isfinite(given[field]).all() for field in given.dtype.names or ()):
        raise InvalidInput(f"{path} holds numbers that are not finite", "copy or download the scan again")
    points["ring"] = given["ring"].clip(0, np.iinfo(np.uint16).max).astype(np.uint16)
    return points


def _pose(record: Record, place: str, tables: Path) -> Array:
    """The pose (4, 4) of ``translation`` in m and ``rotation``, a quaternion w x y z."""
    position_m = _numbers(record.get("translation"), (3,), f"translation of {place}", tables)
    w, x, y, z = _numbers(record.get("rotation"), (4,), f"rotation of {place}", tables)
    norm = float(np.linalg.norm([w, x, y, z]))
    if not 0.99 < norm < 1.01:
        raise InvalidInput(f"{tables}: the quaternion of {place} has norm {norm:g}", "unpack the metadata again")
    return pose_matrix(position_m, np.array([x, y, z, w]))


def _numbers(given: Any, shape: tuple[int, ...], place: str, tables: Path) -> Array:
    try:
        values = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != shape or not np.isfinite(values).all():
        raise InvalidInput(f"{tables}: {place} is not {np.prod(shape)} finite numbers", "unpack the metadata again")
    return values


def _truth(tables: Path, wanted: set[str]) -> PlannedTruth:
    """Poses of the car at the scans, in the frame of the map."""
    keys = {"token": str, "timestamp": int}
    records = [record for record in _records(tables, "ego_pose", keys) if record["token"] in wanted]
    if len(records) < len(wanted):
        raise InvalidInput(
            f"{tables / 'ego_pose.json'} lacks {len(wanted) - len(records)} of {len(wanted)} poses of the scene",
            "unpack the metadata again",
        )
    records.sort(key=lambda record: record["timestamp"])
    poses = np.array([_pose(record, f"pose {record['token'][:40]!r}", tables) for record in records])
    quats_wxyz = np.array([record["rotation"] for record in records], dtype=np.float64)
    quats_xyzw = quats_wxyz[:, [1, 2, 3, 0]] / np.linalg.norm(quats_wxyz, axis=1, keepdims=True)
    times_s = np.array([record["timestamp"] for record in records]) * (_NS_PER_US / NS_PER_S)
    return PlannedTruth(
        times_s, poses[:, :3, 3], quats_xyzw, gravity_aligned=True, source="localisation by LiDAR in a map"
    )


def _text(scene: Record) -> DatasetText:
    return DatasetText(
        title=f"nuScenes, {scene['name']}"[:100],
        description="A scene of nuScenes; the body is the car's ego_pose, at the rear axle.",
        licence="CC BY-NC-SA 4.0",
        citation="Caesar et al.: nuScenes: A multimodal dataset for autonomous driving. CVPR 2020",
        source="https://www.nuscenes.org/nuscenes",
        attributes=("real", "outdoor", "car"),
    )
