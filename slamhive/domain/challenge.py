"""A challenge: phases, what a trajectory counts, and the only words that a submitter hears of a failure."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from slamhive.domain.run import FailureReason


class Rule(StrEnum):
    """Rule that turns the values of sequences into one score."""

    MEAN = "mean"
    """Mean over sequences."""
    AREA = "area"
    """Area under the curve "share of sequences below x", from 0 to the worst value, as a percentage of all of it."""
    POOLED = "pooled"
    """Mean over the segments of all sequences together."""


class Format(StrEnum):
    """The format of trajectories."""

    TUM = "tum"
    KITTI = "kitti"


class Counted(StrEnum):
    """Choice of a team's submission to rank."""

    BEST = "best"
    LAST = "last"


class Reveal(StrEnum):
    """Time at which the scores of a phase are shown."""

    AT_ONCE = "at_once"
    AT_END = "at_end"


class PhaseState(StrEnum):
    """State of a phase: taking submissions or not."""

    COMING = "coming"
    OPEN = "open"
    ENDED = "ended"


class SubmissionState(StrEnum):
    """Where a submission is on its way."""

    QUEUED = "queued"
    """It waits, runs or has been evaluated: which of these, only the organiser knows."""
    EVALUATED = "evaluated"
    FAILED = "failed"
    CANCELLED = "cancelled"


class Taken(StrEnum):
    """Kind of submission that a phase takes."""

    TRAJECTORIES = "trajectories"
    IMAGES = "images"


class Failure(StrEnum):
    """All that is said of a failed evaluation. Its own words could quote the ground truth, so nobody hears them."""

    NOT_COMPARABLE = "a trajectory could not be compared with the ground truth"
    TOO_LITTLE = "no trajectory covers as much of its sequence as the challenge asks for"
    NO_ANSWER = "the evaluation ended without an answer; ask the organiser"
    CANCELLED = "it was cancelled"
    NO_RUN = "no run of the image left a trajectory that counts"


class RunFailure(StrEnum):
    """All that is said of a run on a secret recording. An image chooses how it fails, so few words carry few bits."""

    CRASHED = "the image ended with an error"
    LIMIT = "it exceeded a limit of time, memory, disk or processes"
    NO_TRAJECTORY = "it left no usable trajectory"
    TOO_LITTLE = "its trajectory does not cover as much as the challenge asks for"
    NOT_COMPARABLE = "its trajectory could not be compared with the ground truth"
    NOT_FITTING = "the package does not fit the recording"
    ORGANISER = "the run could not be done; ask the organiser"

    @classmethod
    def of(cls, reason: FailureReason | None) -> RunFailure:
        """The words for the reason of a failed run."""
        return _IN_FEW_WORDS.get(reason, cls.ORGANISER) if reason is not None else cls.ORGANISER


_IN_FEW_WORDS = {
    **dict.fromkeys((FailureReason.NONZERO_EXIT, FailureReason.PLAYER_FAILED), RunFailure.CRASHED),
    **dict.fromkeys(
        (
            FailureReason.TIMEOUT,
            FailureReason.OUT_OF_MEMORY,
            FailureReason.DISK_LIMIT,
            FailureReason.PROCESS_LIMIT,
        ),
        RunFailure.LIMIT,
    ),
    **dict.fromkeys(
        (FailureReason.NO_TRAJECTORY, FailureReason.EMPTY_TRAJECTORY, FailureReason.MALFORMED_TRAJECTORY),
        RunFailure.NO_TRAJECTORY,
    ),
}


def phase_state(begins: datetime | None, ends: datetime | None, now: datetime) -> PhaseState:
    """Tell if a phase takes submissions at ``now``; None means no limit on that side."""
    if ends is not None and now >= ends:
        return PhaseState.ENDED
    return PhaseState.COMING if begins is not None and now < begins else PhaseState.OPEN


def rounded(value: float, digits: int) -> float:
    """``value`` with so many significant digits."""
    return float(f"{value:.{digits}g}")


def shown(value: float, digits: int) -> str:
    """A rounded value with all its significant digits: ``0.110``."""
    return f"{value:#.{digits}g}".removesuffix(".")


@dataclass(frozen=True, slots=True)
class Scoring:
    """Scores of the values of sequences.

    Attributes:
        rule: How they become one score.
        worst: The value of a sequence without one; others are not worse than that. None if every one is needed.
        higher_is_better: Of the values.
    """

    rule: Rule
    worst: float | None
    higher_is_better: bool

    @property
    def higher_wins(self) -> bool:
        """Tell if a higher score is better: an area grows as errors shrink."""
        return self.higher_is_better or self.rule is Rule.AREA

    def points(self, value: float | None) -> float | None:
        """Score of the value of one sequence; None if it is needed and missing."""
        if self.worst is None:
            return value
        if value is None:
            value = self.worst
        kept = max(value, self.worst) if self.higher_is_better else min(value, self.worst)
        return 100.0 * (self.worst - kept) / self.worst if self.rule is Rule.AREA else kept

    def is_better(self, score: float, other: float) -> bool:
        """Tell if ``score`` beats ``other``."""
        return score > other if self.higher_wins else score < other
