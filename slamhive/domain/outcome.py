"""The outcome of a run: one word for people, the same on every page, in every list and in every file."""

from __future__ import annotations

from enum import StrEnum
from typing import Protocol

from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind

Failure = FailureReason | VerdictKind
"""Why a run counts as failed: its failure reason or its verdict."""


class Judged(Protocol):
    """A run, or a group of runs with the same end. ``judged``: the stored verdict on its evaluation."""

    @property
    def state(self) -> RunState:
        """The state."""

    @property
    def reason(self) -> FailureReason | None:
        """The reason of a failure."""

    @property
    def judged(self) -> VerdictKind | None:
        """The stored verdict."""


class Outcome(StrEnum):
    """The state of a run together with its verdict, as people ask for it.

    A run whose container ended well but that tracked too little, diverged or could not be evaluated has failed. A run
    that was taken away (its node went down, say) is lost: that says nothing about its configuration.
    """

    QUEUED = "queued"
    RUNNING = "running"
    GOOD = "good"
    UNJUDGED = "unjudged"
    FAILED = "failed"
    LOST = "lost"
    CANCELLED = "cancelled"

    @property
    def label(self) -> str:
        """The outcome in words, for the middle of a sentence."""
        return "not evaluated" if self is Outcome.UNJUDGED else self.value

    @property
    def ended(self) -> bool:
        """The run has ended."""
        return self not in (Outcome.QUEUED, Outcome.RUNNING)

    @classmethod
    def of(cls, run: Judged) -> Outcome:
        """The outcome of a run, or of runs with the same end."""
        if run.state is RunState.SUCCEEDED:
            if run.judged is None:
                return cls.UNJUDGED
            return cls.FAILED if run.judged.failed else cls.GOOD
        if run.state is RunState.FAILED:
            return cls.LOST if run.reason is FailureReason.LOST else cls.FAILED
        return {RunState.QUEUED: cls.QUEUED, RunState.CANCELLED: cls.CANCELLED}.get(run.state, cls.RUNNING)


def failure_of(run: Judged) -> Failure | None:
    """Why runs with this end count as failed or lost; None if they do not."""
    if run.state is RunState.FAILED:
        return run.reason or VerdictKind.ENDED_BADLY
    judged = run.judged if run.state is RunState.SUCCEEDED else None
    return judged if judged is not None and judged.failed else None


def failure_words(failure: Failure) -> str:
    """The failure as part of a sentence."""
    return failure.label if isinstance(failure, VerdictKind) else failure.value.replace("_", " ")


def outcome_words(run: Judged) -> str:
    """The outcome with its reason, such as ``failed: out of memory``."""
    outcome, failure = Outcome.of(run), failure_of(run)
    return f"failed: {failure_words(failure)}" if outcome is Outcome.FAILED and failure else outcome.label
