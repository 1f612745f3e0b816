"""Where one run is worse than another over the recording, and what happened there: dropped frames and latency.

Both runs are of one dataset and were judged under one protocol. Their errors are compared at the same moments of the
recording. The stretch that is named is the one whose excess over the usual error adds up to the most (the largest
sum of consecutive terms: J. Bentley, "Algorithm design techniques", Communications of the ACM 27(9), 1984).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamhive.domain.names import plural
from slamhive.services.runs import Array, RunSeries, Samples

BEFORE_S = 1.0
"""Frames that were dropped so long before a stretch count as its cause: an error shows when the body has moved on."""
THROUGHOUT = 0.8
"""A stretch that covers this part of the recording is called all of it."""
TELLING_FACTOR = 1.5
"""The sentence names a latency that is so many times that of the other run."""


@dataclass(frozen=True, slots=True)
class StretchOfRun:
    """Errors, dropped frames and latency of a run in a stretch of the recording; None where they are not known.

    ``error_m`` and ``latency_s`` are the largest ones, ``dropped`` counts frames.
    """

    error_m: float | None
    dropped: int | None
    latency_s: float | None


@dataclass(frozen=True, slots=True)
class RunDifference:
    """The stretch of the recording in which two runs differ the most.

    ``run`` is worse than ``other`` between ``from_s`` and ``until_s``, times of the recording; at ``peak_s`` the most.
    ``throughout`` is True if that is nearly all of it. ``lost`` is True if ``run`` has no pose there.
    """

    run: int
    other: int
    from_s: float
    until_s: float
    peak_s: float
    throughout: bool
    lost: bool
    worse: StretchOfRun
    better: StretchOfRun

    def words(self, subject: int) -> str:
        """The difference as a sentence about the run ``subject``; in brackets is what the other one did."""
        when = "nearly all the time" if self.throughout else _when(self.from_s, self.until_s)
        is_worse = subject == self.run
        against = self.other if is_worse else self.run
        start = f"Run {subject} is {'worse' if is_worse else 'better'} than run {against} {when}"
        mine, theirs = (self.worse, self.better) if is_worse else (self.better, self.worse)
        parts = []
        if self.lost:
            parts.append("no pose there" if is_worse else f"run {self.run} has no pose there")
        elif mine.error_m is not None and theirs.error_m is not None:
            parts.append(f"error {_short(mine.error_m)} m ({_short(theirs.error_m)} m)")

        # Dropped frames may explain the error if the worse run has more of them, latency if its own is far higher.
        more, fewer = self.worse.dropped, self.better.dropped
        if more is not None and fewer is not None and more > fewer:
            dropped, others = (more, fewer) if is_worse else (fewer, more)
            parts.append(f"{plural(dropped, 'frame')} dropped ({others})")
        high_s, low_s = self.worse.latency_s, self.better.latency_s
        if high_s is not None and low_s is not None and high_s >= TELLING_FACTOR * low_s:
            own_s, other_s = (high_s, low_s) if is_worse else (low_s, high_s)
            parts.append(f"latency {_short(own_s)} s ({_short(other_s)} s)")
        return f"{start}: {', '.join(parts)}." if parts else f"{start}."


def difference(first: tuple[int, RunSeries], second: tuple[int, RunSeries]) -> RunDifference | None:
    """The stretch in which one of two runs is worse than the other by the most.

    Args:
        first: A run and what is known of it over time, as :func:`from_start` returns it.
        second: Another run, over the same time.

    Returns:
        None if one of them has no errors, or if their errors never differ by more than is usual.
    """
    sides = (first, second)
    errors = [series.error for _, series in sides]
    if errors[0] is None or errors[1] is None:
        return None
    moments_s = np.unique(np.concatenate([samples.times_s for samples in errors if samples is not None]))
    if len(moments_s) < 2:
        return None
    # The errors at each moment, between the poses before and after; NaN in a gap and outside of all poses.
    known = []
    for samples in (errors[0], errors[1]):
        order = np.argsort(samples.times_s, kind="stable")
        times_s, values, pieces = samples.times_s[order], samples.values[order], samples.pieces[order]
        at_moments = np.interp(moments_s, times_s, values, left=np.nan, right=np.nan)
        if len(times_s) > 1:
            after = np.clip(np.searchsorted(times_s, moments_s), 1, len(times_s) - 1)
            in_gap = (pieces[after] != pieces[after - 1]) & (times_s[after] != moments_s)
            at_moments = np.where(in_gap, np.nan, at_moments)
        known.append(at_moments)
    both = np.isfinite(known[0]) & np.isfinite(known[1])
    if not both.any():
        return None
    usual_m = max(float(np.median(np.concatenate([values[np.isfinite(values)] for values in known]))), 1e-9)
    # A run that has no pose where the other has one is as bad as its largest error, and never better.
    largest_m = float(np.nanmax(np.concatenate(known)))
    filled = [np.where(np.isfinite(values), values, largest_m) for values in known]
    lasting_s = np.gradient(moments_s)
    neither = ~np.isfinite(known[0]) & ~np.isfinite(known[1])
    found = []
    for place in (0, 1):
        excess_m = np.where(neither, 0.0, filled[place] - filled[1 - place] - usual_m)
        total, start, end = _largest_sum(excess_m * lasting_s)
        if total > 0:
            # The peak is where there is something to see: a pose that is far away rather than none.
            seen_m = np.where(both, excess_m, -np.inf)[start : end + 1]
            peak = int((seen_m if np.isfinite(seen_m).any() else excess_m[start : end + 1]).argmax())
            found.append((total, place, start, end, start + peak))
    if not found:
        return None
    _, place, start, end, peak = max(found)
    (run, worse), (other, better) = sides[place], sides[1 - place]
    from_s, until_s = float(moments_s[start]), float(moments_s[end])
    return RunDifference(
        run=run,
        other=other,
        from_s=from_s,
        until_s=until_s,
        peak_s=float(moments_s[peak]),
        throughout=until_s - from_s >= THROUGHOUT * float(moments_s[-1] - moments_s[0]),
        lost=not np.isfinite(known[place][start : end + 1]).any(),
        worse=_stretch(worse, from_s, until_s),
        better=_stretch(better, from_s, until_s),
    )


def differences(baseline: tuple[int, RunSeries], others: Sequence[tuple[int, RunSeries]]) -> list[RunDifference]:
    """The differences of several runs to one, the longest-lasting and largest first by their peak error."""
    found = [entry for other in others if (entry := difference(other, baseline)) is not None]
    return sorted(found, key=lambda entry: -(entry.worse.error_m or 0.0))


def from_start(series: RunSeries, start_s: float) -> RunSeries:
    """The same data over the time since the header timestamp ``start_s``, so that runs lie on one axis."""
    own_s = series.start_s
    if own_s is None or own_s == start_s:
        return series
    shift_s = own_s - start_s

    def moved(samples: Samples | None) -> Samples | None:
        if samples is None or samples.origin_s is None:
            return samples
        return replace(samples, times_s=samples.times_s + shift_s, origin_s=start_s)

    played_s = None if series.played_s is None else (series.played_s[0] + shift_s, series.played_s[1] + shift_s)
    return replace(
        series,
        error=moved(series.error),
        latency=moved(series.latency),
        cpu=moved(series.cpu),
        memory=moved(series.memory),
        dropped_s=series.dropped_s + shift_s,
        played_s=played_s,
    )


def _largest_sum(terms: Array) -> tuple[float, int, int]:
    """The largest sum of consecutive terms, and the places of the first and the last of them."""
    best, running = (-np.inf, 0, 0), 0.0
    start = 0
    for place, term in enumerate(terms.tolist()):
        if running <= 0:
            running, start = term, place
        else:
            running += term
        if running > best[0]:
            best = (running, start, place)
    return best


def _stretch(series: RunSeries, from_s: float, until_s: float) -> StretchOfRun:
    dropped = None
    if series.latency is not None and series.latency.origin_s is not None:
        dropped = int(((series.dropped_s >= from_s - BEFORE_S) & (series.dropped_s <= until_s)).sum())
    return StretchOfRun(
        error_m=_largest(series.error, from_s, until_s),
        dropped=dropped,
        latency_s=_largest(series.latency, from_s - BEFORE_S, until_s),
    )


def _largest(samples: Samples | None, from_s: float, until_s: float) -> float | None:
    if samples is None or samples.origin_s is None:
        return None
    within = (samples.times_s >= from_s) & (samples.times_s <= until_s)
    return float(samples.values[within].max()) if within.any() else None


def _when(from_s: float, until_s: float) -> str:
    """A stretch of the recording in words: tenths of a second are enough to find it."""
    start, end = (f"{time_s:.1f}".removesuffix(".0") for time_s in (from_s, until_s))
    return f"at {start} s" if start == end else f"from {start} to {end} s"


def _short(value: float) -> str:
    """Two significant digits: a sentence is no table."""
    return f"{float(f'{value:.2g}'):g}"


# A run by its own measure, without another one to compare it with.


ODD_FACTOR = 3.0
"""An error is odd if it is so many times the median error of the run."""


@dataclass(frozen=True, slots=True)
class OddStretch:
    """The stretch in which a run is worst by its own measure: its errors are many times ``usual_m``, their median."""

    from_s: float
    until_s: float
    usual_m: float
    there: StretchOfRun

    @property
    def words(self) -> str:
        """The stretch as a sentence."""
        error = f"error up to {_short(self.there.error_m or 0.0)} m, {_short(self.usual_m)} m is usual"
        dropped = f"{plural(self.there.dropped, 'frame')} dropped" if self.there.dropped else ""
        latency = "" if self.there.latency_s is None else f"latency up to {_short(self.there.latency_s)} s"
        return f"Worst {_when(self.from_s, self.until_s)}: {', '.join(filter(None, (error, dropped, latency)))}."


def odd_stretch(series: RunSeries) -> OddStretch | None:
    """The stretch in which the errors of a run are far above its median error; None if they never are."""
    samples = series.error
    if samples is None or len(samples.values) < 2:
        return None
    order = np.argsort(samples.times_s, kind="stable")
    times_s, values = samples.times_s[order], samples.values[order]
    usual_m = float(np.median(values))
    total, start, end = _largest_sum(values - ODD_FACTOR * usual_m)
    if total <= 0:
        return None
    from_s, until_s = float(times_s[start]), float(times_s[end])
    return OddStretch(from_s, until_s, usual_m, _stretch(series, from_s, until_s))
