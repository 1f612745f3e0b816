"""Content of the 3D view of a run: all its trajectories and the ground truth, in one frame."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamhive.base.bounds import read_record
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.protocol import TrajectoryKind, protocol_from_content
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.untrusted import read_numeric_columns
from slamhive.services.evaluations import PROTOCOL_FILE
from slamhive.services.kept_answers import KeptViews
from slamhive.services.runs.series import (
    LIMIT_BYTES,
    MAX_POINTS,
    SAME_TIME_S,
    Array,
    PathSeries,
    TrackFiles,
    gap_of,
    nearest_values,
    read_whole_track,
)
from slamhive.store.records import RunRecord
from slamhive.trajectory.alignment import IDENTITY, Similarity, align_umeyama
from slamhive.trajectory.model import Poses
from slamhive.trajectory.transforms import motion_of

TIME_OFFSET = "alignment.time_offset"
_ALIGNED = "traj.tum"
_MOST_FRAMES = 1000
_FAR_S = 1.0
"""The speed at a pose that is further from any known speed is not known."""
_LARGEST_RESIDUAL = 0.02
"""Of the extent of a trajectory. A larger one means that more than one rigid or similarity transform moved it."""


@dataclass(frozen=True, slots=True)
class ScenePath:
    """A path and what is known at each of its poses.

    Attributes:
        kind: ``ground truth``, ``estimate``, or the kind of an algorithm's trajectory: ``live``.
        track: The path, thinned for a screen.
        speeds_mps: Shape (n,), NaN where unknown.
        errors_m: Position error, shape (n,), NaN where unknown; None if no pose has one.
    """

    kind: str
    track: PathSeries
    speeds_mps: Array
    errors_m: Array | None = None

    def thinned(self, most: int) -> ScenePath:
        """At most ``most`` poses, evenly spaced, with the first and the last."""
        kept = self.track.even_places(most)
        errors_m = None if self.errors_m is None else self.errors_m[kept]
        return ScenePath(self.kind, self.track.thinned(most), self.speeds_mps[kept], errors_m)


@dataclass(frozen=True, slots=True)
class RunScene:
    """The paths of one run in one frame.

    Attributes:
        groundtruth: The ground truth; None without one.
        paths: The evaluated trajectory first, then the others.
        aligned: Whether the paths lie in the frame of the ground truth, otherwise in that of the algorithm.
        to_scene: Moves what is in the algorithm's frame, such as its map; None if that is not known.
        reasons: Why something is not shown, one sentence each.
    """

    groundtruth: ScenePath | None
    paths: tuple[ScenePath, ...]
    aligned: bool
    to_scene: Similarity | None
    reasons: tuple[str, ...]


def run_scene(run: RunRecord, folder: RunFolder, fingerprint: str | None, tracks: TrackFiles | None = None) -> RunScene:
    """The paths of ``run`` under the protocol with this fingerprint; in the algorithm's frame without one."""
    files, tracks = _files(run, folder), tracks or TrackFiles()
    evaluation = None if fingerprint is None else folder.evaluation(fingerprint)
    gap_s = math.inf if evaluation is None else gap_of(evaluation)
    aligned = None if evaluation is None else tracks.track(evaluation / _ALIGNED, gap_s)
    if evaluation is None or aligned is None:
        paths = [_path(kind, track) for kind, track in _read(files, gap_s, tracks).items()]
        reasons = () if paths else ("The run has left no trajectory that can be read.",)
        return RunScene(None, tuple(paths), aligned=False, to_scene=IDENTITY, reasons=reasons)
    kind = _judged_kind(evaluation, run)
    others = _read({name: path for name, path in files.items() if name != kind}, gap_s, tracks)
    raw = None if kind not in files else tracks.track(files[kind])
    offset_s = (run.metrics or {}).get(TIME_OFFSET, 0.0)
    to_scene, problem = _transform(raw, aligned, offset_s)
    moved = [] if to_scene is None else [_moved(track, to_scene, offset_s) for track in others.values()]
    paths = [_path(kind, aligned, tracks.errors(evaluation)), *map(_path, others, moved)]
    truth = tracks.track(evaluation / "groundtruth.tum")
    return RunScene(
        groundtruth=None if truth is None else _path("ground truth", truth),
        paths=tuple(paths),
        aligned=True,
        to_scene=to_scene,
        reasons=(problem,) if problem else (),
    )


@dataclass(frozen=True, slots=True)
class SceneFrame:
    """Where the map of a run lies in its 3D view: ``aligned`` and ``to_scene`` as in :class:`RunScene`."""

    aligned: bool
    to_scene: Similarity | None


_OWN_FRAME = SceneFrame(aligned=False, to_scene=IDENTITY)


class SceneFrames:
    """The frames of the 3D views of runs. Those asked for last are kept: a fit reads two whole trajectories."""

    def __init__(self) -> None:
        self._kept: KeptViews[object, SceneFrame] = KeptViews(_MOST_FRAMES, lambda _: 1)

    def get(self, run: RunRecord, folder: RunFolder, fingerprint: str | None) -> SceneFrame:
        """Find the same as :func:`run_scene`, from its two trajectories alone."""
        if fingerprint is None:
            return _OWN_FRAME
        evaluation = folder.evaluation(fingerprint)
        raw_path = _files(run, folder).get(_judged_kind(evaluation, run))
        offset_s = (run.metrics or {}).get(TIME_OFFSET, 0.0)

        def read() -> SceneFrame:
            aligned = read_whole_track(evaluation / _ALIGNED)
            if aligned is None:
                return _OWN_FRAME
            raw = None if raw_path is None else read_whole_track(raw_path)
            return SceneFrame(aligned=True, to_scene=_transform(raw, aligned, offset_s)[0])

        return self._kept.get((_stamp(evaluation / _ALIGNED), _stamp(raw_path), offset_s), read)


def _stamp(path: Path | None) -> object:
    """A mark that changes with the file at ``path``."""
    try:
        status = None if path is None else os.lstat(path)
    except OSError:
        status = None
    return path, None if status is None else (status.st_mtime_ns, status.st_size, status.st_ino)


def path_of(kind: str, path: Path) -> ScenePath | None:
    """The trajectory at ``path`` as a path of a scene; None if it cannot be read."""
    track = read_whole_track(path)
    return None if track is None else _path(kind, track)


def _files(run: RunRecord, folder: RunFolder) -> dict[str, Path]:
    """{kind: trajectory file that may exist}; ``traj.txt`` first."""
    further = {kind.value: folder.trajectory_of(kind) for kind in TrajectoryKind if kind is not run.trajectory}
    return {_own_kind(run): folder.trajectory} | further


def _own_kind(run: RunRecord) -> str:
    return "estimate" if run.trajectory is None else run.trajectory.value


def _judged_kind(evaluation: Path, run: RunRecord) -> str:
    """The kind of the trajectory that an evaluation judged."""
    try:
        judged = protocol_from_content(read_record(evaluation / PROTOCOL_FILE)).trajectory
    except SlamHiveError:
        judged = None
    return _own_kind(run) if judged is None else judged.value


def _read(files: dict[str, Path], gap_s: float, tracks: TrackFiles) -> dict[str, PathSeries]:
    found = {kind: tracks.track(path, gap_s) for kind, path in files.items()}
    return {kind: track for kind, track in found.items() if track is not None}


def _transform(raw: PathSeries | None, aligned: PathSeries, offset_s: float) -> tuple[Similarity | None, str]:
    """The transform of the trajectory onto the ground truth; otherwise None, and why.

    The evaluation files the moved poses, not the transform. All matched poses are moved by one transform, so that a fit
    finds it to the precision of the file.
    """
    why = "Other trajectories and the map are not shown: what moved the trajectory to the ground truth is not known."
    if raw is None:
        return None, why
    at_s = aligned.times_s - offset_s
    order = np.argsort(raw.times_s, kind="stable")
    there_m = np.column_stack([np.interp(at_s, raw.times_s[order], axis_m[order]) for axis_m in raw.positions_m.T])
    try:
        found = align_umeyama(there_m, aligned.positions_m, scaled=True)
    except InvalidInput:
        return None, why
    apart_m = np.linalg.norm(found.points(there_m) - aligned.positions_m, axis=1)
    extent_m = float(np.ptp(aligned.positions_m, axis=0).max())
    fits = float(np.sqrt((apart_m**2).mean())) <= _LARGEST_RESIDUAL * extent_m
    return (found, "") if fits else (None, why)


def _moved(track: PathSeries, to_scene: Similarity, offset_s: float) -> PathSeries:
    return replace(track, times_s=track.times_s + offset_s, positions_m=to_scene.points(track.positions_m))


def _path(kind: str, whole: PathSeries, errors: Array | None = None) -> ScenePath:
    track = whole.thinned(MAX_POINTS)
    errors_m = None if errors is None else nearest_values(errors[:, 0], errors[:, 1], track.times_s, SAME_TIME_S)
    # The speed comes from all poses, also of those that are not drawn.
    order = np.argsort(whole.times_s, kind="stable")
    no_turns = np.tile((0.0, 0.0, 0.0, 1.0), (len(order), 1))
    motion = motion_of(Poses(whole.times_s[order], whole.positions_m[order], no_turns))
    speeds_mps = nearest_values(motion.times_s, motion.speeds_mps, track.times_s, _FAR_S)
    return ScenePath(kind, track, speeds_mps, errors_m)


# One moment of a run: the error there, and what happened to the frame.


NEAR_S = 0.5
"""A frame or a pose that is further away says nothing about the moment."""
_LEAST_NEAR_S = 0.05
"""One that is at most so far away says something, however dense the others are."""


@dataclass(frozen=True, slots=True)
class FrameFate:
    """A frame that the algorithm was given: ``latency_s`` from its arrival to its result, None if it has none."""

    timestamp_s: float
    dropped: bool
    latency_s: float | None


@dataclass(frozen=True, slots=True)
class Moment:
    """Knowledge of a run at ``timestamp_s``, a header timestamp: the nearest matched pose and the nearest frame."""

    timestamp_s: float
    error_m: float | None
    frame: FrameFate | None

    @property
    def shown_at_s(self) -> float:
        """The timestamp of what the sensors saw then: the frame's, if there is one."""
        return self.timestamp_s if self.frame is None else self.frame.timestamp_s


def moment_at(run: RunRecord, folder: RunFolder, timestamp_s: float, fingerprint: str | None = None) -> Moment:
    """Read the moment ``timestamp_s`` from the files of a run; unreadable files say nothing.

    The error is that under the current protocol, or the one with this fingerprint.
    """
    error_m = None
    if fingerprint is None and run.protocol is not None:
        fingerprint = run.protocol.fingerprint
    if fingerprint is not None:
        path = folder.evaluation(fingerprint) / "errors.csv"
        errors = read_numeric_columns(path, ("timestamp", "ape_m"), LIMIT_BYTES)
        row = _nearest(errors, timestamp_s)
        error_m = None if row is None else _known(row[1])
    frames = read_numeric_columns(folder.frames, ("timestamp", "received", "done", "dropped"), LIMIT_BYTES)
    row = _nearest(frames, timestamp_s)
    return Moment(timestamp_s, error_m, None if row is None else _fate(row))


def _nearest(rows: Array, timestamp_s: float) -> Array | None:
    """The row whose first column is nearest; None if it is a whole step away, where nothing is known."""
    if len(rows) == 0:
        return None
    step_s = float(np.nanmedian(np.diff(rows[:, 0]))) if len(rows) > 1 else 0.0
    near_s = min(NEAR_S, max(step_s, _LEAST_NEAR_S))
    apart_s = np.nan_to_num(np.abs(rows[:, 0] - timestamp_s), nan=np.inf)
    place = int(apart_s.argmin())
    found: Array = rows[place]
    return found if apart_s[place] <= near_s else None


def _fate(row: Array) -> FrameFate:
    latency_s = _known(row[2] - row[1])
    dropped = bool(row[3] == 1)
    return FrameFate(float(row[0]), dropped, None if dropped or latency_s is None or latency_s < 0 else latency_s)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
