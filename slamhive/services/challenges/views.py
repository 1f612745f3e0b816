"""What is shown of challenges and submissions. Nothing here opens the secret folder."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from slamhive.domain.challenge import Failure, PhaseState, Reveal, Rule, SubmissionState, phase_state, rounded
from slamhive.domain.numbers import plural
from slamhive.domain.versions import version_label
from slamhive.schema.challenge import (
    Challenge,
    ChallengeBrief,
    ChallengePhase,
    ChallengeSequence,
    ChallengeSubmission,
    PhaseEntry,
    StoredFile,
    StoredImage,
    StoredResult,
    StoredSubmission,
)
from slamhive.services.challenges.definition import Definition
from slamhive.services.challenges.folder import SubmissionFolder


def scores_shown(phase: PhaseEntry, now: datetime) -> bool:
    """Whether the scores of a phase are shown."""
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
    shown = done and scores_shown(definition.phase(sent.phase), now)
    return ChallengeSubmission.of(
        sent,
        state=SubmissionState.CANCELLED if cancelled else _state(result),
        reason=None if result is None or cancelled else result.failure,
        image=None if sent.image is None else _image_words(sent.image),
        log=tuple(_log(definition, found, result, shown=shown)),
        run_logs={} if result is None or cancelled else found.logs,
        values=dict(result.values) if result is not None and shown else None,
        score=score_of(definition, result) if result is not None and shown else None,
    )


def _image_words(image: StoredImage) -> str:
    if image.package is None:
        return image.algorithm or "image"
    name = image.algorithm or image.package
    return name if image.version is None else version_label(name, image.version)


def score_of(definition: Definition, result: StoredResult) -> float:
    """The score that follows from the values that are given out."""
    points = [definition.scoring.points(value) for value in result.values.values()]
    weights = [weight_of(definition, result, name) for name in result.values]
    return rounded(float(np.average(np.array(points, dtype=float), weights=weights)), definition.file.digits)


def weight_of(definition: Definition, result: StoredResult, sequence: str) -> float:
    """How much a sequence weighs."""
    return result.weights[sequence] if definition.scoring.rule is Rule.POOLED else 1.0


def _state(result: StoredResult | None) -> SubmissionState:
    if result is None:
        return SubmissionState.QUEUED
    return SubmissionState.EVALUATED if result.failure is None else SubmissionState.FAILED


def _log(definition: Definition, found: SubmissionFolder, result: StoredResult | None, *, shown: bool) -> list[str]:
    """What was done with each trajectory: facts of the submission, of the public file, and of shown values."""
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
