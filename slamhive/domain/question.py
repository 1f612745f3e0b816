"""Questions that an experiment answers with as few runs as it can: it chooses its runs itself."""

from __future__ import annotations

from enum import StrEnum


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
