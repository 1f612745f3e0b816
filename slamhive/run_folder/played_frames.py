"""Reads ``frames.csv``: which frame of the recording was played when, and when its result came."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.run_folder.untrusted import FloatArray, read_numeric_columns, read_regular_file

_MAX_BYTES = 64_000_000
_FIRST_LINES_BYTES = 4096


@dataclass(frozen=True, slots=True, eq=False)
class RecordingClock:
    """Converts the time of a run to that of the recording that it played.

    ``run_times_s`` (n,) are the times since the start of the run at which frames were played, ascending.
    ``timestamps_s`` (n,) are the header timestamps of these frames, ascending; n >= 1.
    """

    run_times_s: FloatArray
    timestamps_s: FloatArray

    def timestamps_at(self, run_times_s: FloatArray) -> FloatArray:
        """The header timestamps (m,) in s that were played at times since the start of the run (m,) in s.

        Linear between two frames. Nothing is played before the first frame and after the last one; there, a second of
        the run counts as a second of the recording.
        """
        within = np.interp(run_times_s, self.run_times_s, self.timestamps_s)
        before = np.minimum(run_times_s - self.run_times_s[0], 0.0)
        after = np.maximum(run_times_s - self.run_times_s[-1], 0.0)
        timestamps_s: FloatArray = within + before + after
        return timestamps_s


@dataclass(frozen=True, slots=True, eq=False)
class PlayedFrames:
    """The frames of a run, arrays (n,) in the order of the recording, n >= 1.

    ``timestamps_s`` are header timestamps. ``received_s`` and ``done_s`` count since playback began; ``done_s`` is NaN
    for a frame without a result. ``dropped`` is True for a frame that the algorithm was too slow to take.
    """

    timestamps_s: FloatArray
    received_s: FloatArray
    done_s: FloatArray
    dropped: np.ndarray[tuple[int], np.dtype[np.bool_]]

    def latencies(self) -> tuple[FloatArray, FloatArray]:
        """Timestamps (m,) and latencies (m,) in s of the frames that have a result."""
        known = self.done_s >= self.received_s
        return self.timestamps_s[known], (self.done_s - self.received_s)[known]

    def dropped_timestamps_s(self) -> FloatArray:
        """The timestamps (m,) of the dropped frames, ascending."""
        return np.sort(self.timestamps_s[self.dropped])

    def clock(self, startup_s: float | None) -> RecordingClock | None:
        """The clock of a run whose playback began ``startup_s`` after its start; None if that is not known."""
        known = np.isfinite(self.received_s)
        if startup_s is None or not known.any():
            return None
        order = np.argsort(self.received_s[known], kind="stable")
        received_s, timestamps_s = self.received_s[known][order], self.timestamps_s[known][order]
        return RecordingClock(startup_s + received_s, np.maximum.accumulate(timestamps_s))


def read_played_frames(path: Path) -> PlayedFrames | None:
    """The frames in the ``frames.csv`` at ``path``; None if there are none that can be read."""
    rows = read_numeric_columns(path, ("timestamp", "received", "done", "dropped"), _MAX_BYTES)
    rows = rows[np.isfinite(rows[:, 0])]
    if len(rows) == 0:
        return None
    return PlayedFrames(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] == 1)


def first_frame_s(path: Path) -> float | None:
    """The header timestamp in s of the first line of ``frames.csv``, without reading the others; None without one."""
    data = read_regular_file(path, _FIRST_LINES_BYTES) or b""
    header, *lines = data.decode("utf-8", errors="replace").splitlines()[:2] or [""]
    names = [name.strip() for name in header.split(",")]
    if "timestamp" not in names or not lines:
        return None
    try:
        timestamp_s = float(lines[0].split(",")[names.index("timestamp")])
    except (ValueError, IndexError):
        return None
    return timestamp_s if np.isfinite(timestamp_s) else None
