"""Reads a recording with the library of its format, for ``outside.py``. Runs in an environment that has the library.

Usage: ``python outside_reader.py evalio|ouster|aria plan|records PATH PART``. It imports nothing of this project.

``plan`` writes a line of JSON, whose ``arrays`` give the name, type and shape of the arrays that follow as bytes.
``records`` writes each message as its time in ns (int64), its number of items (uint32), and the items: points as
:data:`POINT`, pixels as bytes. Both begin with, and ``records`` has between its messages, as many signs of life
(:data:`ALIVE`) as it takes: a reader that writes nothing for minutes is ended.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
RECORD_HEADER = struct.Struct("<qI")
ALIVE = {"plan": b"\n", "records": RECORD_HEADER.pack(-1, 0)}
SIGN_EVERY_S = 5.0


def main(library: str, mode: str, path: str, part: str) -> int:
    """Write what ``mode`` asks for to the standard output; returns the exit code."""
    # Print statements, progress bars and logs of compiled code must not mix with the data.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        READERS[library, mode](path, part, out)
    except Exception as error:  # noqa: BLE001 - libraries raise all kinds, and users get one line
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)  # noqa: T201 - its own output
        return 3
    out.close()
    return 0


class Unreadable(Exception):
    """A recording that cannot be read, with the reason in one line."""


def write_plan(about: dict[str, Any], arrays: dict[str, Any], out: IO[bytes]) -> None:
    """Write the facts ``about`` a recording and its arrays."""
    about["arrays"] = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    out.write(json.dumps(about).encode() + b"\n")
    for array in arrays.values():
        out.write(array.tobytes())


def write_record(time_ns: int, items: Any, out: IO[bytes]) -> None:
    """Write one message."""
    out.write(RECORD_HEADER.pack(time_ns, len(items)))
    out.write(items.tobytes())


def watched(items: Iterable[Any], mode: str, out: IO[bytes]) -> Iterator[Any]:
    """Pass ``items`` on, with a sign of life every few seconds."""
    monotonic_s = time.monotonic  # noqa: TID251 - it imports nothing of this project
    told_s = monotonic_s()
    for item in items:
        if monotonic_s() - told_s >= SIGN_EVERY_S:
            out.write(ALIVE[mode])
            out.flush()
            told_s = monotonic_s()
        yield item


# evalio: sequences of its datasets, below the folder of all its data.


def evalio_sequence(folder: str, name: str) -> Any:
    """The sequence ``dataset/sequence``."""
    from evalio import datasets  # type: ignore[import-not-found] # noqa: PLC0415 - not in the environment of tests

    datasets.set_data_dir(Path(folder))
    sequence = datasets.get_sequence(name)
    if not isinstance(sequence, datasets.Dataset):
        known = ", ".join(sorted(datasets.all_datasets()))
        raise Unreadable(f"evalio knows no sequence {name!r}; its datasets are {known}")
    if not sequence.is_downloaded():
        missing = [str(file) for file in sequence.files() if not (sequence.folder / file).exists()]
        raise Unreadable(f"{sequence.folder} lacks {', '.join(missing[:3])}; get it with: evalio dl {name}")
    return sequence


def plan_evalio(folder: str, name: str, out: IO[bytes]) -> None:
    """Write the sequence without its scans."""
    sequence = evalio_sequence(folder, name)
    scan_times_ns: list[int] = []
    imu_times_ns: list[int] = []
    imu: list[list[float]] = []
    for measurement in watched(sequence, "plan", out):
        time_ns = measurement.stamp.to_nsec()
        if hasattr(measurement, "gyro"):
            imu_times_ns.append(time_ns)
            imu.append([*measurement.gyro, *measurement.accel])
        else:
            scan_times_ns.append(time_ns)
    truth = sequence.ground_truth()
    poses = [] if truth is None else list(zip(truth.stamps, truth.poses, strict=True))
    lidar, noise = sequence.lidar_params(), sequence.imu_params()
    write_plan(
        {
            "name": sequence.full_name,
            "url": sequence.url(),
            "environment": sequence.environment(),
            "vehicle": sequence.vehicle(),
            "T_imu_lidar": sequence.imu_T_lidar().to_mat().reshape(-1).tolist(),
            "lidar": {
                key: getattr(lidar, key) for key in ("num_rows", "num_columns", "min_range", "max_range", "rate")
            },
            "imu": {key: getattr(noise, key) for key in ("gyro", "accel", "gyro_bias", "accel_bias")},
        },
        {
            "scan_times_ns": np.array(scan_times_ns, dtype="<i8"),
            "imu_times_ns": np.array(imu_times_ns, dtype="<i8"),
            "imu": np.array(imu, dtype="<f8").reshape(-1, 6),
            "truth_times_ns": np.array([stamp.to_nsec() for stamp, _ in poses], dtype="<i8"),
            "truth": np.array(
                [[*pose.trans, *(getattr(pose.rot, f"q{axis}") for axis in "xyzw")] for _, pose in poses], dtype="<f8"
            ).reshape(-1, 7),
        },
        out,
    )


def scans_of_evalio(folder: str, name: str, out: IO[bytes]) -> None:
    """Write all scans; the timestamp of one is its start, from which the times of points count."""
    for scan in evalio_sequence(folder, name).lidar():
        points = scan.points
        table = np.zeros(len(points), dtype=POINT)
        for field in ("x", "y", "z", "intensity"):
            table[field] = [getattr(point, field) for point in points]
        table["ring"] = [point.row for point in points]
        table["time"] = [point.t.to_sec() for point in points]
        write_record(scan.stamp.to_nsec(), table, out)


# Ouster: OSF files, and captures of packets with the JSON file of the sensor beside them.


def ouster_source(path: str) -> Any:
    """The frames of a recording with 1.x of the SDK."""
    from ouster.sdk import open_source  # type: ignore[import-not-found] # noqa: PLC0415 - as above

    return open_source(path)


def ouster_frames(source: Any) -> Iterator[tuple[int, Any, Any]]:
    """Number of the sensor, frame and measured columns of each frame; those without any are left out."""
    for frames in source:
        for number, frame in enumerate(frames):
            measured = None if frame is None else (frame.status & 1).astype(bool) & (frame.timestamp > 0)
            if measured is not None and measured.any():
                yield number, frame, measured


def plan_ouster(path: str, _part: str, out: IO[bytes]) -> None:
    """Write what the recording has of each sensor, without its scans."""
    source = ouster_source(path)
    infos = list(source.sensor_info)
    times_ns: list[list[int]] = [[] for _ in infos]
    samples: list[list[list[float]]] = [[] for _ in infos]
    partial = [0] * len(infos)
    posed, second, gnss = ([False] * len(infos) for _ in range(3))
    for number, frame, measured in watched(ouster_frames(source), "plan", out):
        times_ns[number].append(int(frame.timestamp[measured].min()))
        first, last = infos[number].format.column_window
        expected = (last - first) % frame.w + 1
        partial[number] += int(np.count_nonzero(measured)) < expected
        posed[number] |= not np.allclose(frame.body_to_world[measured], np.eye(4))
        second[number] |= frame.has_field("RANGE2")
        gnss[number] |= frame.has_field("POSITION_LAT_LONG") and bool(np.any(frame.field("POSITION_LAT_LONG")))
        if frame.has_field("IMU_ACC"):
            valid = (frame.field("IMU_STATUS") & 1).astype(bool)
            rows = (frame.field(name)[valid] for name in ("IMU_TIMESTAMP", "IMU_GYRO", "IMU_ACC"))
            samples[number] += [[int(ns), *gyro, *force] for ns, gyro, force in zip(*rows, strict=True)]
    if path.endswith(".pcap") and not any(samples):
        # Frames hold no samples of the older packets.
        from ouster.sdk import open_packet_source  # noqa: PLC0415 - as above
        from ouster.sdk.core import ImuPacket  # type: ignore[import-not-found] # noqa: PLC0415 - as above

        for number, packet in watched(open_packet_source(path), "plan", out):
            if isinstance(packet, ImuPacket):
                read = zip(packet.timestamp(), packet.gyro(), packet.accel(), strict=True)
                samples[number] += [[int(ns), *gyro, *force] for ns, gyro, force in read]
    listed = source.frames_num if path.endswith(".osf") and source.is_indexed else [None] * len(infos)
    arrays: dict[str, Any] = {}
    for number in range(len(infos)):
        arrays[f"scan{number}_times_ns"] = np.array(times_ns[number], dtype="<i8")
        arrays[f"imu{number}_times_ns"] = np.array([row[0] for row in samples[number]], dtype="<i8")
        arrays[f"imu{number}"] = np.array([row[1:] for row in samples[number]], dtype="<f8").reshape(-1, 6)
    sensors = [
        {
            "product": info.prod_line,
            "serial": str(info.sn),
            "timestamp_mode": str(info.config.timestamp_mode or "").rsplit(".", 1)[-1],
            "columns": info.format.columns_per_frame,
            "elevations_deg": np.asarray(info.beam_altitude_angles, dtype=float).reshape(-1).tolist(),
            "T_body_sensor": np.asarray(info.sensor_to_body, dtype=float).reshape(-1).tolist(),
            # the SDK keeps this one in mm
            "T_sensor_imu": np.vstack(
                [np.asarray(info.imu_to_sensor_transform)[:3] * [1, 1, 1, 1e-3], [0.0, 0.0, 0.0, 1.0]]
            )
            .reshape(-1)
            .tolist(),
            "listed": listed[number],
            "partial": partial[number],
            "posed": bool(posed[number]),
            "second_returns": bool(second[number]),
            "gnss": bool(gnss[number]),
        }
        for number, info in enumerate(infos)
    ]
    write_plan({"sensors": sensors}, arrays, out)


def scans_of_ouster(path: str, part: str, out: IO[bytes]) -> None:
    """Write the scans of the sensor with the number ``part``, column by column, without points that have no return.

    Points are in the frame that Ouster calls Sensor Coordinate Frame.
    """
    from ouster.sdk.core import XYZLut  # noqa: PLC0415 - as above

    source = ouster_source(path)
    wanted = int(part)
    positions = XYZLut(list(source.sensor_info)[wanted], use_extrinsics=False)
    for number, frame, measured in watched(ouster_frames(source), "records", out):
        if number != wanted:
            continue
        start_ns = int(frame.timestamp[measured].min())
        # transposed: columns follow each other in the order of time
        columns, rows = np.nonzero(((frame.field("RANGE") > 0) & measured).T)
        table = np.zeros(len(rows), dtype=POINT)
        xyz_m = positions(frame)[rows, columns]
        for axis, name in enumerate("xyz"):
            table[name] = xyz_m[:, axis]
        brightness = next((name for name in ("REFLECTIVITY", "SIGNAL") if frame.has_field(name)), None)
        if brightness is not None:
            table["intensity"] = frame.field(brightness)[rows, columns]
        table["ring"] = rows
        table["time"] = (frame.timestamp[columns].astype(np.int64) - start_ns) * 1e-9
        write_record(start_ns, table, out)


# Aria: VRS files of the glasses of Project Aria.


def aria_provider(path: str) -> Any:
    """The streams of a VRS file and the calibration of the device in it."""
    from projectaria_tools.core import data_provider  # type: ignore[import-not-found] # noqa: PLC0415 - as above

    provider = data_provider.create_vrs_data_provider(path)
    if provider is None:
        raise Unreadable("it is no VRS file, or its index is damaged")
    if provider.get_device_calibration() is None:
        raise Unreadable("the file has no calibration of a device: it is no recording of Project Aria")
    return provider


def plan_aria(path: str, _part: str, out: IO[bytes]) -> None:
    """Write which cameras and IMUs the recording has, without the images."""
    from projectaria_tools.core.sensor_data import TimeDomain  # type: ignore[import-not-found] # noqa: PLC0415

    provider = aria_provider(path)
    device = provider.get_device_calibration()
    cameras: list[dict[str, Any]] = []
    imus: list[dict[str, Any]] = []
    left_out: list[str] = []
    arrays: dict[str, Any] = {}
    streams = {provider.get_label_from_stream_id(stream): stream for stream in provider.get_all_streams()}
    # first the cameras for SLAM, in the order of their streams, left before right
    for label, stream in sorted(streams.items(), key=lambda entry: ("slam" not in entry[0], str(entry[1]))):
        count = provider.get_num_data(stream)
        if count == 0:
            continue
        camera, imu = "slam" in label or label == "camera-rgb", label.startswith("imu")
        calibration = device.get_camera_calib(label) if camera else device.get_imu_calib(label) if imu else None
        if calibration is None:
            left_out.append(f"{label} (without calibration)" if camera or imu else label)
            continue
        times_ns = np.array(provider.get_timestamps_ns(stream, TimeDomain.DEVICE_TIME), dtype="<i8")
        if camera:
            number = len(cameras)
            pixels = provider.get_image_data_by_index(stream, 0)[0].to_numpy_array()
            width, height = (int(size) for size in calibration.get_image_size())
            if pixels.shape[:2] != (height, width):
                sizes = f"images of {pixels.shape[1]}x{pixels.shape[0]} pixels and a calibration of {width}x{height}"
                raise Unreadable(f"{label} has {sizes}")
            grid = [(u, v) for u in np.linspace(0, width - 1, 25) for v in np.linspace(0, height - 1, 25)]
            rays = [(pixel, calibration.unproject(np.array(pixel))) for pixel in grid]
            arrays[f"cam{number}_times_ns"] = times_ns
            arrays[f"rays{number}"] = np.array(
                [[*pixel, *ray] for pixel, ray in rays if ray is not None], dtype="<f8"
            ).reshape(-1, 5)
            cameras.append(
                {
                    "label": label,
                    "stream": str(stream),
                    "width": width,
                    "height": height,
                    "channels": 1 if pixels.ndim == 2 else pixels.shape[2],
                    "focal_px": float(calibration.get_focal_lengths()[0]),
                    "model": calibration.get_model_name().name,
                    "time_offset_s": calibration.get_time_offset_sec_device_camera(),
                    "T_device_sensor": calibration.get_transform_device_camera().to_matrix().reshape(-1).tolist(),
                }
            )
        else:
            number = len(imus)
            rows, valid = np.empty((count, 6), dtype="<f8"), np.empty(count, dtype=bool)
            for index in watched(range(count), "plan", out):
                reading = provider.get_imu_data_by_index(stream, index)
                rows[index] = [*reading.gyro_radsec, *reading.accel_msec2]
                valid[index] = reading.gyro_valid and reading.accel_valid
            rows[:, :3] = rectified(rows[:, :3], calibration.raw_to_rectified_gyro)
            rows[:, 3:] = rectified(rows[:, 3:], calibration.raw_to_rectified_accel)
            arrays[f"imu{number}_times_ns"], arrays[f"imu{number}"] = times_ns[valid], rows[valid]
            imus.append(
                {
                    "label": label,
                    "invalid": int((~valid).sum()),
                    "gyro_offset_s": calibration.get_time_offset_sec_device_gyro(),
                    "force_offset_s": calibration.get_time_offset_sec_device_accel(),
                    "T_device_sensor": calibration.get_transform_device_imu().to_matrix().reshape(-1).tolist(),
                }
            )
    about = {"device": device.get_device_subtype(), "cameras": cameras, "imus": imus, "left_out": left_out}
    write_plan(about, arrays, out)


def rectified(rows: Any, correct: Callable[[Any], Any]) -> Any:
    """Correct measurements (n, 3) by a calibration, which is affine: four points give its matrix."""
    zero = np.asarray(correct(np.zeros(3)))
    matrix = np.column_stack([np.asarray(correct(axis)) - zero for axis in np.eye(3)])
    return rows @ matrix.T + zero


def images_of_aria(path: str, part: str, out: IO[bytes]) -> None:
    """Write the images of the stream ``part``, as rows of grey pixels or of red, green and blue."""
    from projectaria_tools.core.stream_id import StreamId  # type: ignore[import-not-found] # noqa: PLC0415 - as above

    provider, stream = aria_provider(path), StreamId(part)
    for index in range(provider.get_num_data(stream)):
        image, record = provider.get_image_data_by_index(stream, index)
        pixels = np.ascontiguousarray(image.to_numpy_array())
        write_record(record.capture_timestamp_ns, pixels.reshape(-1).view(np.uint8), out)


READERS: dict[tuple[str, str], Callable[[str, str, IO[bytes]], None]] = {
    ("evalio", "plan"): plan_evalio,
    ("evalio", "records"): scans_of_evalio,
    ("ouster", "plan"): plan_ouster,
    ("ouster", "records"): scans_of_ouster,
    ("aria", "plan"): plan_aria,
    ("aria", "records"): images_of_aria,
}

if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
