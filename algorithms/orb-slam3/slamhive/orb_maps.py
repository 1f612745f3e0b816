"""The maps of ORB-SLAM3: points for ``Map.pcd``, and its atlas, with which another run can start."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slamhive.runtime.paths import MAP_VARIABLE
from slamhive.runtime.program import done_by_child

SESSION = "session.osa"
POINTS_EVERY_S = 0.25
"""The points that frames see are collected this often, in time of the recording: neighbouring frames see the same."""

_ASIDE = ".session.osa"
_MOST_SESSION_BYTES = 500_000_000
_SAVING_LIMIT_S = 120.0
_IDLE_SHARE = 0.1
_IDLE_STEP_S = 0.5
_IDLE_PATIENCE_S = 60.0
_NEW_MAP = re.compile(r"Creation of new map with id: (\d+)")
_OTHER_MAP = re.compile(r"Change to map with id: (\d+)")


class Closable(Protocol):
    """A :class:`pyorbslam3.Slam`."""

    def shutdown(self) -> None:
        """End all threads; save the atlas if the settings say so."""


def atlas_settings(save_to: Path | None, load_from: Path | None) -> str:
    """The lines of the settings file for the atlas. ORB-SLAM3 takes names relative to the working folder only."""
    lines = []
    for key, path in (("System.SaveAtlasToFile", save_to), ("System.LoadAtlasFromFile", load_from)):
        if path is not None:
            lines.append(f'{key}: "{os.path.relpath(path.with_suffix(""))}"')
    return "\n".join(lines)


def input_map() -> Path | None:
    """The atlas that this run starts with."""
    name = os.environ.get(MAP_VARIABLE)
    return None if name is None else Path(name)


def aside_of(result: Path) -> Path:
    """Where ORB-SLAM3 writes the atlas, before it is known to be whole."""
    return result / _ASIDE


def save_session(slam: Closable, result: Path) -> bool:
    """Save the atlas as :data:`SESSION` in ``result``; whether it worked.

    Saving crashes while local mapping still works on the atlas, so this waits until all threads rest. Then a child
    process saves: it has none of the threads, and its crash costs the atlas only.
    """
    _wait_until_idle()
    aside = aside_of(result)
    saved = (
        done_by_child(slam.shutdown, _SAVING_LIMIT_S)
        and aside.is_file()
        and aside.stat().st_size <= _MOST_SESSION_BYTES
    )
    if saved:
        aside.replace(result / SESSION)
    else:
        aside.unlink(missing_ok=True)
    return saved


class MapPoints:
    """Points that frames have seen, in the frame of the camera, so that they follow it when poses are optimised."""

    def __init__(self) -> None:
        self._stamps_s: list[float] = []
        self._points_m: list[NDArray[np.float32]] = []

    def due(self, stamp_s: float) -> bool:
        """True if the points of a frame are wanted."""
        return not self._stamps_s or stamp_s - self._stamps_s[-1] >= POINTS_EVERY_S

    def add(self, stamp_s: float, points_m: NDArray[np.float32], T_world_camera: NDArray[np.float64]) -> None:
        """Add the points, shape (n, 3), world frame, that the frame at ``stamp_s`` has seen."""
        finite = points_m[np.isfinite(points_m).all(axis=1)]
        rotation, position_m = T_world_camera[:3, :3], T_world_camera[:3, 3]
        self._stamps_s.append(stamp_s)
        self._points_m.append(((finite - position_m) @ rotation).astype(np.float32))

    def in_world(self, stamps_s: NDArray[np.float64], T_world_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """All points, shape (n, 3), by the final poses, shape (m, 4, 4); frames without a final pose are left out."""
        places = {stamp_s: place for place, stamp_s in enumerate(stamps_s.tolist())}
        found = [np.empty((0, 3), np.float32)]
        for stamp_s, points_m in zip(self._stamps_s, self._points_m, strict=True):
            if stamp_s in places:
                T = T_world_camera[places[stamp_s]]
                found.append((points_m @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
        return np.concatenate(found)


class Relocalisation:
    """True if ORB-SLAM3 works in the map that it started with, which only its output says.

    It begins a map of its own, and merges it into the other one as soon as it recognises a place.
    """

    def __init__(self) -> None:
        sys.stdout.flush()
        self._terminal = os.dup(1)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the program
        os.dup2(self._file.fileno(), 1)
        self._read = 0
        self._rest = ""
        self._first_own: int | None = None
        self.localised = False

    def look(self) -> bool:
        """Read what was printed since, pass it on, and say whether the run works in the map that it started with."""
        sys.stdout.flush()
        data = os.pread(self._file.fileno(), 1 << 20, self._read)
        self._read += len(data)
        os.write(self._terminal, data)
        *lines, self._rest = (self._rest + data.decode(errors="replace")).split("\n")
        for line in lines:
            self._take(line)
        return self.localised

    def close(self) -> None:
        """Print to the terminal again."""
        self.look()
        os.dup2(self._terminal, 1)
        os.close(self._terminal)
        self._file.close()

    def _take(self, line: str) -> None:
        new, other = _NEW_MAP.search(line), _OTHER_MAP.search(line)
        if new is not None:
            self._first_own = int(new[1]) if self._first_own is None else self._first_own
            self.localised = False
        elif other is not None and self._first_own is not None:
            self.localised = int(other[1]) < self._first_own


def _wait_until_idle() -> None:
    """Wait until the threads of this process use next to no CPU time."""
    end_s = time.monotonic() + _IDLE_PATIENCE_S
    while time.monotonic() < end_s:
        before_s = time.process_time()
        time.sleep(_IDLE_STEP_S)
        if time.process_time() - before_s < _IDLE_SHARE * _IDLE_STEP_S:
            return
