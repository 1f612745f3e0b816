"""The one rule that separates good runs from failed ones. Lists, groups, experiments and analyses all use it.

It reads metrics of the run's evaluation. Those that compare a run with its repeats are computed here
(:func:`compare_repeats`) and stored like the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import Any, Protocol

from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import DROPPED_FRAMES, LARGEST_DOUBTED_SHARE

ERROR = "ate.rmse"
RELATION_ERROR = "relations.translation.mean"
RELATION_ROTATION = "relations.rotation.mean"
RELATION_RMSE = "relations.translation.rmse"
RELATION_ERROR_PER_MOTION = "relations.translation.per_motion"
RELATIONS_MATCHED = "relations.matched_fraction"
TRACKED_PATH = "tracked.path"
TRACKED_FRACTION = "tracked_fraction"
ERROR_PER_PATH = "ate.per_path"
ERROR_PER_EXTENT = "ate.per_extent"
ERROR_OVER_REPEATS = "ate.over_repeats"
REPEATS_LIMIT = "ate.repeats_limit"

EVIDENCE = (
    *(ERROR, TRACKED_PATH, TRACKED_FRACTION, ERROR_PER_PATH, ERROR_PER_EXTENT),
    *(ERROR_OVER_REPEATS, REPEATS_LIMIT),
    *(RELATION_RMSE, RELATION_ERROR_PER_MOTION, RELATIONS_MATCHED),
    DROPPED_FRAMES,
)
"""The metrics that a verdict depends on."""

FROM_REPEATS = (ERROR_OVER_REPEATS, REPEATS_LIMIT)
"""Those that follow from the repeats of the run, and not from its own evaluation."""

SMALLEST_DIVERGENCE_M = 0.05
"""An error below this is never called divergence, however short the path."""

FEWEST_REPEATS = 3
"""With fewer repeats it is not clear which of them is the outlier."""

MOST_MISSED = 0.5
"""A run that missed more of its input frames than this has not seen the recording."""

_SPREADS = 3.0
_LEAST_FACTOR, _LARGEST_FACTOR = 4.0, 6.0
_LEAST_EXCESS_M = 0.1
_MAD_TO_SIGMA = 1.4826
_SMALLEST_ERROR_M = 1e-9


class VerdictKind(StrEnum):
    """Judgement of a run: good, or the reason why it failed. The first reason that applies counts, in this order."""

    GOOD = "good"
    ENDED_BADLY = "ended_badly"
    NOT_EVALUABLE = "not_evaluable"
    MISSED_INPUT = "missed_input"
    TRACKED_TOO_LITTLE = "tracked_too_little"
    DIVERGED_FAR = "diverged_far"
    DIVERGED_OUTLIER = "diverged_outlier"

    @property
    def failed(self) -> bool:
        """The run counts as failed."""
        return self is not VerdictKind.GOOD

    @property
    def label(self) -> str:
        """The kind in words, for badges, lists and plots."""
        return _LABELS[self]


_LABELS = {
    VerdictKind.GOOD: "good",
    VerdictKind.ENDED_BADLY: "did not end well",
    VerdictKind.NOT_EVALUABLE: "could not be evaluated",
    VerdictKind.MISSED_INPUT: "missed too much input",
    VerdictKind.TRACKED_TOO_LITTLE: "tracked too little",
    VerdictKind.DIVERGED_FAR: "diverged",
    VerdictKind.DIVERGED_OUTLIER: "diverged (outlier among its repeats)",
}

DIVERGED = (VerdictKind.DIVERGED_FAR, VerdictKind.DIVERGED_OUTLIER)
GROUPS: dict[str, tuple[VerdictKind, ...]] = {
    "failed": tuple(kind for kind in VerdictKind if kind.failed),
    "diverged": DIVERGED,
}
"""Names of several kinds together, for filters."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A verdict and the reason for it in words.

    ``dated``: the evaluation is older than some metrics that the rule uses. The verdict rests on those that it has.
    """

    kind: VerdictKind
    words: str
    dated: bool = False

    @property
    def failed(self) -> bool:
        """The run counts as failed."""
        return self.kind.failed


@dataclass(frozen=True, slots=True)
class FailureRule:
    """Rule by which a run counts as failed. Stored verdicts use the defaults; an analysis may set others.

    Attributes:
        tracked_path_below: Least share of the true path that must be tracked (metric ``tracked.path``). Without a
            ground-truth trajectory, the least share of the relations at whose times there are poses.
        tracked_fraction_below: Least share of time by the protocol's gap threshold. There is no default, because sound
            keyframe trajectories would fail. An evaluation without ``tracked.path`` is judged by
            :data:`DATED_FRACTION`.
        ate_rmse_above_m: Largest ATE RMSE.
        ate_path_above_percent: Largest ATE RMSE in percent of the true path.
        ate_extent_above_percent: Largest ATE RMSE in percent of that of an estimate that never moves. Without a
            ground-truth trajectory, the same of the translation errors of the relations.
        outliers: Whether an outlier among the repeats has diverged.
        missed_input_above: Largest share of the input frames that may not reach the algorithm. Above a quarter, when
            the trust is low, an error of four times the median of the repeats is enough.
    """

    tracked_path_below: float | None = 0.7
    tracked_fraction_below: float | None = None
    ate_rmse_above_m: float | None = None
    ate_path_above_percent: float | None = 5.0
    ate_extent_above_percent: float | None = 50.0
    outliers: bool = True
    missed_input_above: float | None = MOST_MISSED

    @property
    def words(self) -> str:
        """The rule in one or two sentences, for captions."""
        parts = ["did not end well", "could not be evaluated"]
        if self.missed_input_above is not None:
            parts.append(f"missed more than {100 * self.missed_input_above:.4g} % of the input")
        if self.tracked_path_below is not None:
            parts.append(f"tracked less than {100 * self.tracked_path_below:.4g} % of the path")
        if self.tracked_fraction_below is not None:
            parts.append(f"tracked less than {100 * self.tracked_fraction_below:.4g} % of the time")
        errors = []
        if self.ate_rmse_above_m is not None:
            errors.append(f"above {self.ate_rmse_above_m:g} m")
        if self.ate_path_above_percent is not None:
            errors.append(f"above {self.ate_path_above_percent:g} % of the path")
        if self.ate_extent_above_percent is not None:
            errors.append(f"above {self.ate_extent_above_percent:g} % of the error of standing still")
        if self.outliers:
            factors = f"{_LEAST_FACTOR:g} to {_LARGEST_FACTOR:g} times"
            errors.append(f"more than {factors} the median of {FEWEST_REPEATS} or more repeats")
        if not errors:
            return f"A run counts as failed if it {_either(parts)}."
        diverged = f"It diverged if its ATE RMSE is {_either(errors)}."
        return f"A run counts as failed if it {_either([*parts, 'diverged'])}. {diverged}"


DEFAULT_RULE = FailureRule()

DATED_FRACTION = 0.75
"""Evaluations without ``tracked.path`` are judged by the share of time that was tracked."""

_DATED = "An older version evaluated this run, so some metrics are missing; evaluate the run again to renew it."


def judge(metrics: Mapping[str, float], rule: FailureRule = DEFAULT_RULE) -> Verdict:
    """The verdict on a run whose evaluation succeeded, from the metrics called :data:`EVIDENCE`."""
    dated = TRACKED_PATH not in metrics and TRACKED_FRACTION in metrics
    kind, words = (
        _missed(metrics, rule)
        or _lost(metrics, rule, dated=dated)
        or _diverged(metrics, rule)
        or (VerdictKind.GOOD, "")
    )
    if kind is VerdictKind.GOOD:
        if ERROR not in metrics and RELATION_ERROR_PER_MOTION in metrics:
            matched, moved = metrics.get(RELATIONS_MATCHED, 1.0), metrics[RELATION_ERROR_PER_MOTION]
            error_m = metrics[RELATION_RMSE]
            words = (
                f"The run ended well, with poses for {100 * matched:.3g} % of the relations. "
                f"Their translation errors have an RMSE of {error_m:.3g} m ({moved:.3g} % of their motion)."
            )
        elif ERROR not in metrics:
            words = "The run ended well and was evaluated. There is no ground-truth trajectory that could tell more."
        else:
            share, percent = metrics.get(TRACKED_PATH), metrics.get(ERROR_PER_PATH)
            tracked = "" if share is None else f" and tracked {100 * share:.3g} % of the path"
            apart = "" if percent is None else f" ({percent:.3g} % of the path)"
            repeats = "" if ERROR_OVER_REPEATS in metrics else " There are too few repeats to tell an outlier."
            words = f"The run ended well{tracked} with an ATE RMSE of {metrics[ERROR]:.3g} m{apart}.{repeats}"
    return Verdict(kind, f"{words} {_DATED}" if dated else words, dated)


def ended_badly(why: str) -> Verdict:
    """The verdict on a run that did not succeed; ``why`` is its reason or state."""
    return Verdict(VerdictKind.ENDED_BADLY, f"The run did not end well: {why.replace('_', ' ')}.")


def not_evaluable(why: str | None) -> Verdict:
    """The verdict on a run that succeeded and whose evaluation failed."""
    return Verdict(VerdictKind.NOT_EVALUABLE, f"The run could not be evaluated: {why or 'see its evaluations'}")


def compare_repeats(errors_m: Mapping[int, float], compared: Mapping[int, float]) -> dict[int, dict[str, float]]:
    """Compare the errors of repeats: {run: the metrics :data:`FROM_REPEATS`}; empty for too few repeats.

    A robust outlier in the logarithm: the limit is the median times exp(3 sigma). Divergence only makes errors larger,
    so sigma is estimated from the better half, by the median deviation below the median. The limit is at least 4 times
    the median, since a few repeats may agree by chance, and at most 6 times, even if they differ widely. It also lies
    0.1 m above the median, so 2 cm beside 1 mm is no divergence.

    Args:
        errors_m: {run: ATE RMSE} of the runs to compare.
        compared: The same for the repeats that tracked enough for their error to mean something.
    """
    if len(compared) < FEWEST_REPEATS:
        return {}
    logs = [math.log(max(error, _SMALLEST_ERROR_M)) for error in compared.values()]
    middle = median(logs)
    sigma = _MAD_TO_SIGMA * median(middle - value for value in logs if value <= middle)
    typical_m = math.exp(middle)
    factor = math.exp(min(_SPREADS * sigma, math.log(_LARGEST_FACTOR)))
    limit = max(factor, _LEAST_FACTOR, 1 + _LEAST_EXCESS_M / typical_m)
    return {run: {ERROR_OVER_REPEATS: error / typical_m, REPEATS_LIMIT: limit} for run, error in errors_m.items()}


def tracked_enough(metrics: Mapping[str, float], rule: FailureRule = DEFAULT_RULE) -> bool:
    """Tell if the run's error can be compared with that of its repeats; a lost run has hardly any error."""
    alone = {key: value for key, value in metrics.items() if key not in FROM_REPEATS}
    return (_missed(alone, rule) or _lost(alone, rule, dated=TRACKED_PATH not in alone)) is None


def _missed(metrics: Mapping[str, float], rule: FailureRule) -> tuple[VerdictKind, str] | None:
    """A run that did not get its input says little about the algorithm, however small its error."""
    share, most = metrics.get(DROPPED_FRAMES), rule.missed_input_above
    if share is None or most is None:
        return None
    missed = f"The run missed {100 * share:.3g} % of the input frames"
    if share > most:
        return VerdictKind.MISSED_INPUT, f"{missed}; {100 * most:.4g} % are allowed."
    ratio = metrics.get(ERROR_OVER_REPEATS)
    if share > LARGEST_DOUBTED_SHARE and ratio is not None and ratio > _LEAST_FACTOR:
        words = f"{missed}, and its ATE RMSE is {ratio:.3g} times the median of its repeats"
        bound = f"above {100 * LARGEST_DOUBTED_SHARE:.4g} % missed, {_LEAST_FACTOR:g} times are allowed"
        return VerdictKind.MISSED_INPUT, f"{words}; {bound}."
    return None


def _lost(metrics: Mapping[str, float], rule: FailureRule, *, dated: bool) -> tuple[VerdictKind, str] | None:
    limits = [(TRACKED_PATH, rule.tracked_path_below, "path"), (TRACKED_FRACTION, rule.tracked_fraction_below, "time")]
    if dated and rule.tracked_path_below is not None and rule.tracked_fraction_below is None:
        limits.append((TRACKED_FRACTION, DATED_FRACTION, "time"))
    if ERROR not in metrics and TRACKED_PATH not in metrics:
        limits.append((RELATIONS_MATCHED, rule.tracked_path_below, "relations"))
    for key, least, what in limits:
        share = metrics.get(key)
        if share is not None and least is not None and share < least:
            words = f"The run tracked {100 * share:.3g} % of the {what}; {100 * least:.4g} % are needed."
            return VerdictKind.TRACKED_TOO_LITTLE, words
    return None


def _diverged(metrics: Mapping[str, float], rule: FailureRule) -> tuple[VerdictKind, str] | None:
    error_m = metrics.get(ERROR)
    if error_m is None:
        error_m, percent = metrics.get(RELATION_RMSE), metrics.get(RELATION_ERROR_PER_MOTION)
        most = rule.ate_extent_above_percent
        if error_m is None or percent is None or most is None or percent <= most or error_m <= SMALLEST_DIVERGENCE_M:
            return None
        return VerdictKind.DIVERGED_FAR, (
            f"The run diverged: the translation errors of its relations have an RMSE of {error_m:.3g} m, which is "
            f"{percent:.3g} % of the error of an estimate that never moves; {most:g} % are allowed."
        )
    found = f"The run diverged: its ATE RMSE of {error_m:.3g} m is"
    if rule.ate_rmse_above_m is not None and error_m > rule.ate_rmse_above_m:
        return VerdictKind.DIVERGED_FAR, f"{found} above {rule.ate_rmse_above_m:g} m."
    for key, most, what in (
        (ERROR_PER_PATH, rule.ate_path_above_percent, "the path"),
        (ERROR_PER_EXTENT, rule.ate_extent_above_percent, "the error of an estimate that never moves"),
    ):
        percent = metrics.get(key)
        if percent is not None and most is not None and percent > most and error_m > SMALLEST_DIVERGENCE_M:
            return VerdictKind.DIVERGED_FAR, f"{found} {percent:.3g} % of {what}; {most:g} % are allowed."
    ratio, limit = metrics.get(ERROR_OVER_REPEATS), metrics.get(REPEATS_LIMIT)
    if rule.outliers and ratio is not None and limit is not None and ratio > limit:
        words = f"{found} {ratio:.3g} times the median of its repeats; {limit:.3g} times are allowed."
        return VerdictKind.DIVERGED_OUTLIER, words
    return None


def _either(parts: list[str]) -> str:
    return f"{', '.join(parts[:-1])} or {parts[-1]}" if len(parts) > 1 else parts[0]


# A hint: a common mistake that an evaluation has found behind a large error, and what to do about it.


@dataclass(frozen=True, slots=True)
class Hint:
    """One likely mistake, or a doubt that a path leaves.

    Attributes:
        key: Names the mistake: ``quaternion_order``, ``inverse_poses``, ...
        sentence: What was found, with the numbers that show it.
        remedy: What to do.
    """

    key: str
    sentence: str
    remedy: str


def hints_from_json(content: Iterable[Mapping[str, Any]]) -> tuple[Hint, ...]:
    """The hints in a ``result.json``; raises TypeError or KeyError for anything else."""
    return tuple(Hint(str(entry["key"]), str(entry["sentence"]), str(entry["remedy"])) for entry in content)


# The outcome of a run: one word for people, the same on every page, in every list and in every file.


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
