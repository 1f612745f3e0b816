"""Files of run folders that analyses read: evaluated trajectories and sampled resource usage."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slamhive.analysis.plot_types import RunLatency, RunTrack, RunUsage
from slamhive.runs.folder import RunFolder
from slamhive.runs.played_frames import first_frame_s, read_played_frames
from slamhive.runs.untrusted import read_numeric_columns
from slamhive.services.runs import LIMIT_BYTES, gap_of, latency_of, read_track


class StoredRunFiles:
    """Reads the folders of runs; see :class:`slamhive.analysis.plot_types.base.RunFiles`.

    Args:
        runs_folder: Where run folders lie.
        protocols: The fingerprint of the evaluation that each run is shown with.
    """

    def __init__(self, runs_folder: Path, protocols: Mapping[int, str]) -> None:
        self._runs_folder = runs_folder
        self._protocols = protocols

    def track(self, run_id: int) -> RunTrack | None:
        """The evaluated trajectory of a run; None if its evaluation wrote no files."""
        fingerprint = self._protocols.get(run_id)
        if fingerprint is None:
            return None
        evaluation = self._folder(run_id).evaluation(fingerprint)
        estimate = read_track(evaluation / "traj.tum", gap_of(evaluation))
        reference = read_track(evaluation / "groundtruth.tum")
        if estimate is None or reference is None:
            return None
        errors = read_numeric_columns(evaluation / "errors.csv", ("timestamp", "ape_m"), LIMIT_BYTES)
        errors = errors[np.isfinite(errors).all(axis=1)]
        errors_m = np.full(len(estimate.times_s), np.nan)
        if len(errors):
            errors_m = np.interp(estimate.times_s, errors[:, 0], errors[:, 1])
        return RunTrack(
            run_id=run_id,
            stamps_s=estimate.times_s,
            positions_m=estimate.positions_m,
            errors_m=errors_m,
            pieces=estimate.pieces,
            reference_stamps_s=reference.times_s,
            reference_positions_m=reference.positions_m,
        )

    def usage(self, run_id: int, startup_s: float | None) -> RunUsage | None:
        """The sampled usage of a run; None if it was not sampled."""
        folder = self._folder(run_id)
        rows = read_numeric_columns(folder.profiling, ("time", "cpu_usage", "memory_usage"), LIMIT_BYTES)
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) == 0:
            return None
        frames = None if startup_s is None else read_played_frames(folder.frames)
        clock = None if frames is None else frames.clock(startup_s)
        return RunUsage(run_id, rows[:, 0], rows[:, 1], rows[:, 2], clock)

    def latency(self, run_id: int) -> RunLatency | None:
        """The latency of each frame; None if the algorithm does not report when it finishes one."""
        frames = read_played_frames(self._folder(run_id).frames)
        found = None if frames is None else latency_of(frames, 0.0)
        return None if found is None else RunLatency(run_id, found.times_s, found.values)

    def first_frame_s(self, run_id: int) -> float | None:
        """The timestamp of the first frame that was played; None if the run does not say."""
        return first_frame_s(self._folder(run_id).frames)

    def _folder(self, run_id: int) -> RunFolder:
        return RunFolder(self._runs_folder / str(run_id))
