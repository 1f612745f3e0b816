"""Ranks teams. All of it follows from the rounded values that are given out, so anybody can repeat it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from slamhive.domain.challenge import Counted, rounded
from slamhive.schema.challenge import ChallengeRanking, PhaseEntry, RankedTeam, StoredResult, StoredSubmission
from slamhive.services.challenges.definition import Definition
from slamhive.services.challenges.folder import SubmissionFolder
from slamhive.services.challenges.views import score_of, scores_shown, weight_of


@dataclass(frozen=True, slots=True)
class Scored:
    """An evaluated submission."""

    sent: StoredSubmission
    result: StoredResult
    score: float


def ranking_of(
    definition: Definition, phase: PhaseEntry, submissions: Iterable[SubmissionFolder], now: datetime
) -> ChallengeRanking:
    """The ranking of a phase; without teams while its scores are hidden."""
    shown = scores_shown(phase, now)
    counted = _counted(definition, submissions, now) if shown else []
    return ChallengeRanking(
        challenge=definition.file.name,
        phase=phase.name,
        shown=shown,
        shown_from=None if shown else phase.ends,
        test=_test_words(definition, len(definition.sequences_of(phase))),
        teams=tuple(_ranked(definition, counted)) if counted else (),
    )


def _counted(definition: Definition, submissions: Iterable[SubmissionFolder], now: datetime) -> list[Scored]:
    """The submission of each team that counts."""
    chosen: dict[str, Scored] = {}
    for found in submissions:
        result = found.result
        if result is None or result.failure is not None or now < result.shown_at or found.cancelled:
            continue
        scored = Scored(found.sent, result, score_of(definition, result))
        team = scored.sent.team.casefold()
        if team not in chosen or _replaces(definition, scored, chosen[team]):
            chosen[team] = scored
    return [chosen[team] for team in sorted(chosen)]


def _replaces(definition: Definition, scored: Scored, other: Scored) -> bool:
    if definition.file.counted is Counted.LAST:
        return scored.sent.at > other.sent.at
    if scored.score == other.score:
        return scored.sent.at < other.sent.at
    return definition.scoring.is_better(scored.score, other.score)


def _ranked(definition: Definition, counted: Sequence[Scored]) -> list[RankedTeam]:
    from slamhive.analysis.standing import standings  # noqa: PLC0415 - loads scipy

    digits = definition.file.digits
    names = list(counted[0].result.values)
    points = np.array(
        [[definition.scoring.points(entry.result.values[name]) for entry in counted] for name in names], dtype=float
    )
    weights = np.array([weight_of(definition, counted[0].result, name) for name in names])
    found = standings(
        points, weights, higher_wins=definition.scoring.higher_wins, significance=definition.file.significance
    )
    ranks = [entry.rank for entry in found]
    return [
        RankedTeam(
            rank=entry.rank,
            team=counted[entry.place].sent.team,
            score=counted[entry.place].score,
            low=None if entry.interval is None else rounded(entry.interval.low, digits),
            high=None if entry.interval is None else rounded(entry.interval.high, digits),
            tied=ranks.count(entry.rank) > 1,
            at=counted[entry.place].sent.at,
            values=dict(counted[entry.place].result.values),
        )
        for entry in found
    ]


def _test_words(definition: Definition, sequences: int) -> str:
    from slamhive.analysis.standing import LEAST_FOR_WILCOXON  # noqa: PLC0415 - loads scipy

    if sequences < 2:
        return "none: one sequence separates nobody"
    name = "Wilcoxon's signed-rank test" if sequences >= LEAST_FOR_WILCOXON else "Student's paired t test"
    return f"{name} over {sequences} sequences at the level {definition.file.significance:g}"
