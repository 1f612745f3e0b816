"""The memory of an import does not grow with the recording."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.writers import BagWriter

pytestmark = pytest.mark.integration

WIDTH, HEIGHT, FRAMES = 2000, 1000, 180
MOST_MEMORY_MB = 300
IMPORT = """
import re, sys
from pathlib import Path
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, perform
perform(plan_import(Path(sys.argv[1]), ImportOptions())[1], Path(sys.argv[2]), lambda _fraction, _text: None)
# Not getrusage: a new process inherits the peak of the one that started it.
print(int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1e3)
"""


def test_a_recording_larger_than_the_bound_is_imported(tmp_path: Path) -> None:
    intrinsics = CameraIntrinsics(WIDTH, HEIGHT, 900.0, 900.0, 999.5, 499.5)
    camera = Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", 20.0, calibration=intrinsics.calibration("mono8"))
    source, pixels = tmp_path / "take.bag", np.zeros((HEIGHT, WIDTH), np.uint8)
    with BagWriter(source) as bag:
        for number in range(FRAMES):
            bag.camera_info(camera, "/cam0/camera_info", 10**18 + number * 50_000_000)
            bag.image(camera, 10**18 + number * 50_000_000, pixels, "mono8")
    assert source.stat().st_size > MOST_MEMORY_MB * 1e6
    command = [sys.executable, "-c", IMPORT, str(source), str(tmp_path / "made")]
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert float(ended.stdout) < MOST_MEMORY_MB
