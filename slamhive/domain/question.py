"""Questions that an experiment answers with as few runs as it can, and budgets of runs or time."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum

from slamhive.base.errors import InvalidInput
from slamhive.domain.names import plural


class ExperimentQuestion(StrEnum):
    """Kind of question of an experiment that chooses its runs."""

    DECIDE = "decide"
    OPTIMISE = "optimise"


class SearchSampler(StrEnum):
    """Whoever chooses the next runs of a search: the model of SLAM Hive, or one of Optuna's samplers."""

    MODEL = "model"
    TPE = "tpe"
    NSGA2 = "nsga2"


class CandidateStanding(StrEnum):
    """Standing of a candidate."""

    BEST = "best"
    LEFT = "left"
    BEATEN = "beaten"
    ASIDE = "set aside"


class QuestionAnswer(StrEnum):
    """The answer of an experiment to its question. ``open``: runs go on."""

    BEST = "best"
    SAME = "no difference that matters"
    UNDECIDED = "undecided"
    OPEN = "open"


# The budget of an answer: a number of runs, or a time.


MOST_RUNS = 10_000
_NUMBER = r"\d{1,9}(?:\.\d{1,9})?"
_BUDGET = re.compile(rf"({_NUMBER})\s*([a-z]+)")
_UNITS_S = {"s": 1.0, "min": 60.0, "minutes": 60.0, "h": 3600.0, "hours": 3600.0}
_LARGEST_S = 30 * 86_400.0
_SHOWN = 40


@dataclass(frozen=True, slots=True)
class RunBudget:
    """A budget of runs: their number, or the time that they may take. One of the two is None."""

    runs: int | None = None
    time_s: float | None = None

    @property
    def words(self) -> str:
        """``20 runs``, ``30 min``, ``90 s``, ``2.5 h``."""
        if self.runs is not None:
            return plural(self.runs, "run")
        return time_words(self.time_s or 0.0)

    def runs_left(self, spent: int, elapsed_s: float) -> int:
        """Number of further runs that fit, if they take as long as the ``spent`` ones: ``elapsed_s`` together."""
        if self.runs is not None:
            return max(0, self.runs - spent)
        if spent == 0:
            return MOST_RUNS
        left_s = (self.time_s or 0.0) - elapsed_s
        return max(0, math.floor(left_s / max(elapsed_s / spent, 1e-3)))


def time_words(time_s: float) -> str:
    """``90 s``, ``30 min``, ``2.5 h``."""
    if time_s < 120:
        return f"{time_s:.3g} s"
    return f"{time_s / 60:.4g} min" if time_s < 7200 else f"{time_s / 3600:.4g} h"


def read_budget(text: str) -> RunBudget:
    """A budget such as ``20 runs``, ``30 min`` or ``2 h``; raises InvalidInput."""
    found = _BUDGET.fullmatch(text.strip().lower())
    remedy = "for example '20 runs', '30 min' or '2 h'"
    if found is None:
        raise InvalidInput(f"budget {text[:_SHOWN]!r} is not clear", remedy)
    number, unit = float(found[1]), found[2]
    if unit in ("run", "runs") and number.is_integer() and 1 <= number <= MOST_RUNS:
        return RunBudget(runs=int(number))
    if unit in _UNITS_S and 0 < number * _UNITS_S[unit] <= _LARGEST_S:
        return RunBudget(time_s=number * _UNITS_S[unit])
    raise InvalidInput(f"budget {text[:_SHOWN]!r} is not allowed", remedy)
