"""MRPT's icp-slam under the container contract: laser scans and odometry in, the poses of the laser out."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rawlog import RawlogWriter

from slamhive.base.debian import install_command
from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.trajectory import Poses

PROGRAM = "icp-slam"
TEMPLATE = Path(__file__).with_name("template.ini")
LAST_LINES = 3


class IcpSlam2d:
    """Writes the recording to a log of MRPT, and runs ``icp-slam`` on it once the recording has ended."""

    def __init__(self, config: RunConfig) -> None:
        values = config.parameters
        self._work = tempfile.TemporaryDirectory(prefix="icp-slam-2d-")
        self._folder = Path(self._work.name)
        self._T_body_laser = transform(values, "odometry", "laser")
        self._log = (self._folder / "recording.rawlog").open("wb")
        self._writer = RawlogWriter(self._log, self._T_body_laser, float(values.get("laser_maximum_range_m", 81.0)))
        self._settings = TEMPLATE.read_text(encoding="ascii").format(
            rawlog=self._log.name,
            output=self._folder / "out",
            **{key: _ini(value) for key, value in values.items() if isinstance(value, bool | int | float)},
        )
        self._entries_s: list[float] = []
        self._scans: list[int] = []

    def process(self, frame: Frame) -> None:
        """Write the odometry since the last scan, then the scan."""
        for row in frame.odometry[:, :8]:
            stamp_s, x_m, y_m = row[:3]
            self._writer.odometry(stamp_s, x_m, y_m, _yaw_rad(row[4:8]))
            self._entries_s.append(stamp_s)
        self._writer.scan(frame.stamp_s, frame.laser_scan("laser"))
        self._scans.append(len(self._entries_s))
        self._entries_s.append(frame.stamp_s)

    def finish(self) -> Poses:
        """Run the program; one pose of the laser for each scan."""
        self._log.close()
        settings = self._folder / "icp-slam.ini"
        settings.write_text(self._settings, encoding="ascii")
        _run(settings)
        table = np.loadtxt(self._folder / "out" / "log_estimated_path.txt", ndmin=2)
        # The first column is the number of the log's entry. Only poses after a scan are corrected by it.
        after_scan = np.isin(table[:, 0].astype(int), self._scans)
        steps = table[after_scan]
        T_world_body = np.tile(np.eye(4), (len(steps), 1, 1))
        cos, sin = np.cos(steps[:, 3]), np.sin(steps[:, 3])
        T_world_body[:, :2, :2] = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
        T_world_body[:, :2, 3] = steps[:, 1:3]
        stamps_s = np.array(self._entries_s)[steps[:, 0].astype(int)]
        return Poses(stamps_s, T_world_body @ self._T_body_laser)

    def about(self) -> dict[str, Any]:
        """The package that runs, as Debian numbers it."""
        asked = subprocess.run(
            ["dpkg-query", "--show", "--showformat=${Version}", "mrpt-apps"],  # noqa: S607 - the image has one
            capture_output=True,
            text=True,
            check=False,
        )
        return {"package": "mrpt-apps", "version": asked.stdout or None}


def _run(settings: Path) -> None:
    try:
        ended = subprocess.run(
            [PROGRAM, str(settings)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
    except FileNotFoundError:
        raise InvalidInput(f"the program {PROGRAM} is not installed", install_command(["mrpt-apps"])) from None
    # Its exit code is 0 after an exception too.
    lines = ended.stdout.splitlines()
    failed = [number for number, line in enumerate(lines) if "MRPT exception" in line]
    if ended.returncode != 0 or failed:
        words = lines[failed[0] + 1 :][:LAST_LINES] if failed else lines[-LAST_LINES:]
        raise InvalidInput(f"{PROGRAM} failed: {' | '.join(words)}")


def _yaw_rad(quat_xyzw: np.ndarray) -> float:
    x, y, z, w = quat_xyzw
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _ini(value: float) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


if __name__ == "__main__":
    sys.exit(run(IcpSlam2d))
