"""Small folders of each format of 2D laser and LiDAR datasets."""

from __future__ import annotations

import bz2
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.recordings.format_world import FRAMES, NUSCENES_SCENE, colour, draw, write

CARMEN_RANGES = 5


def make_carmen(folder: Path) -> Path:
    """A log of a simulated robot, with relations beside it."""
    ranges = " ".join(f"{1.5 + n}" for n in range(CARMEN_RANGES))
    lines = ["# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp"]
    lines += ["PARAM robot_frontlaser_offset 0.1 nohost 0"]
    for n in range(FRAMES):
        pose = f"{0.1 * n:.1f} 0.0 {0.01 * n}"
        lines += [f"ODOM {pose} 0.5 0.05 0.0 {70 + n}.0 nohost {n}.0"]
        lines += [f"TRUEPOS {pose} {pose} {70 + n}.05 nohost {n}.05"]
        lines += [f"FLASER {CARMEN_RANGES} {ranges} {pose} {pose} {70 + n}.1 nohost {n}.1"]
    write(folder / "hall.clf", *lines)
    write(folder / "hall.relations", "70.1 71.1 0.1 0 0 0 0 0.01", "71.1 73.1 0.2 0 0 0 0 0.02")
    return folder


RAWSEEDS_START_S = 1235561676


def make_rawseeds(folder: Path) -> Path:
    """The files of a sequence, one of them compressed."""

    def times(offset: str) -> list[str]:
        return [f"{RAWSEEDS_START_S + n}.{offset}" for n in range(FRAMES)]

    ranges = ", ".join(f"{1 + n % 7}.25" for n in range(181))
    write(folder / "Hall-SICK_FRONT.csv", *(f"{t}, 180, 0, {ranges}" for t in times("004846")))
    rear = "\n".join(f"{t}, 181, 0, {ranges}" for t in times("010000")) + "\n"
    (folder / "Hall-SICK_REAR.csv.bz2").write_bytes(bz2.compress(rear.encode()))
    write(folder / "Hall-ODOMETRY_XYT.csv", *(f"{t}, {n}, 0, 0, 0.5, {n}.0, 0.1" for n, t in enumerate(times("003"))))
    write(folder / "Hall-GROUNDTRUTH.csv", *(f"{t}, {n}.0, 2.0, 0.25, 0, 0, 0" for n, t in enumerate(times("0"))))
    return folder


NCLT_START_US = 1326030975726043


def make_nclt(folder: Path) -> Path:
    """A session: four scans, the IMU, the receiver and the ground truth, which begins with NaN."""
    for n in range(FRAMES):
        hits = np.array([(20000, 20200, 19800, 7, 31), (20001 + n, 0, 40000, 255, 0)], dtype="<u2,<u2,<u2,u1,u1")
        path = folder / "velodyne_sync" / f"{NCLT_START_US + 100_000 * n}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(hits.tobytes())
    samples = [f"{NCLT_START_US + 20_000 * n},0.1,0.2,0.3,0.5,0.6,-9.8,0.01,0.02,0.0{n % 10}" for n in range(20)]
    write(folder / "ms25.csv", *samples)
    fixes = [f"{NCLT_START_US + 100_000 * n},{3 if n else 0},7,0.738167915,-1.461248,270.5,0,0" for n in range(FRAMES)]
    write(folder / "gps.csv", *fixes)
    poses = [f"{NCLT_START_US + 50_000 * n},{n},2,3,0.1,0.2,0.3" for n in range(1, 8)]
    write(folder / "groundtruth_2012-01-08.csv", f"{NCLT_START_US},nan,nan,nan,nan,nan,nan", *poses)
    return folder


MULRAN_START_NS = 1561000444390857630


def make_mulran(folder: Path) -> Path:
    """Two whole scans and a broken one, the IMU, the receiver and poses in UTM coordinates."""
    scans = folder / "sensor_data" / "Ouster"
    scans.mkdir(parents=True)
    points = np.zeros((64 * 1024, 4), dtype="<f4")
    points[:, 0] = np.arange(len(points)) / 1000
    for n in range(2):
        (scans / f"{MULRAN_START_NS + 100_000_000 * n}.bin").write_bytes(points.tobytes())
    (scans / f"{MULRAN_START_NS + 200_000_000}.bin").write_bytes(points[:100].tobytes())
    values = "0,0,0,1,0,0,0,0.01,0.02,0.03,0.1,0.2,9.8,1,2,3"
    write(
        folder / "sensor_data" / "xsens_imu.csv", *(f"{MULRAN_START_NS + 10_000_000 * n},{values}" for n in range(20))
    )
    fix = "36.3,127.4,85.5,4,0,0,0,4,0,0,0,9"
    write(folder / "sensor_data" / "gps.csv", *(f"{MULRAN_START_NS + 50_000_000 * n},{fix}" for n in range(4)))
    pose = "0,-1,0,353000.5,1,0,0,4026000.25,0,0,1,20"
    write(folder / "global_pose.csv", *(f"{MULRAN_START_NS + 20_000_000 * n},{pose}" for n in range(10)))
    return folder


NUSCENES_START_US = 1_532_402_927_600_000
NUSCENES_CHANNELS = ("LIDAR_TOP", "CAM_FRONT", "CAM_BACK", "RADAR_FRONT")


def make_nuscenes(folder: Path) -> Path:
    """Two scenes, of which the first has files: scans at 20 Hz, two cameras at 10 Hz; each second scan is a sample."""
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [
            {"token": f"s{n}", "name": name, "first_sample_token": f"a{n}0", "last_sample_token": f"a{n}1"}
            for n, name in enumerate((NUSCENES_SCENE, "scene-0103"))
        ],
        "sample": [
            {"token": f"a{n}{k}", "scene_token": f"s{n}", "timestamp": NUSCENES_START_US + 100_000 * k}
            for n in range(2)
            for k in range(2)
        ],
        "sensor": [
            {"token": f"k{n}", "channel": channel, "modality": channel.partition("_")[0].lower()}
            for n, channel in enumerate(NUSCENES_CHANNELS)
        ],
        "calibrated_sensor": [
            {
                "token": f"c{n}",
                "sensor_token": f"k{n}",
                "translation": [1.0 + n, 0.1, 1.5],
                "rotation": [0.5, -0.5, 0.5, -0.5] if n else [0.8, 0.0, 0.0, -0.6],
                "camera_intrinsic": [[20.0, 0, 15.5], [0, 20.5, 11.5], [0, 0, 1]] if n in (1, 2) else [],
            }
            for n in range(len(NUSCENES_CHANNELS))
        ],
        "sample_data": [],
        "ego_pose": [],
    }
    points = (np.arange(30).reshape(6, 5) / 10).astype("<f4")
    points[:, 4] = np.arange(6)
    for n, channel in enumerate(NUSCENES_CHANNELS[:3]):
        period_us, count = (100_000, FRAMES) if n else (50_000, 2 * FRAMES)
        for k in range(count):
            time_us = NUSCENES_START_US + period_us * k + 7_000 * n
            name = f"{'sweeps' if k % 2 else 'samples'}/{channel}/n015-{time_us}.{'jpg' if n else 'pcd.bin'}"
            record = {"token": f"d{n}{k}", "timestamp": time_us}
            size = {"width": 32, "height": 24} if n else {"width": 0, "height": 0}
            keys = {"sample_token": f"a0{k % 2}", "ego_pose_token": f"d{n}{k}", "calibrated_sensor_token": f"c{n}"}
            tables["sample_data"].append({**record, **keys, **size, "filename": name, "is_key_frame": k % 2 == 0})
            turn = [float(np.cos(0.05 * k)), 0.0, 0.0, float(np.sin(0.05 * k))]
            tables["ego_pose"].append({**record, "translation": [600.0 + k, 1600.0 - k, 0.5], "rotation": turn})
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if n:
                draw(folder / name, colour(k))
            else:
                (folder / name).write_bytes(points.tobytes())
    for table, records in tables.items():
        write(folder / "v1.0-mini" / f"{table}.json", json.dumps(records, indent=0))
    return folder


RANGE_FORMATS: dict[str, Callable[[Path], Path]] = {
    "carmen": make_carmen,
    "rawseeds": make_rawseeds,
    "nclt": make_nclt,
    "mulran": make_mulran,
    "nuscenes": make_nuscenes,
}
"""Makes a folder of each format."""
