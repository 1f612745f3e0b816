"""Questions that an experiment answers with as few runs as it can: it chooses its runs itself."""

from __future__ import annotations

from enum import StrEnum


class ExperimentQuestion(StrEnum):
    """Kind of question of an experiment that chooses its runs."""

    DECIDE = "decide"
    OPTIMISE = "optimise"


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
