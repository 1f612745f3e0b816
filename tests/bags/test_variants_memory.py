"""What making a variant takes of memory does not depend on the size of the recording."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from slamhive.project import project_root
from tests.bags.variant_bags import IMAGE, START_NS, STORE, image

pytestmark = pytest.mark.integration

BOUND_BYTES = 300_000_000
SCRIPT = """
import sys
from pathlib import Path
from slamhive.bags.variants.build import build_variant
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.domain.variant import VariantStep

folder = Path(sys.argv[1])
size = {"width": 1504, "height": 960, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
sensor = Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", 20.0, calibration=size)
steps = [VariantStep("rate", ("cam0",), {"every": 2}), VariantStep("resolution", ("cam0",), {"scale": 0.9})]
(folder / "v").mkdir()
source = Dataset("d", folder, "d.bag", 1.0, (sensor,), None, "sha256:" + 64 * "0")
build_variant(source, steps[-int(sys.argv[2]):], folder / "v", lambda fraction, text: None)
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


@pytest.mark.integration
@pytest.mark.parametrize(("compression", "chunk"), [(None, 1 << 20), (None, 1 << 30), ("lz4", 1 << 20)])
@pytest.mark.parametrize("steps", [1, 2])
def test_memory_stays_below_its_bound(tmp_path: Path, compression: str | None, chunk: int, steps: int) -> None:
    writer = Writer(tmp_path / "d.bag")
    writer.chunk_threshold = chunk
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    pixels = np.random.default_rng(0).integers(0, 255, (960, 1504), dtype=np.uint8)
    with writer:
        connection = writer.add_connection("/cam0/image_raw", IMAGE, typestore=STORE)
        for frame in range(350):
            stamp_ns = START_NS + frame * 50_000_000
            writer.write(connection, stamp_ns, STORE.serialize_ros1(image(pixels, stamp_ns), IMAGE))
    assert (tmp_path / "d.bag").stat().st_size > 500_000_000
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path), str(steps)],
        cwd=project_root(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) * 1024 < BOUND_BYTES
