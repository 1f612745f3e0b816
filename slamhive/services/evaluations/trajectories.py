"""Which file of a run an evaluation reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slamhive.domain.protocol import Protocol
from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.errors import InvalidInput
from slamhive.runs.folder import RunFolder
from slamhive.store import RunRecord


def protocols_of_all(run: RunRecord, folder: RunFolder, protocol: Protocol) -> list[Protocol]:
    """``protocol``, and the same for each other trajectory that the run left."""
    if protocol.trajectory is not None:
        return [protocol]
    return [protocol, *(replace(protocol, trajectory=kind) for kind in other_trajectories(run, folder))]


def other_trajectories(run: RunRecord, folder: RunFolder) -> list[TrajectoryKind]:
    """The kinds that the run left besides ``traj.txt``."""
    return [kind for kind in TrajectoryKind if kind is not run.trajectory and _has_poses(folder.trajectory_of(kind))]


def estimate_of(run: RunRecord, folder: RunFolder, protocol: Protocol) -> Path:
    """The trajectory that ``protocol`` judges; raises InvalidInput if the run has none of that kind."""
    kind = protocol.trajectory
    if kind is None or kind is run.trajectory:
        return folder.trajectory
    others = other_trajectories(run, folder)
    if kind not in others:
        has = ", ".join(filter(None, (run.trajectory or "traj.txt, whose kind is not stated", *others)))
        raise InvalidInput(
            f"run {run.id} has no {kind.adjective} trajectory; it has {has}",
            "evaluate under a protocol without 'trajectory'",
        )
    return folder.trajectory_of(kind)


def _has_poses(path: Path) -> bool:
    try:
        return path.stat().st_size > 0
    except OSError:
        return False
