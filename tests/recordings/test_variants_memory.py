"""What making a variant takes of memory does not depend on the size of the recording."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from slamhive.base.project import project_root
from tests.memory import folder_in_memory
from tests.recordings.variant_bags import IMAGE, START_NS, STORE, image

pytestmark = pytest.mark.integration

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
BOUND_BYTES = 300_000_000
RECORDED_BYTES = 500_000_000
"""At least so much is recorded: held in memory as a whole it breaks the bound."""
ROOM_BYTES = 6_000_000_000
SCRIPT = """
import sys
from pathlib import Path
from slamhive.recordings.variants.build import build_variant
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.domain.configuration import VariantStep

folder = Path(sys.argv[1])
size = {"width": 1504, "height": 960, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
sensor = Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", 20.0, calibration=size)
steps = [VariantStep("rate", ("cam0",), {"every": 2}), VariantStep("resolution", ("cam0",), {"scale": 0.9})]
made = folder / f"v{sys.argv[2]}"
made.mkdir()
source = Dataset("d", folder, sys.argv[3], 1.0, (sensor,), None, "sha256:" + 64 * "0")
build_variant(source, steps[-int(sys.argv[2]):], made, lambda fraction, text: None)
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


@pytest.fixture
def folder() -> Iterator[Path]:
    """For recordings and variants of a gigabyte together."""
    with tempfile.TemporaryDirectory(dir=folder_in_memory(ROOM_BYTES)) as name:
        yield Path(name)


@pytest.mark.parametrize(("compression", "chunk"), [(None, 1 << 20), (None, 1 << 30), ("lz4", 1 << 20)])
def test_memory_stays_below_its_bound(folder: Path, compression: str | None, chunk: int) -> None:
    writer = Writer(folder / "d.bag")
    writer.chunk_threshold = chunk
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection("/cam0/image_raw", IMAGE, typestore=STORE)
        for stamp_ns, content in images():
            writer.write(connection, stamp_ns, STORE.serialize_ros1(content, IMAGE))
    assert (folder / "d.bag").stat().st_size > RECORDED_BYTES > BOUND_BYTES
    for steps in (1, 2):
        assert peak_bytes(folder, "d.bag", steps) < BOUND_BYTES


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_memory_stays_below_its_bound_for_ros2(folder: Path, plugin: StoragePlugin) -> None:
    with Writer2(folder / "d", version=8, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/cam0/image_raw", IMAGE, typestore=ROS2)
        for stamp_ns, content in images():
            writer.write(connection, stamp_ns, ROS2.ros1_to_cdr(STORE.serialize_ros1(content, IMAGE), IMAGE))
    assert peak_bytes(folder, "d", 2) < BOUND_BYTES


def images() -> Iterator[tuple[int, Any]]:
    """A little more than ``RECORDED_BYTES``."""
    pixels = np.random.default_rng(0).integers(0, 255, (960, 1504), dtype=np.uint8)
    for frame in range(350):
        stamp_ns = START_NS + frame * 50_000_000
        yield stamp_ns, image(pixels, stamp_ns)


def peak_bytes(folder: Path, bag: str, steps: int) -> int:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder), str(steps), bag],
        cwd=project_root(),
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout) * 1024
