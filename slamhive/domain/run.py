"""A mapping run: its states, the reasons it can fail for, and the one table of legal moves."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from enum import StrEnum
from typing import Any

from slamhive.base.errors import Conflict, InvalidInput


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
    def before_start(self) -> bool:
        """True if the algorithm never ran: its package or its data could not be made ready."""
        return self in _BEFORE_START

    @property
    def blames_configuration(self) -> bool:
        """The failure counts against the run's configuration: it was tried, and nothing took the run away."""
        return self not in _NOT_THE_CONFIGURATION


_BEFORE_START = frozenset({FailureReason.IMAGE_MISSING, FailureReason.PREPROCESS_ERROR, FailureReason.START_ERROR})
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


# The machine that a run was measured on.


@dataclass(frozen=True, slots=True)
class Host:
    """A machine, identified by its ``fingerprint``. ``cpu_count`` counts logical cores."""

    cpu_model: str
    cpu_count: int
    memory_bytes: int
    kernel: str
    os: str

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the content, in hex."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


# What people write about a run: a note and tags.


LONGEST_NOTE = 10_000
LONGEST_TAG = 64
MOST_TAGS = 20
_TAG = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class RunNotes:
    """The note of a run, empty for none, and its tags in order."""

    note: str = ""
    tags: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.note or self.tags)

    @property
    def content(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"note": self.note, "tags": list(self.tags)}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> RunNotes:
        """From :attr:`content`, which anybody may have edited; raises InvalidInput."""
        note, tags = content.get("note", ""), content.get("tags", [])
        if not isinstance(note, str) or not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):
            raise InvalidInput("a note is a text, and tags are a list of texts")
        return checked_notes(note, tags)


NO_NOTES = RunNotes()


@dataclass(frozen=True, slots=True)
class NotesChange:
    """A change: a new ``note`` (None keeps it), tags to ``add``, and tags to ``remove``."""

    note: str | None = None
    add: tuple[str, ...] = ()
    remove: tuple[str, ...] = ()

    def applied(self, notes: RunNotes) -> RunNotes:
        """The notes after the change; raises InvalidInput for what cannot be kept."""
        kept = [tag for tag in notes.tags if tag not in self.remove]
        changed = checked_notes(notes.note if self.note is None else self.note, [*kept, *self.add])
        return replace(changed, tags=tuple(sorted(changed.tags)))


def checked_notes(note: str, tags: list[str]) -> RunNotes:
    """The notes; raises InvalidInput naming what cannot be kept."""
    text = note.replace("\r\n", "\n").strip()
    if len(text) > LONGEST_NOTE:
        raise InvalidInput(f"the note has {len(text)} characters", f"use at most {LONGEST_NOTE}")
    for tag in tags:
        if len(tag) > LONGEST_TAG or not _TAG.fullmatch(tag):
            remedy = f"use at most {LONGEST_TAG} letters, digits, '_', '.' and '-', the first a letter or digit"
            raise InvalidInput(f"{tag[:80]!r} is not a tag", remedy)
    own = tuple(dict.fromkeys(tags))
    if len(own) > MOST_TAGS:
        raise InvalidInput(f"{len(own)} tags are too many", f"use at most {MOST_TAGS} for each run")
    return RunNotes(text, own)


def split_tags(text: str) -> tuple[str, ...]:
    """The tags in a text with spaces or commas between them."""
    return tuple(dict.fromkeys(part for part in re.split(r"[\s,]+", text) if part))
