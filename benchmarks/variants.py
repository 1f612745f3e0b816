"""Speed of making variants of a dataset, against copying the file and a plain loop over its messages.

Every comparison runs in pairs, in alternating order, on a bag generated for it. It prints medians of the ratios of the
pairs, because the machine is shared and absolute times vary. The plain loop is what one would write with rosbags: read,
decode, resize, encode, write, in one thread.

    python benchmarks/variants.py [--megabytes 867] [--pairs 5] [--seconds 60] [--realtime] [--json]

It prints the ratios of wall times and of CPU times (user + system of this process), and how many cores others used. The
gain of a second core is invisible while others use it. ``--realtime`` (root) reserves the cores for the few seconds of
each measurement. A comparison ends after ``--seconds`` if it has three pairs by then.

Bags lie in a temporary folder and are removed; three times the size given must be free there.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.domain.configuration import Variant, VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.staging import checksum
from slamhive.recordings.variants.build import build_variant

STORE = get_typestore(Stores.ROS1_NOETIC)
WIDTH, HEIGHT = 752, 480
IMAGE, COMPRESSED, POINTS = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2"
CAMERAS = ("cam0", "cam1")
NS = 1_000_000_000
SHARES = {"raw": 1.0, "lidar": 1.0, "lz4": 1.0, "jpeg": 0.5, "png": 0.25, "bz2": 0.1}
"""Of the size asked for, counted in pixels before compression: the plain loop would need minutes for all of it."""
PAUSE_S = 3.0
"""Before each measurement: see :func:`timed`."""
FEWEST_PAIRS = 3


@dataclass(frozen=True)
class Case:
    """One comparison: what is made of which bag, what it is compared with, and how many times longer it may take."""

    name: str
    bag: str
    variant: Variant
    rival: str
    bound: float


@dataclass(frozen=True)
class Times:
    """One measurement in s: of the clock, of this process's CPU use, and of the CPU use of all others meanwhile."""

    wall_s: float
    cpu_s: float
    others_s: float


@dataclass(frozen=True)
class Result:
    """Medians of one comparison; times in s, ratios are ours over the rival's, ``others`` cores in use elsewhere."""

    name: str
    rival: str
    pairs: int
    ours_s: float
    rival_s: float
    ratio: float
    cpu_ratio: float
    others: float
    bound: float

    @property
    def held(self) -> bool:
        """The bound was kept."""
        return self.ratio <= self.bound


def every_second(*sensors: str) -> VariantStep:
    """Half the rate."""
    return VariantStep("rate", sensors, {"every": 2})


def half_size(*sensors: str) -> VariantStep:
    """Half the resolution."""
    return VariantStep("resolution", sensors, {"scale": 0.5})


HALF_BOTH: Variant = (every_second(*CAMERAS), half_size(*CAMERAS))
CASES = (
    Case("half rate", "raw", (every_second(*CAMERAS),), "copy", 0.7),
    Case("half rate, half size", "raw", HALF_BOTH, "loop", 1.05),
    Case("half size, JPEG", "jpeg", (half_size(*CAMERAS),), "loop", 1 / 1.7),
    Case("half size, PNG", "png", (half_size(*CAMERAS),), "loop", 1 / 1.7),
    Case("half rate, half size, bz2 chunks", "bz2", HALF_BOTH, "loop", 1 / 1.7),
    Case("half rate, half size, lz4 chunks", "lz4", HALF_BOTH, "loop", 1 / 1.7),
    Case("half size of 1 camera beside LiDAR", "lidar", (half_size("cam0"),), "copy", 1.2),
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=867.0, help="size of the raw bags")
    parser.add_argument("--pairs", type=int, default=5, help="at least 3")
    parser.add_argument("--seconds", type=float, default=60.0, help="for one comparison, once it has 3 pairs")
    parser.add_argument("--realtime", action="store_true", help="before other processes on all cores; needs root")
    parser.add_argument("--only", help="cases whose name contains this")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.realtime:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    pairs = max(FEWEST_PAIRS, arguments.pairs)
    cases = [case for case in CASES if arguments.only is None or arguments.only in case.name]
    results: list[Result] = []
    limits: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="slamhive-variants-") as scratch:
        for kind in dict.fromkeys(case.bag for case in cases):
            say(f"generating the bag {kind}")
            dataset = make_dataset(Path(scratch) / kind, kind, arguments.megabytes)
            results += [compare(dataset, case, pairs, arguments.seconds) for case in cases if case.bag == kind]
            if kind == "raw":
                limits = limit(dataset, pairs)
            shutil.rmtree(dataset.folder)
    if arguments.json:
        table = [{**asdict(result), "held": result.held} for result in results]
        print(json.dumps({"results": table, "limits": limits}, indent=1))
    else:
        show(results, limits)


def compare(dataset: Dataset, case: Case, pairs: int, seconds: float) -> Result:
    """Ours and the rival in turn, the order changing from pair to pair, after one round to warm up."""

    def ours(target: Path) -> None:
        build_variant(dataset, case.variant, target, lambda _fraction, _text: None)

    def rival(target: Path) -> None:
        if case.rival == "copy":
            shutil.copyfile(dataset.bag_path, target / dataset.bag)
        else:
            plain_loop(dataset, target / dataset.bag, rates=case.variant is HALF_BOTH)

    ends = time.monotonic() + seconds
    times: list[tuple[Times, Times]] = []
    for number in range(pairs + 1):
        if number > FEWEST_PAIRS and time.monotonic() > ends:
            break
        first, second = (ours, rival) if number % 2 else (rival, ours)
        measured = timed(dataset, first), timed(dataset, second)
        times.append(measured if number % 2 else (measured[1], measured[0]))
        say(f"{case.name}: round {number} of {pairs}, {times[-1][0].wall_s:.2f} s to {times[-1][1].wall_s:.2f} s")
    times = times[1:]
    return Result(
        name=case.name,
        rival={"copy": "copy of the file", "loop": "plain loop"}[case.rival],
        pairs=len(times),
        ours_s=statistics.median(pair[0].wall_s for pair in times),
        rival_s=statistics.median(pair[1].wall_s for pair in times),
        ratio=statistics.median(pair[0].wall_s / pair[1].wall_s for pair in times),
        cpu_ratio=statistics.median(pair[0].cpu_s / pair[1].cpu_s for pair in times),
        others=statistics.median(pair[0].others_s / pair[0].wall_s for pair in times),
        bound=case.bound,
    )


def timed(dataset: Dataset, work: Callable[[Path], None]) -> Times:
    """``work`` on an empty folder, which is removed.

    On virtual machines, pages of a file just removed are still backed by the host and several times as fast to fill as
    others. Nobody who makes a variant has just removed one of its size: so wait until they are given back.
    """
    target = dataset.folder.parent / "target"
    target.mkdir()
    time.sleep(PAUSE_S)
    try:
        wall_s, cpu_s, busy_s = time.perf_counter(), own_cpu_s(), all_cpu_s()
        work(target)
        wall_s, cpu_s = time.perf_counter() - wall_s, own_cpu_s() - cpu_s
        return Times(wall_s, cpu_s, max(0.0, all_cpu_s() - busy_s - cpu_s))
    finally:
        shutil.rmtree(target)


def own_cpu_s() -> float:
    """CPU time of this process, user and system."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def all_cpu_s() -> float:
    """CPU time of everything on this machine, from ``/proc/stat`` (proc(5)): all but idle, iowait and guest."""
    fields = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]
    ticks = [int(value) for value in fields]
    return (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")


def say(text: str) -> None:
    """Progress, beside the result."""
    print(text, file=sys.stderr, flush=True)


def limit(dataset: Dataset, pairs: int) -> dict[str, float]:
    """Half rate and half size without a bag to write: reading the kept images, and OpenCV's resize; medians in s."""
    reading, resizing = [], []
    for _ in range(pairs):
        began = time.perf_counter()
        with dataset.bag_path.open("rb", buffering=0) as stream:
            while stream.read(4 << 20):
                pass
        reading.append(time.perf_counter() - began)
        image = texture(0)
        images = dataset.bag_path.stat().st_size // image.nbytes // 2
        began = time.perf_counter()
        for _ in range(images):
            cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        resizing.append(time.perf_counter() - began)
    return {"reading_s": statistics.median(reading), "resize_s": statistics.median(resizing)}


def plain_loop(dataset: Dataset, target: Path, *, rates: bool) -> None:
    """The straightforward way, in one thread; chunks are compressed as in the source."""
    compression = dataset.name if dataset.name in {"bz2", "lz4"} else None
    topics = {f"/{camera}/image_raw" for camera in CAMERAS}
    counts = dict.fromkeys(topics, 0)
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    with Reader(dataset.bag_path) as reader, _writer(target, compression) as writer:
        connections = {
            entry.id: writer.add_connection(entry.topic, entry.msgtype, typestore=STORE) for entry in reader.connections
        }
        for connection, stamp_ns, raw in reader.messages():
            data: Any = raw
            if connection.topic in topics:
                counts[connection.topic] += 1
                if rates and counts[connection.topic] % 2 == 0:
                    continue
                data = _half(raw, connection.msgtype)
            writer.write(connections[connection.id], stamp_ns, data)
    cv2.setNumThreads(before)


def _half(raw: bytes, kind: str) -> Any:
    message: Any = STORE.deserialize_ros1(raw, kind)
    size = (WIDTH // 2, HEIGHT // 2)
    if kind == IMAGE:
        image = cv2.resize(message.data.reshape(message.height, message.width), size, interpolation=cv2.INTER_AREA)
        message.height, message.width, message.step = size[1], size[0], size[0]
        message.data = image.reshape(-1)
    else:
        whole: Any = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
        image = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        options = [cv2.IMWRITE_JPEG_QUALITY, 95] if message.format == "jpeg" else []
        message.data = cv2.imencode(".jpg" if message.format == "jpeg" else ".png", image, options)[1]
    return STORE.serialize_ros1(message, kind)


def make_dataset(folder: Path, kind: str, megabytes: float) -> Dataset:
    """A generated dataset: ``raw`` stereo with IMU, the same compressed in some way, or ``lidar`` with one camera."""
    folder.mkdir()
    bag = f"{kind}.bag"
    with _writer(folder / bag, kind if kind in {"bz2", "lz4"} else None) as writer:
        write = _Feeder(writer)
        for topic, stamp_ns, message in (
            _lidar(megabytes) if kind == "lidar" else _stereo(kind, megabytes * SHARES[kind])
        ):
            write(topic, stamp_ns, message)
    calibration: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "fx": 458.0, "fy": 457.0, "cx": 367.0, "cy": 248.0}
    names = CAMERAS[:1] if kind == "lidar" else CAMERAS
    sensors = tuple(
        Sensor(name, SensorKind.CAMERA, f"/{name}/image_raw", 20.0, calibration=calibration) for name in names
    )
    return Dataset(kind, folder, bag, 1.0, sensors, None, checksum(folder / bag))


def _stereo(kind: str, megabytes: float) -> Iterator[tuple[str, int, Any]]:
    frames = max(4, int(megabytes * 1e6 / (2 * WIDTH * HEIGHT)))
    images = [texture(seed) for seed in range(8)]
    for frame in range(frames):
        stamp_ns = NS + frame * NS // 20
        for number, camera in enumerate(CAMERAS):
            yield f"/{camera}/image_raw", stamp_ns, _image(kind, images[(frame + number) % 8], stamp_ns)
        for sample in range(10):
            imu_ns = stamp_ns + sample * NS // 200
            yield "/imu0", imu_ns, _imu(imu_ns)


def _lidar(megabytes: float) -> Iterator[tuple[str, int, Any]]:
    """A vehicle: 64 beams at 10 Hz, IMU, and one camera whose images are a fifth of the whole."""
    points = np.random.default_rng(0).integers(0, 255, 120_000 * 16, dtype=np.uint8)
    scans = max(2, int(megabytes * 1e6 / (points.nbytes + WIDTH * HEIGHT)))
    for scan in range(scans):
        stamp_ns = NS + scan * NS // 10
        yield "/points", stamp_ns, _cloud(points, stamp_ns)
        yield "/cam0/image_raw", stamp_ns + 1, _image("raw", texture(scan % 8), stamp_ns)
        for sample in range(20):
            imu_ns = stamp_ns + 2 + sample * NS // 200
            yield "/imu0", imu_ns, _imu(imu_ns)


_TEXTURES: dict[int, NDArray[np.uint8]] = {}


def texture(seed: int) -> NDArray[np.uint8]:
    """A grey image (480, 752) with edges and noise, about as compressible as a photograph."""
    if seed not in _TEXTURES:
        rng = np.random.default_rng(seed)
        coarse: Any = np.asarray(cv2.resize(rng.integers(0, 255, (30, 47), dtype=np.uint8), (WIDTH, HEIGHT)))
        _TEXTURES[seed] = coarse // 2 + rng.integers(0, 8, (HEIGHT, WIDTH), dtype=np.uint8)
    return _TEXTURES[seed]


class _Feeder:
    """Writes messages, adding connections as they appear."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections: dict[str, Any] = {}

    def __call__(self, topic: str, stamp_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=STORE)
        self._writer.write(self._connections[topic], stamp_ns, STORE.serialize_ros1(message, kind))


def _writer(path: Path, compression: str | None) -> Writer:
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    return writer


def _message(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def _header(stamp_ns: int) -> Any:
    stamp = _message("builtin_interfaces/msg/Time", sec=stamp_ns // NS, nanosec=stamp_ns % NS)
    return _message("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id="sensor")


def _image(kind: str, pixels: Any, stamp_ns: int) -> Any:
    if kind in {"jpeg", "png"}:
        data = cv2.imencode(".jpg" if kind == "jpeg" else ".png", pixels)[1]
        return _message(COMPRESSED, header=_header(stamp_ns), format=kind, data=data)
    return _message(
        IMAGE,
        header=_header(stamp_ns),
        height=HEIGHT,
        width=WIDTH,
        encoding="mono8",
        is_bigendian=0,
        step=WIDTH,
        data=pixels.reshape(-1),
    )


def _imu(stamp_ns: int) -> Any:
    vector = _message("geometry_msgs/msg/Vector3", x=0.1, y=0.2, z=9.8)
    return _message(
        "sensor_msgs/msg/Imu",
        header=_header(stamp_ns),
        orientation=_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector,
        linear_acceleration_covariance=np.zeros(9),
    )


def _cloud(data: Any, stamp_ns: int) -> Any:
    fields = [
        _message("sensor_msgs/msg/PointField", name=name, offset=4 * place, datatype=7, count=1)
        for place, name in enumerate(("x", "y", "z", "intensity"))
    ]
    return _message(
        POINTS,
        header=_header(stamp_ns),
        height=1,
        width=len(data) // 16,
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=len(data),
        data=data,
        is_dense=True,
    )


def show(results: list[Result], limits: dict[str, float]) -> None:
    """The table."""
    print(f"{'variant':36s}  {'compared with':16s}   ours s  rival s   ratio    CPU   bound          others' cores")
    for result in results:
        print(
            f"{result.name:36s}  {result.rival:16s}  {result.ours_s:7.3f}  {result.rival_s:7.3f}  {result.ratio:6.3f}"
            f"  {result.cpu_ratio:5.2f}  {result.bound:6.3f}  {'held' if result.held else 'NOT held':8s}"
            f"  {result.others:5.2f}"
        )
    if limits:
        print(
            f"limit for raw half rate, half size: reading the file {limits['reading_s']:.3f} s, "
            f"OpenCV's resize {limits['resize_s']:.3f} s in one thread"
        )


if __name__ == "__main__":
    main()
