"""A gate of continuous integration: its answers and margins."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction, metric

FAILURES = "failures"
"""The name of the share of failed runs, which is compared like a metric."""

SIGNIFICANCE = 0.05
"""The largest chance of a false alarm in one check, over all its metrics and looks."""

_NUMBER = r"\d{1,9}(?:\.\d{1,9})?"
_MARGIN = re.compile(rf"({_NUMBER})\s*(%?)")
_SHOWN = 40


class Answer(StrEnum):
    """Verdict of a gate on one metric, or on all."""

    PASS = "pass"  # noqa: S105 - an answer
    WORSE = "worse"
    UNDECIDED = "undecided"

    @classmethod
    def over(cls, answers: Collection[Answer]) -> Answer:
        """The answer over several: one that is worse decides, and all have to pass."""
        if cls.WORSE in answers:
            return cls.WORSE
        return cls.PASS if answers and set(answers) == {cls.PASS} else cls.UNDECIDED


@dataclass(frozen=True, slots=True)
class Margin:
    """By how much a metric may become worse: a share of the baseline if ``relative``, else in the metric's unit."""

    value: float
    relative: bool = True

    def words(self, unit: str = "") -> str:
        """``5 %``, ``0.01 m``."""
        if self.relative:
            return f"{100 * self.value:.4g} %"
        return f"{self.value:.4g} {unit}".strip()


DEFAULT_MARGINS: Mapping[str, Margin] = {
    FAILURES: Margin(0.0, relative=False),
    "ate.rmse": Margin(0.05),
    "tracked.path": Margin(0.02, relative=False),
    "cpu.per_data_second": Margin(0.10),
    "ram.max": Margin(0.10),
    "latency.p95": Margin(0.15),
}
"""What a check compares unless it is asked otherwise, as far as the baseline has values."""

INSTEAD = {"cpu.per_data_second": "cpu.mean", "tracked.path": "tracked_fraction"}
"""What takes the place of a metric by default where the baseline has no values of it."""


def chosen_margins(
    asked: Sequence[str], measured: Collection[str], defaults: Mapping[str, Margin] = DEFAULT_MARGINS
) -> dict[str, Margin]:
    """The margins of a check by metric: the defaults, changed as ``asked``.

    Args:
        asked: Texts such as ``ate.rmse=5%``, ``tracked.path=0.01`` or ``latency.p95=off``.
        measured: The metrics that the baseline has values of.
        defaults: What is compared unless it is asked otherwise.

    Raises:
        NotFound: a metric is unknown.
        InvalidInput: a text is not clear, or the baseline has no value of a metric that was asked for.
    """
    margins: dict[str, Margin] = {}
    for key, margin in defaults.items():
        found = key if key in measured or key == FAILURES else INSTEAD.get(key, key)
        if found in measured or found == FAILURES:
            margins[found] = margin
    for text in asked:
        key, changed = _read_margin(text)
        if changed is None:
            margins.pop(key, None)
            continue
        if key != FAILURES and key not in measured:
            raise InvalidInput(f"the baseline has no values of {key}", f"it has {', '.join(sorted(measured))}")
        margins[key] = changed
    if not margins:
        raise InvalidInput("no metric is left to compare", "leave out a --margin that is off")
    return margins


def _read_margin(text: str) -> tuple[str, Margin | None]:
    key, sign, value = (part.strip() for part in text.partition("="))
    if not sign:
        raise InvalidInput(f"--margin {text[:_SHOWN]!r} is not clear", "write METRIC=MARGIN, for example ate.rmse=5%")
    if key != FAILURES and metric(key).direction is Direction.NEUTRAL:
        raise InvalidInput(f"{key} cannot become worse: no direction of it is better", "use another metric")
    if value == "off":
        return key, None
    found = _MARGIN.fullmatch(value)
    if found is None:
        raise InvalidInput(
            f"margin {value[:_SHOWN]!r} of {key} is not allowed", "use a share such as 5%, a number, or off"
        )
    if key == FAILURES:
        return key, Margin(float(found[1]) / (100 if found[2] else 1), relative=False)
    return key, Margin(float(found[1]) / 100) if found[2] else Margin(float(found[1]), relative=False)


# A search for the commit that made runs worse, or for the clip that shows it.


class TrialStanding(StrEnum):
    """TrialStanding of a commit, or of a clip. ``skipped``: nothing can be said of it."""

    GOOD = "good"
    BAD = "bad"
    SKIPPED = "skipped"


class BisectOutcome(StrEnum):
    """Outcome of a search for the first bad commit. ``several``: those that were skipped cannot be told apart."""

    FOUND = "found"
    SEVERAL = "several"
    UNDECIDED = "undecided"


# A replay: what is recorded in a bundle runs again, and agrees with the record or not.


class Agreement(StrEnum):
    """Verdict of a replay on one metric, or on all."""

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


REPLAY_MARGINS: Mapping[str, Margin] = {
    FAILURES: Margin(0.0, relative=False),
    "ate.rmse": Margin(0.10),
    "tracked.path": Margin(0.02, relative=False),
}
"""What a replay compares unless it is asked otherwise: CPU, memory and latency are those of another machine."""
