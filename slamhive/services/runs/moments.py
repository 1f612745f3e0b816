"""One moment of a run: the error there, and what happened to the frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.runs.folder import RunFolder
from slamhive.runs.untrusted import read_numeric_columns
from slamhive.services.runs.series import LIMIT_BYTES, Array
from slamhive.store.records import RunRecord

NEAR_S = 0.5
"""A frame or a pose that is further away says nothing about the moment."""


@dataclass(frozen=True, slots=True)
class FrameFate:
    """A frame that the algorithm was given: ``latency_s`` from its arrival to its result, None if it has none."""

    timestamp_s: float
    dropped: bool
    latency_s: float | None


@dataclass(frozen=True, slots=True)
class Moment:
    """What is known of a run at ``timestamp_s``, a header timestamp: the nearest matched pose and the nearest frame."""

    timestamp_s: float
    error_m: float | None
    frame: FrameFate | None

    @property
    def shown_at_s(self) -> float:
        """The timestamp of what the sensors saw then: the frame's, if there is one."""
        return self.timestamp_s if self.frame is None else self.frame.timestamp_s


def moment_at(run: RunRecord, folder: RunFolder, timestamp_s: float) -> Moment:
    """What the files of a run say of the moment ``timestamp_s``; unreadable files say nothing."""
    error_m = None
    if run.protocol is not None:
        path = folder.evaluation(run.protocol.fingerprint) / "errors.csv"
        errors = read_numeric_columns(path, ("timestamp", "ape_m"), LIMIT_BYTES)
        row = _nearest(errors, timestamp_s)
        error_m = None if row is None else _known(row[1])
    frames = read_numeric_columns(folder.frames, ("timestamp", "received", "done", "dropped"), LIMIT_BYTES)
    row = _nearest(frames, timestamp_s)
    return Moment(timestamp_s, error_m, None if row is None else _fate(row))


def _nearest(rows: Array, timestamp_s: float) -> Array | None:
    """The row whose first column is nearest, None if none is near."""
    if len(rows) == 0:
        return None
    apart_s = np.nan_to_num(np.abs(rows[:, 0] - timestamp_s), nan=np.inf)
    place = int(apart_s.argmin())
    found: Array = rows[place]
    return found if apart_s[place] <= NEAR_S else None


def _fate(row: Array) -> FrameFate:
    latency_s = _known(row[2] - row[1])
    dropped = bool(row[3] == 1)
    return FrameFate(float(row[0]), dropped, None if dropped or latency_s is None or latency_s < 0 else latency_s)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
