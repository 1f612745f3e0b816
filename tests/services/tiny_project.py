"""A small project folder with a test algorithm that needs no packages, and a dataset of three poses a second."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from pathlib import Path

from rosbags.rosbag1 import Writer

from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.dataset_file import dataset_to_yaml
from tests.sharing import share_environments

ALGORITHM = """
format: 1
package: tiny
title: Test algorithm
version: "1"
upstream: https://example.invalid/tiny
licence: GPL-3.0-or-later
citation: none
resources: {cpu_cores: 1, memory_mb: 500}
modes:
  lidar:
    title: Test algorithm
    setup: lidar
    inputs: {points: lidar}
    trajectory_role: points
parameters:
  seconds: {type: float, default: 0.3, minimum: 0, maximum: 60, unit: s, help: How long it works.}
  behaviour:
    type: enum
    default: good
    choices: [good, crash, empty, malformed, silent, linger, lost, hungry]
    help: What it does.
"""

MAPPING = """
import os, pathlib, re, sys, time
result = pathlib.Path(os.environ.get("SLAMHIVE_RESULT", "/slamhive/result"))
config = pathlib.Path(os.environ.get("SLAMHIVE_CONFIG", "/slamhive/config.yaml")).read_text()
def setting(key):
    return re.search(rf"\\b{key}: ([\\w.]+)", config)[1]
(result / f"start-{time.time_ns()}-{os.getpid()}").touch(exist_ok=False)
print("tiny says hello", flush=True)
behaviour = setting("behaviour")
if behaviour == "lost":
    began = time.monotonic()
    while time.monotonic() - began < float(setting("seconds")):
        untracked_s = time.monotonic() - began
        (result / ".progress").write_text(f'{{"fraction": 0.5, "frames": 9, "untracked_s": {untracked_s}}}')
        os.replace(result / ".progress", result / "progress.json")
        time.sleep(0.02)
elif behaviour == "hungry":
    kept = bytearray(os.urandom(1)) * 150_000_000
    time.sleep(float(setting("seconds")))
else:
    time.sleep(float(setting("seconds")))
if behaviour == "crash":
    sys.exit(3)
poses = "".join(f"{100 + i / 3:.6f} {i} {i * i / 40} {0.1 * (i % 3)} 0 0 0 1\\n" for i in range(30))
if behaviour == "empty":
    poses = ""
if behaviour == "malformed":
    poses = "1.0 nan 0 0 0 0 0 1\\n"
if behaviour != "silent":
    (result / "traj.txt").write_text(poses)
(result / "finished").touch()
if behaviour == "linger":
    time.sleep(60)
"""


def executions(result: Path) -> int:
    """How many times the test algorithm was executed. Each time leaves an empty file, which a full disk still takes."""
    return len(list(result.glob("start-*")))


def make_project(root: Path) -> Path:
    """Write the project folder."""
    package = root / "algorithms" / "tiny"
    (package / "slamhive").mkdir(parents=True)
    (package / "algorithm.yaml").write_text(ALGORITHM)
    (package / "requirements.txt").write_text("")
    (package / "Dockerfile").write_text("FROM scratch\n")
    (package / "slamhive" / "mapping.py").write_text(textwrap.dedent(MAPPING))
    (root / "templates").mkdir()
    (root / "evaluation").symlink_to(Path(__file__).resolve().parents[2] / "evaluation")
    return root


def make_dataset(data: Path, name: str = "track", *, groundtruth: bool = True) -> Dataset:
    """Write a dataset folder: a tiny recording that the test algorithm never opens, and a ground truth."""
    folder = data / "datasets" / name
    folder.mkdir(parents=True)
    write_bag(folder / f"{name}.bag")
    truth = "".join(f"{100 + i / 3:.6f} {i} {i * i / 40 + 0.01} {0.1 * (i % 3)} 0 0 0 1\n" for i in range(30))
    if groundtruth:
        (folder / "groundtruth.txt").write_text(truth)
    dataset = Dataset(
        name=name,
        folder=folder,
        bag=f"{name}.bag",
        duration_s=10.0,
        sensors=(Sensor("lidar", SensorKind.LIDAR, "/points", 10.0),),
        groundtruth=GroundTruth("groundtruth.txt", gravity_aligned=True) if groundtruth else None,
        checksum="sha256:" + "0" * 64,
    )
    (folder / "dataset.yaml").write_text(dataset_to_yaml(dataset))
    return dataset


def write_bag(path: Path, topics: Sequence[str] = ("/points",)) -> None:
    """A ROS 1 bag with one message on each topic."""
    with Writer(path) as bag:
        for topic in topics:
            connection = bag.add_connection(
                topic, "std_msgs/msg/UInt8", msgdef="uint8 data\n", md5sum="7c8164229e7d2c17eb95e9231617fdee"
            )
            bag.write(connection, 100_000_000_000, b"\x01")


def environment(root: Path, data: Path, **settings: str) -> dict[str, str]:
    """The environment of a process that works in this project. A data root that exists shares environments."""
    share_environments(data)
    checkout = Path(__file__).resolve().parents[2]
    return {
        **os.environ,
        "PYTHONPATH": str(checkout),
        "SLAMHIVE_ROOT": str(root),
        "SLAMHIVE_DATA": str(data),
        "SLAMHIVE_EXECUTOR": "process",
        "SLAMHIVE_MIN_FREE_DISK_MB": "1",
        "SLAMHIVE_POLL_INTERVAL_S": "0.02",  # runs of tests are short
        **{f"SLAMHIVE_{key.upper()}": value for key, value in settings.items()},
    }
