"""Where one run is worse than another over the recording, and what is said about it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamhive.services.run_differences import difference, differences, from_start, odd_stretch
from slamhive.services.runs import Array, Places, RunSeries, Samples

TIMES_S = np.arange(0.0, 20.0, 0.1)


def samples(
    values: Array, *, times_s: Array = TIMES_S, origin_s: float = 1000.0, pieces: Places | None = None
) -> Samples:
    numbered = np.zeros(len(times_s), np.int64) if pieces is None else pieces
    return Samples(times_s, values, len(values), numbered, origin_s)


def run(error: Samples | None, latency: Samples | None = None, dropped_s: tuple[float, ...] = ()) -> RunSeries:
    return RunSeries(
        estimate=None,
        groundtruth=None,
        aligned=False,
        gap_s=math.inf,
        error=error,
        cpu=None,
        memory=None,
        latency=latency,
        dropped_s=np.array(dropped_s),
        played_s=None,
        reasons={},
    )


def usual(level_m: float = 0.05) -> Array:
    """An error that goes up and down a little, as that of any good run."""
    found: Array = level_m * (1 + 0.2 * np.sin(TIMES_S))
    return found


def with_peak(height_m: float, from_s: float, until_s: float) -> Array:
    return np.where((from_s <= TIMES_S) & (until_s >= TIMES_S), height_m, usual())


def test_the_stretch_and_its_causes_are_named():
    good = run(samples(usual()), samples(np.full(200, 0.04)))
    latency = np.where((TIMES_S > 9.5) & (TIMES_S < 12), 1.3, 0.05)
    dropped_s = tuple(np.linspace(9.2, 11.0, 11))
    bad = run(samples(with_peak(0.42, 10.0, 12.0)), samples(latency), dropped_s)
    found = difference((128, bad), (127, good))
    assert found is not None
    assert found.words(128) == (
        "Run 128 is worse than run 127 from 10 to 12 s: error 0.42 m (0.045 m), "
        "11 frames dropped (0), latency 1.3 s (0.04 s)."
    )
    assert found.words(127) == (
        "Run 127 is better than run 128 from 10 to 12 s: error 0.045 m (0.42 m), "
        "0 frames dropped (11), latency 0.04 s (1.3 s)."
    )
    assert 10.0 <= found.peak_s <= 12.0


def test_the_order_of_the_runs_does_not_matter():
    good, bad = run(samples(usual())), run(samples(with_peak(0.3, 4.0, 5.0)))
    first, second = difference((1, good), (2, bad)), difference((2, bad), (1, good))
    assert first is not None
    assert second is not None
    assert (first.run, first.other, first.from_s) == (second.run, second.other, second.from_s) == (2, 1, first.from_s)


def test_runs_that_differ_by_less_than_their_usual_error_do_not_differ():
    assert difference((1, run(samples(usual()))), (2, run(samples(usual(0.06))))) is None


def test_a_run_that_is_worse_all_the_time_says_so():
    found = difference((1, run(samples(usual()))), (2, run(samples(usual(0.5)))))
    assert found is not None
    assert found.throughout
    assert found.words(2).startswith("Run 2 is worse than run 1 nearly all the time: error 0.6 m (0.06 m)")


def test_what_does_not_explain_the_error_is_not_told():
    """The worse run dropped fewer frames, so they are not why it is worse."""
    good = run(samples(usual()), samples(np.full(200, 0.05)), tuple(np.linspace(10.0, 11.0, 30)))
    bad = run(samples(with_peak(0.42, 10.0, 12.0)), samples(np.full(200, 0.06)))
    found = difference((1, good), (2, bad))
    assert found is not None
    assert found.words(2) == "Run 2 is worse than run 1 from 10 to 12 s: error 0.42 m (0.045 m)."


def test_a_stretch_without_a_pose_counts_as_worse():
    """The second run has no pose from 8 to 14 s: a gap between two pieces."""
    kept = (TIMES_S < 8.0) | (TIMES_S > 14.0)
    pieces = (TIMES_S[kept] > 14.0).astype(np.int64)
    lost = run(samples(usual()[kept], times_s=TIMES_S[kept], pieces=pieces))
    good = run(samples(np.where(TIMES_S == 0.0, 0.4, usual())))
    found = difference((1, good), (2, lost))
    assert found is not None
    assert found.lost
    assert (found.from_s, found.until_s) == pytest.approx((8.0, 14.0), abs=0.2)
    assert found.words(2) == "Run 2 is worse than run 1 from 8 to 14 s: no pose there."
    assert found.words(1) == "Run 1 is better than run 2 from 8 to 14 s: run 2 has no pose there."


@pytest.mark.parametrize("missing", [None, samples(np.array([0.1]), times_s=np.array([3.0]))])
def test_runs_without_errors_cannot_be_told_apart(missing: Samples | None):
    assert difference((1, run(missing)), (2, run(missing))) is None


def test_the_largest_of_several_differences_comes_first():
    good = run(samples(usual()))
    others = [(2, run(samples(with_peak(0.2, 3.0, 5.0)))), (3, run(samples(with_peak(0.9, 7.0, 9.0)))), (4, good)]
    assert [entry.run for entry in differences((1, good), others)] == [3, 2]


def test_runs_that_began_at_different_frames_are_put_on_one_clock():
    later = run(samples(usual(), origin_s=1003.0), dropped_s=(1.0,))
    moved = from_start(later, 1000.0)
    assert moved.error is not None
    assert (moved.error.origin_s, moved.error.times_s[0]) == (1000.0, 3.0)
    assert moved.dropped_s.tolist() == [4.0]
    assert moved.start_s == 1000.0
    assert from_start(run(None), 1000.0).start_s is None


def test_a_run_alone_names_its_worst_stretch():
    found = odd_stretch(run(samples(with_peak(0.42, 10.0, 12.0)), None))
    assert found is not None
    assert found.words == "Worst from 10 to 12 s: error up to 0.42 m, 0.054 m is usual."
    assert odd_stretch(run(samples(usual()))) is None
    assert odd_stretch(run(None)) is None
