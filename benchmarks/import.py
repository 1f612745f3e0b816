"""Speed of imports of datasets, against reading and writing the same bytes, and their memory.

Each importer runs in a process of its own on a recording made for it. In the same run, alternating, a plain copy reads
the same bytes, writes them, and reads them again for the checksum. It prints the ratio of the wall times and the peak
memory.

    python benchmarks/import.py [--megabytes 400] [--pairs 3] [--format ros1 --format mcap] [--json]

Recordings lie in a temporary folder and are removed; three times the size given must be free there. To add a format,
add a function that writes a recording to ``MAKERS``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import resource
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from rosbags.convert.converter import convert
from rosbags.typesys import Stores, get_typestore

from slamhive.base import strict_yaml
from slamhive.base.files import size_bytes
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, perform
from slamhive.recordings.writers import BagWriter

WIDTH, HEIGHT, IMU_PER_IMAGE = 752, 480, 10
START_NS, PERIOD_NS = 10**18, 50_000_000
BLOCK_BYTES = 4_000_000
IMAGE, IMU = "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"
CAMERA = Sensor(
    "cam0",
    SensorKind.CAMERA,
    "/cam0/image_raw",
    20.0,
    calibration=CameraIntrinsics(WIDTH, HEIGHT, 450.0, 450.0, 375.5, 239.5).calibration("mono8"),
)
INERTIAL = Sensor("imu0", SensorKind.IMU, "/imu0", 200.0)


def write_ros1(folder: Path, megabytes: float) -> Path:
    """Images at 20 Hz and IMU samples at 200 Hz in a ROS 1 bag."""
    path = folder / "take.bag"
    random = np.random.default_rng(1)
    pixels = random.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    with BagWriter(path) as bag:
        for number in range(frames(megabytes)):
            stamp_ns = START_NS + number * PERIOD_NS
            bag.camera_info(CAMERA, "/cam0/camera_info", stamp_ns)
            bag.image(CAMERA, stamp_ns, pixels, "mono8")
            for part in range(IMU_PER_IMAGE):
                bag.imu(INERTIAL, stamp_ns + part * PERIOD_NS // IMU_PER_IMAGE, np.zeros(3), np.zeros(3))
    return path


def write_ros2(folder: Path, megabytes: float) -> Path:
    """The same in a ROS 2 bag with SQLite."""
    return _convert(write_ros1(folder, megabytes), folder / "take", "sqlite3")


def write_mcap(folder: Path, megabytes: float) -> Path:
    """The same in an MCAP file."""
    made = _convert(write_ros1(folder, megabytes), folder / "take", "mcap")
    (made / "take.mcap").rename(folder / "take.mcap")
    shutil.rmtree(made)
    return folder / "take.mcap"


def write_mulran(folder: Path, megabytes: float) -> Path:
    """Ouster scans of 64 x 1024 points at 10 Hz."""
    points = np.random.default_rng(1).normal(0, 20, (64 * 1024, 4)).astype("<f4").tobytes()
    return _write_scans(folder / "Ouster", points, megabytes, START_NS, 100_000_000)


def write_nclt(folder: Path, megabytes: float) -> Path:
    """Velodyne scans of 40,000 points at 10 Hz, 8 bytes a point, which become 18."""
    hits = np.random.default_rng(1).integers(0, 256, 40_000 * 8, dtype=np.uint8).tobytes()
    return _write_scans(folder / "velodyne_sync", hits, megabytes, START_NS // 1000, 100_000)


def _write_scans(folder: Path, scan: bytes, megabytes: float, start: int, period: int) -> Path:
    folder.mkdir()
    for number in range(max(2, int(megabytes * 1e6 / len(scan)))):
        (folder / f"{start + number * period}.bin").write_bytes(scan)
    return folder.parent


def write_carmen(folder: Path, megabytes: float) -> Path:
    """Scans of 181 ranges as text, which is parsed twice."""
    ranges = " ".join(f"{value:.2f}" for value in np.random.default_rng(1).uniform(1, 80, 181))
    line = f"FLASER 181 {ranges} 1 2 0.5 1 2 0.5 "
    with (folder / "take.clf").open("w") as log:
        for number in range(max(2, int(megabytes * 1e6 / len(line)))):
            log.write(f"{line}{100 + number / 10:.1f} host {number / 10:.1f}\n")
    return folder / "take.clf"


def _convert(source: Path, target: Path, storage: str) -> Path:
    settings: dict[str, list[str]] = {
        name: [] for name in ("exclude_topics", "include_topics", "exclude_msgtypes", "include_msgtypes")
    }
    store = get_typestore(Stores.ROS2_HUMBLE)
    convert([source], target, storage, 8, None, "file", None, store, **settings)
    source.unlink()
    return target


def write_kitti_odometry(folder: Path, megabytes: float) -> Path:
    """Grey PNG images of the same size, not compressed, so that the ratio shows reading, checking and writing."""
    source = folder / "00"
    (source / "image_0").mkdir(parents=True)
    pixels = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    count = frames(megabytes)
    for number in range(count):
        path = source / "image_0" / f"{number:06d}.png"
        cv2.imwrite(str(path), pixels, (cv2.IMWRITE_PNG_COMPRESSION, 0))
    (source / "times.txt").write_text("".join(f"{number / 10}\n" for number in range(count)))
    (source / "calib.txt").write_text("P0: 450 0 375.5 0 0 450 239.5 0 0 0 1 0\n")
    return source


def write_euroc(folder: Path, megabytes: float) -> Path:
    """The same images in the ASL layout."""
    kitti = write_kitti_odometry(folder, megabytes)
    camera = folder / "take" / "mav0" / "cam0"
    camera.mkdir(parents=True)
    (kitti / "image_0").rename(camera / "data")
    names = sorted(path.name for path in (camera / "data").iterdir())
    rows = (f"{START_NS + number * PERIOD_NS},{name}\n" for number, name in enumerate(names))
    (camera / "data.csv").write_text("".join(rows))
    calibration = {
        "T_BS": np.eye(4).reshape(-1).tolist(),
        "camera_model": "pinhole",
        "resolution": [WIDTH, HEIGHT],
        "intrinsics": [450, 450, 375.5, 239.5],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [0, 0, 0, 0],
    }
    (camera / "sensor.yaml").write_text(strict_yaml.dump(calibration))
    shutil.rmtree(kitti)
    return folder / "take"


MAKERS: dict[str, Callable[[Path, float], Path]] = {
    "ros1": write_ros1,
    "ros2": write_ros2,
    "mcap": write_mcap,
    "mulran": write_mulran,
    "nclt": write_nclt,
    "carmen": write_carmen,
    "kitti-odometry": write_kitti_odometry,
    "euroc": write_euroc,
}
"""What writes a recording of each format, about so many megabytes, below a folder."""


def frames(megabytes: float) -> int:
    """The number of images in a recording of that size."""
    return max(3, int(megabytes * 1e6 / (WIDTH * HEIGHT + IMU_PER_IMAGE * 400)))


def plain_pass(source: Path, target: Path) -> None:
    """Read all files of a recording, write them, and read them again for a checksum."""
    files = [source] if source.is_file() else sorted(entry for entry in source.rglob("*") if entry.is_file())
    target.mkdir()
    for number, file in enumerate(files):
        copy = target / str(number)
        with file.open("rb") as reader, copy.open("wb") as writer:
            while block := reader.read(BLOCK_BYTES):
                writer.write(block)
        digest = hashlib.sha256()
        with copy.open("rb", buffering=0) as reader_again:
            while block := reader_again.read(BLOCK_BYTES):
                digest.update(block)


def import_once(name: str, source: Path, target: Path) -> None:
    """Plan and perform one import."""
    perform(plan_import(source, ImportOptions(), name)[1], target, lambda _fraction, _text: None)


def measured(work: Callable[..., None], *arguments: object) -> tuple[float, float]:
    """Wall time in s and peak memory in MB of ``work`` in a process of its own."""
    context = multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    process = context.Process(target=_measure, args=(queue, work, arguments))
    process.start()
    found: tuple[float, float] = queue.get()
    process.join()
    return found


def _measure(queue: object, work: Callable[..., None], arguments: tuple[object, ...]) -> None:
    start_s = time.perf_counter()
    work(*arguments)
    wall_s = time.perf_counter() - start_s
    queue.put((wall_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3))  # type: ignore[attr-defined]


def compare(name: str, megabytes: float, pairs: int) -> dict[str, object]:
    """The measurements of one importer."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        source = MAKERS[name](folder, megabytes)
        size_mb = size_bytes(source) / 1e6
        walls_s, ratios, peak_mb = [], [], 0.0
        for number in range(pairs):
            target = folder / "made"
            found: dict[str, tuple[float, float]] = {}
            for turn in ("import", "plain") if number % 2 else ("plain", "import"):
                arguments = (name, source, target) if turn == "import" else (source, target)
                found[turn] = measured(import_once if turn == "import" else plain_pass, *arguments)
                shutil.rmtree(target)
            walls_s.append(found["import"][0])
            ratios.append(found["import"][0] / found["plain"][0])
            peak_mb = max(peak_mb, found["import"][1])
    return {
        "format": name,
        "size_mb": round(size_mb, 1),
        "mb_per_s": round(size_mb / statistics.median(walls_s), 1),
        "ratio": round(statistics.median(ratios), 2),
        "peak_memory_mb": round(peak_mb, 1),
    }


def main() -> None:
    """Print one line for each format."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=400)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--format", dest="formats", action="append", choices=list(MAKERS))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    for name in options.formats or MAKERS:
        row = compare(name, options.megabytes, options.pairs)
        if options.json:
            print(json.dumps(row), flush=True)
        else:
            print(
                f"{row['format']:8}{row['size_mb']:>8} MB {row['mb_per_s']:>7} MB/s  {row['ratio']:>5} x a plain pass "
                f"{row['peak_memory_mb']:>6} MB peak memory",
                flush=True,
            )


if __name__ == "__main__":
    main()
