"""A mapping run: its states, the reasons it can fail for, and the one table of legal moves."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from slamhive.errors import Conflict


class RunState(StrEnum):
    """Where a run is in its life."""

    QUEUED = "queued"
    PREPARING = "preparing"
    STARTING = "starting"
    RUNNING = "running"
    COLLECTING = "collecting"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def ended(self) -> bool:
        """Nothing follows this state (a retry is a new run)."""
        return self in _ENDED

    @property
    def active(self) -> bool:
        """A worker holds the run."""
        return not self.ended and self is not RunState.QUEUED


class FailureReason(StrEnum):
    """Why a run failed."""

    IMAGE_MISSING = "image_missing"
    PREPROCESS_ERROR = "preprocess_error"
    START_ERROR = "start_error"
    NONZERO_EXIT = "nonzero_exit"
    PLAYER_FAILED = "player_failed"
    TIMEOUT = "timeout"
    OUT_OF_MEMORY = "out_of_memory"
    DISK_LIMIT = "disk_limit"
    PROCESS_LIMIT = "process_limit"
    NO_TRAJECTORY = "no_trajectory"
    EMPTY_TRAJECTORY = "empty_trajectory"
    MALFORMED_TRAJECTORY = "malformed_trajectory"
    LOST = "lost"
    LOST_TRACKING = "lost_tracking"
    MEMORY_BUDGET = "memory_budget"
    TIME_BUDGET = "time_budget"
    CONFIGURATION_FAILED = "configuration_failed"

    @property
    def blames_configuration(self) -> bool:
        """The failure counts against the run's configuration: it was tried, and nothing took the run away."""
        return self not in _NOT_THE_CONFIGURATION


_NOT_THE_CONFIGURATION = frozenset({FailureReason.LOST, FailureReason.CONFIGURATION_FAILED})


REMEDIES: dict[FailureReason, str] = {
    FailureReason.IMAGE_MISSING: "build the package with slamhive algorithm build, whose output shows what is missing",
    FailureReason.PREPROCESS_ERROR: "check the dataset with slamhive dataset check, and the free disk space",
    FailureReason.START_ERROR: "slamhive doctor checks the executor",
    FailureReason.NONZERO_EXIT: "read the end of the log; correct the parameters or the package, then retry",
    FailureReason.PLAYER_FAILED: "check the recording with slamhive dataset check",
    FailureReason.TIMEOUT: "allow more time (--timeout or RUN_TIMEOUT_FACTOR), or reduce the work per frame",
    FailureReason.OUT_OF_MEMORY: "allow more memory (--memory or RUN_MEMORY_MB), or reduce what the algorithm keeps",
    FailureReason.DISK_LIMIT: "make the algorithm save less, or raise RUN_DISK_MB or RUN_FILES",
    FailureReason.PROCESS_LIMIT: "let the algorithm start fewer threads, or raise RUN_PIDS",
    FailureReason.NO_TRAJECTORY: "read the log: the algorithm may never have initialised; try sequential playback",
    FailureReason.EMPTY_TRAJECTORY: "read the log: the algorithm may never have initialised; try sequential playback",
    FailureReason.MALFORMED_TRAJECTORY: "correct how the package writes traj.txt: see the container contract",
    FailureReason.LOST: "retry; slamhive doctor checks the executor",
    FailureReason.LOST_TRACKING: "try other parameters, or allow longer gaps with stop_when",
    FailureReason.MEMORY_BUDGET: "try other parameters, or raise the memory of stop_when",
    FailureReason.TIME_BUDGET: "try other parameters, or raise the time of stop_when",
    FailureReason.CONFIGURATION_FAILED: "look at the earlier runs of this configuration, which failed",
}
"""What to do about each reason."""

_ENDED = frozenset({RunState.SUCCEEDED, RunState.FAILED, RunState.CANCELLED})

_S = RunState
LEGAL_MOVES: dict[RunState, frozenset[RunState]] = {
    _S.QUEUED: frozenset({_S.PREPARING, _S.CANCELLED}),
    _S.PREPARING: frozenset({_S.STARTING, _S.FAILED, _S.CANCELLING, _S.QUEUED}),
    _S.STARTING: frozenset({_S.RUNNING, _S.FAILED, _S.CANCELLING}),
    _S.RUNNING: frozenset({_S.COLLECTING, _S.FAILED, _S.CANCELLING}),
    _S.COLLECTING: frozenset({_S.SUCCEEDED, _S.FAILED}),
    _S.CANCELLING: frozenset({_S.CANCELLED}),
    _S.SUCCEEDED: frozenset(),
    _S.FAILED: frozenset(),
    _S.CANCELLED: frozenset(),
}
"""The one table of legal moves. A worker that died in a state is followed by one that goes on from that state."""


def check_move(run_id: int, current: RunState, target: RunState) -> None:
    """Raise Conflict if a run may not go from ``current`` to ``target``."""
    if target not in LEGAL_MOVES[current]:
        raise Conflict(f"run {run_id} is {current}, it cannot become {target}")


@dataclass(frozen=True, slots=True)
class RunEvent:
    """One move of a run: when (UTC), from where, to where, and why."""

    at: datetime
    from_state: RunState | None
    to_state: RunState
    why: str
