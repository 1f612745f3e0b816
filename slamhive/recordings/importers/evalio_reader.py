"""Reads a sequence with evalio, for ``importers/evalio.py``. Runs in an environment that has evalio.

Usage: ``python evalio_reader.py plan|scans DATA_FOLDER SEQUENCE``. It imports nothing of this project.

``plan`` writes a line of JSON, whose ``arrays`` give the name, type and shape of the arrays that follow as bytes.
``scans`` writes each scan as its time in ns (int64), its number of points (uint32), and the points as :data:`POINT`.
"""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import IO, Any

import numpy as np

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
SCAN_HEADER = struct.Struct("<qI")


def main(mode: str, folder: str, name: str) -> int:
    """Write what ``mode`` asks for to the standard output; returns the exit code."""
    out = sys.stdout.buffer
    # Print statements of evalio and of its progress bars must not mix with the data.
    sys.stdout = sys.stderr
    from evalio import datasets  # type: ignore[import-not-found] # noqa: PLC0415 - not in the environment of tests

    datasets.set_data_dir(Path(folder))
    sequence = datasets.get_sequence(name)
    if not isinstance(sequence, datasets.Dataset):
        known = ", ".join(sorted(datasets.all_datasets()))
        return fail(f"evalio knows no sequence {name!r}; its datasets are {known}")
    if not sequence.is_downloaded():
        missing = [str(file) for file in sequence.files() if not (sequence.folder / file).exists()]
        return fail(f"{sequence.folder} lacks {', '.join(missing[:3])}; get it with: evalio dl {name}")
    if mode == "plan":
        write_plan(sequence, out)
    else:
        for scan in sequence.lidar():
            write_scan(scan, out)
    return 0


def fail(message: str) -> int:
    """Say what is wrong in one line."""
    print(message, file=sys.stderr)  # noqa: T201 - the program's own output
    return 3


def write_plan(sequence: Any, out: IO[bytes]) -> None:
    """The sequence without its scans."""
    scan_times_ns: list[int] = []
    imu_times_ns: list[int] = []
    imu: list[list[float]] = []
    for measurement in sequence:
        time_ns = measurement.stamp.to_nsec()
        if hasattr(measurement, "gyro"):
            imu_times_ns.append(time_ns)
            imu.append([*measurement.gyro, *measurement.accel])
        else:
            scan_times_ns.append(time_ns)
    truth = sequence.ground_truth()
    poses = [] if truth is None else list(zip(truth.stamps, truth.poses, strict=True))
    arrays = {
        "scan_times_ns": np.array(scan_times_ns, dtype="<i8"),
        "imu_times_ns": np.array(imu_times_ns, dtype="<i8"),
        "imu": np.array(imu, dtype="<f8").reshape(-1, 6),
        "truth_times_ns": np.array([stamp.to_nsec() for stamp, _ in poses], dtype="<i8"),
        "truth": np.array([pose_row(pose) for _, pose in poses], dtype="<f8").reshape(-1, 7),
    }
    about = describe(sequence)
    about["arrays"] = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    out.write(json.dumps(about).encode() + b"\n")
    for array in arrays.values():
        out.write(array.tobytes())


def describe(sequence: Any) -> dict[str, Any]:
    """Parameters of the sensors, in the terms of evalio."""
    lidar, imu = sequence.lidar_params(), sequence.imu_params()
    return {
        "name": sequence.full_name,
        "url": sequence.url(),
        "environment": sequence.environment(),
        "vehicle": sequence.vehicle(),
        "T_imu_lidar": sequence.imu_T_lidar().to_mat().reshape(-1).tolist(),
        "lidar": {key: getattr(lidar, key) for key in ("num_rows", "num_columns", "min_range", "max_range", "rate")},
        "imu": {key: getattr(imu, key) for key in ("gyro", "accel", "gyro_bias", "accel_bias")},
    }


def pose_row(pose: Any) -> list[float]:
    """Position and quaternion x y z w."""
    rotation = pose.rot
    return [*pose.trans, rotation.qx, rotation.qy, rotation.qz, rotation.qw]


def write_scan(scan: Any, out: IO[bytes]) -> None:
    """One scan: its timestamp is its start, from which the times of points count."""
    points = scan.points
    table = np.zeros(len(points), dtype=POINT)
    for name in ("x", "y", "z", "intensity"):
        table[name] = [getattr(point, name) for point in points]
    table["ring"] = [point.row for point in points]
    table["time"] = [point.t.to_sec() for point in points]
    out.write(SCAN_HEADER.pack(scan.stamp.to_nsec(), len(points)))
    out.write(table.tobytes())


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
