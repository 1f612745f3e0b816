"""The main program of a ``mapping.py``: read the configuration, play the recording, write the results.

Example::

    if __name__ == "__main__":
        sys.exit(run(MyAlgorithm))
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from slamhive.base.files import write_aside
from slamhive.runtime.config import RunConfig, load
from slamhive.runtime.frames import Frame, FrameTimes, write_frames_csv
from slamhive.runtime.paths import RunPaths, find_recording
from slamhive.runtime.playback import Player, player_options
from slamhive.runtime.program import run_program
from slamhive.runtime.progress import Progress, json_text, say
from slamhive.runtime.trajectory import Poses, Trajectories, write_trajectories


class Algorithm(Protocol):
    """The interface that a ``mapping.py`` implements."""

    def process(self, frame: Frame) -> bool | None:
        """Take one frame; called in the order of the recording.

        Returns whether its pose was found, None where the algorithm does not say.
        """

    def finish(self) -> Poses | Trajectories:
        """Return the trajectory, or several, after the end of the recording."""

    def about(self) -> dict[str, Any]:
        """Facts of the algorithm for the record: package, version, files used."""


MakeAlgorithm = Callable[[RunConfig], Algorithm]


def run(make: MakeAlgorithm) -> int:
    """Run the algorithm that ``make`` builds; returns the exit code. Each known error is one line on stderr."""
    return run_program(lambda paths: _run(make, paths))


def _run(make: MakeAlgorithm, paths: RunPaths) -> None:
    config = load(paths.config)
    with Player(player_options(config, find_recording(paths.dataset))) as player:
        algorithm = make(config)
        write_aside(paths.result / "about.json", json_text(algorithm.about()))
        processed: list[FrameTimes] = []
        progress = Progress(paths.result / "progress.json", player.frames_total)
        for frame in player.frames():
            tracked = algorithm.process(frame)
            done_s = time.monotonic() - player.start_s
            processed.append(FrameTimes(frame.number, frame.stamp_s, frame.received_s, done_s))
            progress.update(frame.number + 1, frame.stamp_s, frame.fraction, player.dropped, tracked)
        progress.end(len(processed))
    write_aside(paths.result / "playback.json", json_text(player.summary))
    write_frames_csv(paths.result / "frames.csv", processed + player.dropped_frames)
    # Without a pose the file is empty: that the algorithm found none is a result, unlike an exit code.
    poses = write_trajectories(paths.result, algorithm.finish())
    say(f"done: {len(poses.stamps_s)} poses from {len(processed)} frames, {len(player.dropped_frames)} dropped")
    write_aside(paths.result / "finished", "")
