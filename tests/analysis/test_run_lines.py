"""Lines of runs: colours that stay, repeats folded into mean and band, latency."""

from __future__ import annotations

import numpy as np
import pytest

from slamhive.analysis.chart import RUN_COLOURS, Line
from slamhive.analysis.plot_types import PlotData, RunLatency, RunUsage
from slamhive.analysis.plot_types.looks import Curve, LineOptions, fold, lines_of, looks_of
from slamhive.analysis.plot_types.over_time import Latency, Usage
from slamhive.analysis.table import RunTable, make_table
from slamhive.run_folder.played_frames import RecordingClock
from tests.analysis.analysis_world import NoFiles, data_of

pytestmark = pytest.mark.integration  # pandas and scipy take seconds to load


def table_of(*failed: int) -> RunTable:
    """Runs 1 and 2 of configuration 7, run 3 of configuration 8."""
    facts: dict[str, list[object]] = {
        "run_id": [1, 2, 3],
        "configuration_id": [7, 7, 8],
        "algorithm": ["a", "a", "b"],
        "dataset": ["room"] * 3,
        "state": ["failed" if run in failed else "succeeded" for run in (1, 2, 3)],
        "evaluation": ["succeeded"] * 3,
    }
    return make_table(facts, {}, {})


def curve(run: int, level: float, end_s: float = 10.0) -> Curve:
    return Curve(run, np.array([0.0, end_s]), np.array([level, level]))


def test_every_run_of_a_comparison_has_a_colour_of_its_own():
    assert len(set(RUN_COLOURS)) == len(RUN_COLOURS) == 20


def test_a_given_order_keeps_colours_where_runs_are_left_out():
    looks = looks_of(table_of(), "run", [9, 3, 1, 2])
    assert [looks[run]["colour"] for run in (3, 1, 2)] == list(RUN_COLOURS[1:4])


def test_folding_takes_the_mean_where_all_repeats_have_values():
    times_s, mean, low, high = fold([curve(1, 1.0), curve(2, 3.0, end_s=5.0)])
    assert (times_s[0], times_s[-1]) == (0.0, 5.0)
    assert (set(mean), set(low), set(high)) == ({2.0}, {1.0}, {3.0})


def test_a_gap_does_not_break_a_folded_line():
    broken = Curve(1, np.array([0.0, 4.0, np.nan, 6.0, 10.0]), np.array([1.0, 1.0, np.nan, 1.0, 1.0]))
    assert np.isfinite(fold([broken, curve(2, 3.0)])[1]).all()


def test_repeats_are_one_line_and_a_failed_run_keeps_its_own():
    curves = [curve(1, 1.0), curve(2, 3.0), curve(3, 5.0)]
    table = table_of()
    lines = list(lines_of(curves, table, looks_of(table, "configuration"), folded=True))
    assert [line.name for line in lines] == ["configuration 7, a, 2 repeats", "configuration 8, b"]
    table = table_of(2)
    lines = list(lines_of(curves, table, looks_of(table, "configuration"), folded=True))
    assert [line.dashed for line in lines] == [False, True, False]
    assert all(line.low is None for line in lines)


class Timed(NoFiles):
    """Runs 1 and 3 report their frames."""

    def latency(self, run_id: int) -> RunLatency | None:
        return None if run_id == 2 else RunLatency(run_id, np.array([100.0, 101.0]), np.array([0.02, 0.03]))

    def first_frame_s(self, run_id: int) -> float | None:
        return {1: 99.5, 2: 99.0}.get(run_id)


def test_latency_is_drawn_in_milliseconds_and_names_runs_without_it():
    table = latency_table()
    told: list[float] = []
    data = PlotData(table, data_of(table).every_protocol, Timed(), told.append)
    result = Latency().build(data, LineOptions(coloured_by="run"))
    lines = [mark for mark in result.charts[0].marks if isinstance(mark, Line)]
    assert [line.runs for line in lines] == [1, 3]
    assert lines[0].y.tolist() == pytest.approx([20.0, 30.0])
    assert [line.x.tolist() for line in lines] == [[1.0, 2.0]] * 2, "run 2 has the first frame"
    assert [(entry.reason, entry.runs) for entry in result.excluded] == [("no frame times", (2,))]
    assert told == [0.0, 1 / 3, 2 / 3]


def test_the_first_runs_with_files_are_drawn_and_the_others_named():
    table = latency_table()
    data = PlotData(table, data_of(table).every_protocol, Timed())
    result = Latency().build(data, LineOptions(most_runs=1))
    assert [(entry.reason, entry.runs) for entry in result.excluded] == [("more runs than are drawn", (2, 3))]


def latency_table() -> RunTable:
    table = table_of()
    metrics = {key: [0.02, None, 0.02] for key in ("latency.median", "latency.p95")}
    facts = {key: table.frame[key].tolist() for key in ("run_id", "configuration_id", "algorithm", "dataset", "state")}
    return make_table(facts, {}, metrics)


class Sampled(Timed):
    """Runs 1 and 3 were sampled at 0, 2 and 4 s. The recording was played at half speed from ``startup_s`` on."""

    def usage(self, run_id: int, startup_s: float | None) -> RunUsage | None:
        if run_id == 2:
            return None
        times_s = np.array([0.0, 2.0, 4.0])
        clock = None
        if startup_s is not None:
            clock = RecordingClock(np.array([startup_s, startup_s + 2.0]), np.array([100.0, 101.0]))
        return RunUsage(run_id, times_s, np.array([1.0, 2.0, 3.0]), np.array([1e6, 2e6, 3e6]), clock)


def usage_lines(startups_s: list[float | None]) -> tuple[str, list[list[float]], str]:
    """The time axis, the times of each line, and the caption."""
    table = table_of()
    facts = {key: table.frame[key].tolist() for key in ("run_id", "configuration_id", "algorithm", "dataset", "state")}
    keys = ("cpu.mean", "cpu.max", "ram.max")
    table = make_table(facts, {}, {**{key: [1.0, None, 1.0] for key in keys}, "startup": startups_s})
    chart = Usage().build(PlotData(table, data_of(table).every_protocol, Sampled()), LineOptions()).charts[0]
    lines = [mark.x.tolist() for mark in chart.marks if isinstance(mark, Line)]
    return chart.x.label, lines, chart.caption


def test_cpu_and_memory_are_over_the_time_of_the_recording():
    label, lines, caption = usage_lines([2.0, None, 1.0])
    assert label == "recording time"
    assert lines == [[-1.0, 1.0, 2.0], [0.0, 1.5, 3.0]]
    assert "0 s at the first frame" in caption


def test_a_run_that_does_not_say_when_it_played_keeps_all_on_the_time_of_their_runs():
    label, lines, caption = usage_lines([2.0, None, None])
    assert label == "time since the start of the run"
    assert lines == [[0.0, 2.0, 4.0]] * 2
    assert "run 3 does not state when a frame was played" in caption
