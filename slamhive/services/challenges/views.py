"""Public views of challenges and submissions, and the ranking. Nothing here opens the secret folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from slamhive.documents.challenge import (
    Challenge,
    ChallengeBrief,
    ChallengePhase,
    ChallengeRanking,
    ChallengeSequence,
    ChallengeSubmission,
    PhaseEntry,
    RankedTeam,
    StoredFile,
    StoredResult,
    StoredSubmission,
)
from slamhive.domain.challenge import Counted, Failure, PhaseState, Reveal, Rule, SubmissionState, phase_state, rounded
from slamhive.domain.names import plural
from slamhive.domain.packages import version_label
from slamhive.services.challenges.definition import Definition, SubmissionFolder


def scores_shown(phase: PhaseEntry, now: datetime) -> bool:
    """Tell if the scores of a phase are shown."""
    return phase.scores is Reveal.AT_ONCE or phase_state(phase.begins, phase.ends, now) is PhaseState.ENDED


def brief_of(definition: Definition, now: datetime) -> ChallengeBrief:
    """A challenge as lists show it."""
    phases = definition.file.phases
    return ChallengeBrief(
        name=definition.file.name,
        title=definition.file.title,
        preset=definition.file.preset,
        sequences=len(definition.file.sequences),
        open_phases=tuple(
            entry.name for entry in phases if phase_state(entry.begins, entry.ends, now) is PhaseState.OPEN
        ),
    )


def challenge_of(definition: Definition, now: datetime) -> Challenge:
    """Everything that is public."""
    scoring = definition.scoring
    return Challenge.of(
        definition.file,
        counts=definition.preset.words,
        trajectories=definition.preset.format,
        protocol=definition.protocol,
        metric=definition.metric.key,
        unit=definition.metric.unit,
        direction=definition.metric.direction,
        rule=scoring.rule,
        score_unit="%" if scoring.rule is Rule.AREA else definition.metric.unit,
        worst=scoring.worst,
        sequences=tuple(map(ChallengeSequence.of, definition.file.sequences)),
        phases=tuple(phase_of(definition, entry, now) for entry in definition.file.phases),
    )


def phase_of(definition: Definition, phase: PhaseEntry, now: datetime) -> ChallengePhase:
    """A phase as it is now."""
    return ChallengePhase.of(
        phase,
        state=phase_state(phase.begins, phase.ends, now),
        sequences=tuple(entry.name for entry in definition.sequences_of(phase)),
        takes=definition.takes(phase),
        submissions_per_day=phase.submissions_per_day or definition.file.submissions_per_day,
        scores_shown=scores_shown(phase, now),
    )


def submission_of(definition: Definition, found: SubmissionFolder, now: datetime) -> ChallengeSubmission:
    """A submission as its team sees it."""
    sent, result = found.sent, found.result
    cancelled = found.cancelled
    if result is not None and now < result.shown_at:
        result = None
    done = result is not None and result.failure is None and not cancelled
    words = None
    if sent.image is not None:
        words = sent.image.algorithm or sent.image.package or "image"
        if sent.image.package is not None and sent.image.version is not None:
            words = version_label(words, sent.image.version)
    shown = done and scores_shown(definition.phase(sent.phase), now)
    return ChallengeSubmission.of(
        sent,
        state=SubmissionState.CANCELLED if cancelled else _state(result),
        reason=None if result is None or cancelled else result.failure,
        image=words,
        log=tuple(_log(definition, found, result, shown=shown)),
        run_logs={} if result is None or cancelled else found.logs,
        values=dict(result.values) if result is not None and shown else None,
        score=score_of(definition, result) if result is not None and shown else None,
    )


def score_of(definition: Definition, result: StoredResult) -> float:
    """The score that follows from the values that are given out."""
    points = [definition.scoring.points(value) for value in result.values.values()]
    weights = [weight_of(definition, result, name) for name in result.values]
    return rounded(float(np.average(np.array(points, dtype=float), weights=weights)), definition.file.digits)


def weight_of(definition: Definition, result: StoredResult, sequence: str) -> float:
    """Return the weight of a sequence."""
    return result.weights[sequence] if definition.scoring.rule is Rule.POOLED else 1.0


def _state(result: StoredResult | None) -> SubmissionState:
    if result is None:
        return SubmissionState.QUEUED
    return SubmissionState.EVALUATED if result.failure is None else SubmissionState.FAILED


def _log(definition: Definition, found: SubmissionFolder, result: StoredResult | None, *, shown: bool) -> list[str]:
    """Describe each trajectory: facts of the submission, of the public file, and of shown values."""
    sent = found.sent
    lines = [_line(name, facts, definition.file.least_coverage) for name, facts in sent.files.items()]
    if found.cancelled:
        return [*lines, Failure.CANCELLED.value]
    if result is None:
        return [*lines, _waiting(definition, sent)]
    if sent.image is not None:
        lines += [f"{name}: {reason}" for name, reason in result.reasons.items()]
    if result.failure is not None:
        return [*lines, f"failed: {result.failure}"]
    if not shown:
        return [*lines, "evaluated; scores are shown when the phase has ended"]
    missing = [name for name, value in result.values.items() if value is None]
    worst = definition.scoring.worst
    return [*lines, "evaluated", *(f"{name}: no value, counts as {worst:g}" for name in missing)]


def _waiting(definition: Definition, sent: StoredSubmission) -> str:
    if sent.image is None or definition.file.images is None:
        return "waiting for the evaluation"
    every_h = definition.file.images.answers_every_h
    return (
        f"waiting for its runs and their evaluation; results are shown every {plural(every_h, 'hour')} from 00:00 UTC"
    )


def _line(name: str, facts: StoredFile, least: float) -> str:
    if facts.coverage is None:
        return f"{name}: {facts.poses:,} poses"
    little = "" if facts.enough else f", less than {100 * least:.4g} %, so it counts as failed"
    return f"{name}: {facts.poses:,} poses, {100 * facts.coverage:.1f} % of the time range{little}"


# Times of answers: they must not tell how long anything took.

ANSWERS_EVERY = timedelta(minutes=1)
"""Of trajectories: how long an evaluation takes depends on both trajectories."""


def shown_at(now: datetime, every_h: int | None) -> datetime:
    """The next full minute; with ``every_h``, the next multiple of so many hours of the day (UTC)."""
    if every_h is None:
        return now.replace(second=0, microsecond=0) + ANSWERS_EVERY
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    return midnight + timedelta(hours=every_h * (now.hour // every_h + 1))


# The ranking follows from the rounded values that are given out, so anybody can repeat it.


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
    from slamhive.analysis.statistics import LEAST_FOR_WILCOXON  # noqa: PLC0415 - loads scipy

    test, sequences = "none: one sequence separates nobody", len(definition.sequences_of(phase))
    if sequences > 1:
        name = "Wilcoxon's signed-rank test" if sequences >= LEAST_FOR_WILCOXON else "Student's paired t test"
        test = f"{name} over {sequences} sequences at the level {definition.file.significance:g}"
    return ChallengeRanking(
        challenge=definition.file.name,
        phase=phase.name,
        shown=shown,
        shown_from=None if shown else phase.ends,
        test=test,
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
        other = chosen.get(team)
        if other is None:
            chosen[team] = scored
        elif definition.file.counted is Counted.LAST:
            if scored.sent.at > other.sent.at:
                chosen[team] = scored
        elif scored.score == other.score:
            # Who reached a score first keeps its date.
            if scored.sent.at < other.sent.at:
                chosen[team] = scored
        elif definition.scoring.is_better(scored.score, other.score):
            chosen[team] = scored
    return [chosen[team] for team in sorted(chosen)]


def _ranked(definition: Definition, counted: Sequence[Scored]) -> list[RankedTeam]:
    from slamhive.analysis.statistics import standings  # noqa: PLC0415 - loads scipy

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
