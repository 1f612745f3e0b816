"""Searches for the first bad commit and for the shortest bad clip, where one run says little.

Each step is a small race: the runs of a commit against those of the good one, made worse by what is allowed. Whoever
loses it settles the step. Everything follows from the runs that are there, so a search that was killed goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slamhive.analysis.racing import RaceAnswer, RaceRule, bayes_factor, counted, half_width_factor, race
from slamhive.analysis.statistics import Numbers
from slamhive.domain.gate import Margin, TrialStanding

Scores = Sequence[Numbers]
"""For each dataset the scores of the runs in their order: smaller is better, infinite for a failed run."""

_THRESHOLD = Margin(0.0, relative=False)
_MORE = 4
"""After the first look, so many looks double the runs: each look costs nothing, and each run does."""


@dataclass(frozen=True, slots=True)
class StepVerdict:
    """State of the knowledge after the runs so far.

    Attributes:
        standing: None while they are too few.
        runs: How many of each were looked at, on each dataset.
        e_value: The evidence for the answer. Without a difference it exceeds 1 / p with a chance of at most p, however
            often somebody looks. None where there is no answer.
    """

    standing: TrialStanding | None
    runs: int
    e_value: float | None = None


def step_verdict(reference: Scores, values: Scores, difference: Margin, error: float) -> StepVerdict:
    """Say whether ``values`` are worse than ``reference`` by more than ``difference``.

    Both are compared as in :func:`slamhive.analysis.racing.race`, after ``reference`` was made worse by ``difference``.

    Args:
        reference: Scores of the good one.
        values: Scores of the one in question, on the same datasets.
        difference: What is allowed. A share is one of the absolute score.
        error: The largest chance that the answer is false, at all looks together.
    """
    spoiled = []
    for scores in reference:
        allowed = difference.value * np.where(np.isfinite(scores), np.abs(scores) if difference.relative else 1.0, 0.0)
        spoiled.append(scores + allowed)
    state = race(RaceRule(_THRESHOLD, error), [spoiled, values])
    if state.answer is RaceAnswer.OPEN:
        return StepVerdict(None, state.rounds)
    bad = state.answer is RaceAnswer.BEST and state.left[0] == 0
    seen = counted([[scores[: state.rounds] for scores in lane] for lane in (spoiled, values)], None)
    return StepVerdict(TrialStanding.BAD if bad else TrialStanding.GOOD, state.rounds, bayes_factor(seen[0], seen[1]))


def half_way(good: Scores, bad: Scores, runs: int, least: Margin) -> Margin:
    """Half of the difference between both ends of a search, and no less than ``least``.

    A limit there is far from both, so that the fewest runs tell commits apart. It follows from the first ``runs`` runs
    on each dataset, so it stays when more are made.
    """
    seen = counted([[scores[:runs] for scores in lane] for lane in (good, bad)], None)
    means = [float(table.mean()) for table in seen]
    least_value = least.value * (abs(means[0]) if least.relative else 1.0)
    return Margin(max(least_value, (means[1] - means[0]) / 2), relative=False)


def next_runs(done: int, datasets: int, error: float) -> int:
    """Runs of each that a further look should have, on each dataset; ``done`` are there already.

    No answer is possible before some number of runs, however large the difference is.
    """
    least = 2
    while math.isinf(half_width_factor(2 * datasets * (least - 1), datasets * least / 2, error)):
        least += 1
    return max(least, done + max(1, done // _MORE))


def step_error(error: float, step: int, expected: int) -> float:
    """The chance of a false answer that a step may have, so that all steps together stay below ``error``.

    Args:
        error: Of the whole search.
        step: Its number, from 0.
        expected: How many steps the search should need. They share half of the error; the other half is for further
            ones, in a series that never ends.
    """
    if step < expected:
        return error / (2 * expected)
    beyond = step - expected + 1
    return error / (2 * beyond * (beyond + 1))


# The first bad commit of a history.


@dataclass(frozen=True)
class History:
    """The commits that are in the bad one and not in the good one.

    ``parents`` maps each commit to its parents, the oldest commit first. Parents outside the range are good.
    """

    parents: Mapping[str, tuple[str, ...]]
    bad: str

    @cached_property
    def _ancestors(self) -> dict[str, int]:
        """For each commit a number with one bit for itself and for each of its ancestors."""
        found: dict[str, int] = {}
        for place, (commit, parents) in enumerate(self.parents.items()):
            bits = 1 << place
            for parent in parents:
                bits |= found.get(parent, 0)
            found[commit] = bits
        return found

    def in_order(self, commits: Collection[str]) -> tuple[str, ...]:
        """Some of the commits, the oldest first."""
        wanted = set(commits)
        return tuple(commit for commit in self.parents if commit in wanted)

    def between(self, bad: str, good: Collection[str]) -> list[str]:
        """The commits that may be the first bad one, those in the middle first; ``bad`` is the last."""
        known = 0
        for commit in good:
            known |= self._ancestors[commit]
        left = self._ancestors[bad] & ~known
        total = left.bit_count()
        inside = [
            (abs(2 * (self._ancestors[commit] & left).bit_count() - total), place, commit)
            for place, commit in enumerate(self.parents)
            if left >> place & 1 and commit != bad
        ]
        return [*(commit for _, _, commit in sorted(inside)), bad]


@dataclass(frozen=True, slots=True)
class HistoryState:
    """Progress of a search for a commit.

    Attributes:
        tried: What was found out about commits, in the order of the search.
        ask: The commit to look at next; None at the end.
        left: The commits that may be the first bad one. At the end it is one, or those that cannot be told apart
            because all but the last were skipped.
    """

    tried: tuple[tuple[str, TrialStanding], ...]
    ask: str | None
    left: tuple[str, ...]


def search_history(history: History, standing: Callable[[str], TrialStanding | None]) -> HistoryState:
    """Halve the range until one commit is left. One that is skipped gives way to its nearest neighbour.

    Args:
        history: The range; its bad end is known to be bad.
        standing: Of a commit; None if that has to be found out first.
    """
    bad, good = history.bad, set[str]()
    tried: dict[str, TrialStanding] = {}
    while True:
        left = history.between(bad, good)
        for commit in left[:-1]:
            if tried.get(commit) is TrialStanding.SKIPPED:
                continue
            found = standing(commit)
            if found is None:
                return HistoryState(tuple(tried.items()), commit, history.in_order(left))
            tried[commit] = found
            if found is TrialStanding.BAD:
                bad = commit
            elif found is TrialStanding.GOOD:
                good.add(commit)
            if found is not TrialStanding.SKIPPED:
                break
        else:
            return HistoryState(tuple(tried.items()), None, history.in_order(left))


# The shortest clip of a recording.

Clip = tuple[float, float]
"""Start and end in seconds from the first message of the recording."""


@dataclass(frozen=True, slots=True)
class ClipState:
    """Progress of a search for the shortest clip.

    Attributes:
        tried: What was found out, in order.
        best: The shortest clip that is known to be bad.
        ask: The clip to look at next; None at the end.
    """

    tried: tuple[tuple[Clip, TrialStanding], ...]
    best: Clip
    ask: Clip | None


def search_clips(duration_s: float, step_s: float, standing: Callable[[Clip], TrialStanding | None]) -> ClipState:
    """Find the earliest end that still shows the fault, then the latest start.

    Ends and starts are multiples of ``step_s``. The clip that is returned was always found to be bad. It is the
    shortest one if longer clips around a bad one are bad, too.

    Args:
        duration_s: Of the whole recording, which is known to be bad.
        step_s: How exactly the ends are found.
        standing: Of a clip: bad if it shows the fault. None if that has to be found out first. What is skipped counts
            as not shown.
    """
    steps = max(1, math.ceil(duration_s / step_s))

    tried: list[tuple[Clip, TrialStanding]] = []

    def halve(bad: int, other: int, clip: Callable[[int], Clip]) -> tuple[int, Clip | None]:
        """Move an end that shows the fault towards one that is too far; where it is now, and the clip to ask for."""
        way = 1 if other > bad else -1
        while abs(other - bad) > 1:
            middle = bad + way * ((abs(other - bad) + 1) // 2)
            found = standing(clip(middle))
            if found is None:
                return bad, clip(middle)
            tried.append((clip(middle), found))
            if found is TrialStanding.BAD:
                bad = middle
            else:
                other = middle
        return bad, None

    def between(start: int, end: int) -> Clip:
        return start * step_s, min(duration_s, end * step_s)

    start = 0
    end, ask = halve(steps, 0, lambda place: between(0, place))
    if ask is None:
        start, ask = halve(0, end, lambda place: between(place, end))
    return ClipState(tuple(tried), between(start, end), ask)
