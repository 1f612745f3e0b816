"""The main program of a ``mapping.py``: read the configuration, play the recording, write the results.

Example::

    if __name__ == "__main__":
        sys.exit(run(MyAlgorithm))
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from slamhive.errors import SlamHiveError
from slamhive.files import write_aside
from slamhive.runtime.config import RunConfig, load
from slamhive.runtime.frames import Frame, FrameTimes, write_frames_csv
from slamhive.runtime.paths import RunPaths, find_recording, run_paths
from slamhive.runtime.playback import Player, player_options
from slamhive.runtime.trajectory import Poses, write_trajectory

_PROGRESS_FILE_EVERY_S = 0.5
_PROGRESS_LINE_EVERY_S = 1.0


class Algorithm(Protocol):
    """The interface that a ``mapping.py`` implements."""

    def process(self, frame: Frame) -> bool | None:
        """Take one frame; called in the order of the recording.

        Returns whether its pose was found, None where the algorithm does not say.
        """

    def finish(self) -> Poses:
        """Return the trajectory, after the end of the recording."""

    def about(self) -> dict[str, Any]:
        """What the run should record of the algorithm: package, version, files used."""


MakeAlgorithm = Callable[[RunConfig], Algorithm]


def run(make: MakeAlgorithm) -> int:
    """Run the algorithm that ``make`` builds; returns the exit code. Each known error is one line on stderr."""
    try:
        _run(make, run_paths())
    except SlamHiveError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)  # noqa: T201 - the program's own output
        return 1
    return 0


def _run(make: MakeAlgorithm, paths: RunPaths) -> None:
    config = load(paths.config)
    with Player(player_options(config, find_recording(paths.dataset))) as player:
        algorithm = make(config)
        write_aside(paths.result / "about.json", _json(algorithm.about()))
        processed = _process_all(algorithm, player, paths.result)
    write_aside(paths.result / "playback.json", _json(player.summary))
    write_frames_csv(paths.result / "frames.csv", processed + player.dropped_frames)
    poses = algorithm.finish()
    # Without a pose the file is empty: that the algorithm found none is a result, unlike an exit code.
    write_trajectory(paths.result / "traj.txt", poses)
    _say(f"done: {len(poses.stamps_s)} poses from {len(processed)} frames, {len(player.dropped_frames)} dropped")
    write_aside(paths.result / "finished", "")


def _process_all(algorithm: Algorithm, player: Player, result: Path) -> list[FrameTimes]:
    processed: list[FrameTimes] = []
    progress = _Progress(result / "progress.json", player.frames_total)
    for frame in player.frames():
        tracked = algorithm.process(frame)
        done_s = time.monotonic() - player.start_s
        processed.append(FrameTimes(frame.number, frame.stamp_s, frame.received_s, done_s))
        progress.update(frame, player.dropped, tracked)
    progress.end(len(processed))
    return processed


class _Progress:
    """Writes ``progress.json`` for the controller, and sometimes a line to the log."""

    def __init__(self, path: Path, total: int) -> None:
        self._path = path
        self._total = total
        self._file_at_s = self._line_at_s = time.monotonic()
        self._tracked_at_s: float | None = None
        self._untracked_s: float | None = None
        self._write(0.0, 0)

    def update(self, frame: Frame, dropped: int, tracked: bool | None) -> None:
        self._note(frame.stamp_s, tracked)
        now_s = time.monotonic()
        if now_s - self._file_at_s >= _PROGRESS_FILE_EVERY_S:
            self._file_at_s = now_s
            self._write(frame.fraction, frame.number + 1)
        if now_s - self._line_at_s >= _PROGRESS_LINE_EVERY_S:
            self._line_at_s = now_s
            _say(f"frame {frame.number + 1}/{self._total} ({frame.fraction:.0%}), {dropped} dropped")

    def end(self, frames: int) -> None:
        self._write(1.0, frames)

    def _note(self, stamp_s: float, tracked: bool | None) -> None:
        """Time without a pose, in s of the recording; before the first pose it counts from the first frame."""
        if tracked is None:
            return
        if tracked or self._tracked_at_s is None:
            self._tracked_at_s = stamp_s
        self._untracked_s = round(max(0.0, stamp_s - self._tracked_at_s), 4)

    def _write(self, fraction: float, frames: int) -> None:
        """Renamed into place, but not flushed to the disk: the content is out of date in half a second anyway."""
        aside = self._path.with_name(f".{self._path.name}")
        content = {"fraction": round(min(fraction, 1.0), 4), "frames": frames, "untracked_s": self._untracked_s}
        aside.write_text(_json(content), encoding="ascii")
        os.replace(aside, self._path)  # noqa: PTH105


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201 - the program's own output
