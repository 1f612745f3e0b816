"""A replay: what is recorded in a bundle runs again, and agrees with the record or not."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from enum import StrEnum

from slamhive.domain.gate import FAILURES, Answer, Margin


class Agreement(StrEnum):
    """What a replay says of a metric, or of all."""

    AGREE = "agree"
    DIFFERS = "differs"
    UNDECIDED = "undecided"

    @classmethod
    def of(cls, answer: Answer) -> Agreement:
        """The answer of a check in both directions."""
        return {Answer.PASS: cls.AGREE, Answer.WORSE: cls.DIFFERS, Answer.UNDECIDED: cls.UNDECIDED}[answer]

    @classmethod
    def over(cls, answers: Collection[Agreement]) -> Agreement:
        """The answer over several: one that differs decides, and all have to agree."""
        if cls.DIFFERS in answers:
            return cls.DIFFERS
        return cls.AGREE if answers and set(answers) == {cls.AGREE} else cls.UNDECIDED


DEFAULT_MARGINS: Mapping[str, Margin] = {
    FAILURES: Margin(0.0, relative=False),
    "ate.rmse": Margin(0.10),
    "tracked.path": Margin(0.02, relative=False),
}
"""What a replay compares unless it is asked otherwise: CPU, memory and latency are those of another machine."""
