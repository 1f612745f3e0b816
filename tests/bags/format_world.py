"""Small folders of each format that can be imported, and ways to break them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamhive.bags.importers import plan_import
from slamhive.bags.importing import ImportOptions, ImportPlan, perform
from slamhive.bags.reader import decode, messages, open_bag
from slamhive.domain.dataset import Dataset

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
FRAMES = 4
WIDTH, HEIGHT = 32, 24

Damage = Callable[[Path], object]


def silent(_fraction: float, _text: str) -> None:
    pass


def plan(source: Path, format_name: str | None = None, **options: Any) -> ImportPlan:
    return plan_import(source, ImportOptions(**options), format_name)[1]


def convert(source: Path, folder: Path, format_name: str | None = None, **options: Any) -> Dataset:
    return perform(plan(source, format_name, **options), folder, silent)


def recorded(dataset: Dataset) -> dict[str, list[Any]]:
    """The messages of a dataset by topic."""
    seen: dict[str, list[Any]] = {}
    with open_bag(dataset.bag_path) as reader:
        for connection, _, raw in messages(reader, dataset.bag_path):
            seen.setdefault(connection.topic, []).append(decode(reader, dataset.bag_path, connection, raw))
    return seen


def grey(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def colour(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth(number: int) -> Any:
    return np.random.default_rng(number).integers(1, 9000, (HEIGHT, WIDTH), dtype=np.uint16)


def draw(path: Path, pixels: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


def write(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def rewrite(name: str, pattern: str, replacement: str) -> Damage:
    def change(source: Path) -> None:
        path = source / name
        text, changes = re.subn(pattern, replacement, path.read_text(), count=1)
        assert changes
        path.write_text(text)

    return change


def cut(name: str, size: int) -> Damage:
    return lambda source: (source / name).write_bytes((source / name).read_bytes()[:size])


def remove(name: str) -> Damage:
    return lambda source: (source / name).unlink()


EUROC_START_NS = 1403715274312143104
"""That of V1_01: too large for a float64 to hold exactly."""
_T_BS = "T_BS:\n  cols: 4\n  rows: 4\n  data: [{}]"
_IDENTITY = "1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1"


def make_euroc(folder: Path, *, distortion_model: str = "radial-tangential") -> Path:
    """A folder as the ASL publishes them, two cameras, an IMU and the estimated ground truth."""
    root = folder / "mav0"
    for number in (0, 1):
        times = [EUROC_START_NS + 50_000_000 * frame for frame in range(FRAMES)]
        write(root / f"cam{number}/data.csv", "#timestamp [ns],filename", *(f"{t},{t}.png" for t in times))
        write(
            root / f"cam{number}/sensor.yaml",
            "%YAML:1.0",
            "sensor_type: camera",
            _T_BS.format(f"0, -1, 0, 0.1, 1, 0, 0, {0.1 * number}, 0, 0, 1, 0, 0, 0, 0, 1"),
            f"resolution: [{WIDTH}, {HEIGHT}]",
            "camera_model: pinhole",
            "intrinsics: [20.5, 20.25, 15.5, 11.5]",
            f"distortion_model: {distortion_model}",
            "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]",
        )
        for frame, time_ns in enumerate(times):
            draw(root / f"cam{number}/data/{time_ns}.png", grey(10 * number + frame))
    samples = [f"{EUROC_START_NS + 5_000_000 * n},0.{n},0.2,0.3,0,0,9.81" for n in range(31)]
    write(root / "imu0/data.csv", "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z", *samples)
    write(
        root / "imu0/sensor.yaml",
        "%YAML:1.0",
        _T_BS.format(_IDENTITY),
        "rate_hz: 200",
        "gyroscope_noise_density: 1.6968e-04",
        "accelerometer_noise_density: 2.0e-3",
    )
    poses = [f"{EUROC_START_NS + 5_000_000 * n},{n},2,3,0.6,0.8,0,0,1,1,1,0,0,0,0,0,0" for n in range(31)]
    write(root / "state_groundtruth_estimate0/data.csv", "#timestamp, p_RS_R_x [m], ... q_RS_w []", *poses)
    return folder


CALIBRATION = f"""\
sensors:
- kind: camera
  calibration: {{width: {WIDTH}, height: {HEIGHT}, fx: 20.5, fy: 20.25, cx: 15.5, cy: 11.5}}
"""
TUM_START_S = 1305031102.175304


def with_calibration(source: Path) -> dict[str, Any]:
    """The option with the intrinsics of a small camera, in a file beside ``source``."""
    path = source.with_name("camera.yaml")
    path.write_text(CALIBRATION)
    return {"calibration": (path,)}


def tum_pose(time_s: float, number: float) -> str:
    return f"{time_s:.6f} {number} 2 3 0 0 0.6 0.8"


def make_tum_rgbd(folder: Path) -> Path:
    """A folder as the benchmark publishes them: depth images are taken 10 ms after those with colour."""
    for kind, pixels, late_s in (("rgb", colour, 0.0), ("depth", depth, 0.01)):
        times = [f"{TUM_START_S + late_s + frame / 30:.6f}" for frame in range(FRAMES)]
        write(folder / f"{kind}.txt", "# color images", "# timestamp filename", *(f"{t} {kind}/{t}.png" for t in times))
        for frame, time in enumerate(times):
            draw(folder / f"{kind}/{time}.png", pixels(frame))
    poses = [tum_pose(TUM_START_S - 0.01 + n / 100, n) for n in range(14)]
    write(folder / "groundtruth.txt", "# ground truth trajectory", *poses)
    return folder


FORMATS: dict[str, Callable[[Path], Path]] = {"euroc": make_euroc, "tum-rgbd": make_tum_rgbd}
"""Makes a folder of each format."""
OPTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {"tum-rgbd": with_calibration}
"""What users have to say of such a folder."""
