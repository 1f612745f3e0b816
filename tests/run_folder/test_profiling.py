from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from slamhive.domain.metrics import CATALOGUE
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.outcome import Evidence, TrajectoryCheck
from slamhive.run_folder.profiling import measure_run, read_profile, weighted_percentile, write_plots

START = datetime(2026, 1, 1, tzinfo=UTC)
END = START + timedelta(seconds=12.5)
EVIDENCE = Evidence(0, TrajectoryCheck(51))


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "1")
    folder.create()
    return folder


def write_profile(folder: RunFolder, rows: list[tuple[float, float, float]]) -> None:
    lines = [f"{time},{cpu},{memory}\n" for time, cpu, memory in rows]
    folder.profiling.write_text("time,cpu_usage,memory_usage\n" + "".join(lines))


def test_what_was_not_measured_is_absent(folder):
    assert measure_run(folder, START, END, {}, EVIDENCE) == {"duration": 12.5, "poses": 51.0}


def test_means_are_weighted_by_time(folder):
    write_profile(folder, [(0.1, 1.0, 100), (0.2, 1.0, 100), (0.3, 1.0, 100), (0.6, 3.0, 400)])
    metrics = measure_run(folder, START, END, {}, EVIDENCE)
    assert metrics["cpu.mean"] == pytest.approx((0.3 * 1 + 0.3 * 3) / 0.6)
    assert metrics["ram.mean"] == pytest.approx((0.3 * 100 + 0.3 * 400) / 0.6)
    assert metrics["cpu.max"] == 3.0
    assert metrics["cpu.p95"] == 3.0
    assert metrics["ram.max"] == 400


def test_a_gap_in_sampling_does_not_stretch_one_sample(folder):
    write_profile(folder, [(0.1, 1.0, 1), (0.2, 1.0, 1), (0.3, 1.0, 1), (60.3, 5.0, 1), (60.4, 1.0, 1)])
    assert measure_run(folder, START, END, {}, EVIDENCE)["cpu.mean"] == pytest.approx((4 * 1 + 5) / 5)


def test_file_cache_in_the_kernels_peak_is_no_need_of_the_algorithm(folder):
    write_profile(folder, [(0.1, 1.0, 100)])
    metrics = measure_run(folder, START, END, {"ram.charged_max": 999.0}, EVIDENCE)
    assert (metrics["ram.max"], metrics["ram.charged_max"]) == (100, 999)


def test_frames_and_playback(folder):
    folder.frames.write_text(
        "timestamp,received,done,dropped\n1,10.0,10.5,0\n2,11.0,11.1,0\n3,12.0,,1\n4,13.0,13.3,0\n"
    )
    folder.playback.write_text(json.dumps({"cpu_s": 2.0, "duration_s": 10.0, "lag_max_s": 0.25}))
    metrics = measure_run(folder, START, END, {}, EVIDENCE)
    assert metrics["frames.dropped"] == 1
    assert metrics["frames.dropped_fraction"] == 0.25
    assert metrics["latency.median"] == pytest.approx(0.3)
    assert metrics["latency.max"] == pytest.approx(0.5)
    assert metrics["cpu.player_mean"] == pytest.approx(2.0 / 12.5)
    assert metrics["playback.lag_max"] == 0.25
    assert all(not CATALOGUE[key].needs_protocol for key in metrics)


@pytest.mark.parametrize(("after_s", "known"), [(2.5, True), (0.0, True), (-0.1, False), (12.6, False)])
def test_start_up_ends_with_playback_and_lies_within_the_run(folder, after_s, known):
    folder.playback.write_text(json.dumps({"began_at_s": START.timestamp() + after_s}))
    metrics = measure_run(folder, START, END, {}, EVIDENCE)
    assert metrics.get("startup") == (pytest.approx(after_s) if known else None)


@pytest.mark.parametrize(
    ("queues", "dropped"),
    [
        ([{"topic": "/points", "dropped": 3, "delivered": 40}, {"topic": "/odom", "dropped": 0}], 3.0),
        ([], None),
        (None, None),
        ("many", None),
        ([{"topic": "/points", "dropped": "many"}, {"topic": "/odom", "dropped": 2}], None),
        ([{"dropped": 2}, 5], None),
    ],
)
def test_messages_dropped_in_queues_are_added_up(folder, queues, dropped):
    folder.playback.write_text(json.dumps({"queues": queues}))
    assert measure_run(folder, START, END, {}, EVIDENCE).get("queues.dropped") == dropped


def test_deadlines_are_the_recordings_frame_period(folder):
    """10 Hz: of five frames one is late by a hair, one on the dot, one lost."""
    lines = ["5.0,0.0,0.05,0", "5.1,0.1,0.2,0", "5.2,0.2,0.3001,0", "5.3,0.3,,1", "5.4,0.4,0.41,0"]
    folder.frames.write_text("\n".join(["timestamp,received,done,dropped", *lines]))
    assert measure_run(folder, START, END, {}, EVIDENCE)["deadline.missed_fraction"] == pytest.approx(2 / 5)


def test_cpu_time_by_second_of_data(folder):
    """Two cores for 3 s are 6 s of CPU time, for 1.5 s of recording."""
    write_profile(folder, [(k / 10, 2.0, 1) for k in range(1, 31)])
    folder.frames.write_text("timestamp,received,done,dropped\n10,0,1,0\n11.5,1,2,0\n")
    assert measure_run(folder, START, END, {}, EVIDENCE)["cpu.per_data_second"] == pytest.approx(4.0)


def test_one_frame_has_no_period_and_no_span(folder):
    write_profile(folder, [(0.1, 1.0, 1)])
    folder.frames.write_text("timestamp,received,done,dropped\n10,0,1,0\n")
    metrics = measure_run(folder, START, END, {}, EVIDENCE)
    assert metrics["latency.max"] == 1.0
    assert not {"deadline.missed_fraction", "cpu.per_data_second"} & set(metrics)


def energy(folder: RunFolder, rows: list[tuple[float, int, int]], range_uj: int = 1_000_000_000) -> float | None:
    lines = [f"{time},{package},{count},{range_uj}\n" for time, package, count in rows]
    folder.energy.write_text("time,package,energy_uj,range_uj\n" + "".join(lines))
    return measure_run(folder, START, END, {}, EVIDENCE).get("energy")


def test_energy_is_summed_over_packages_and_over_counters_that_begin_again(folder):
    first = [(0.0, 0, 999_000_000), (6.0, 0, 2_000_000), (12.4, 0, 7_000_000)]
    second = [(0.0, 1, 10), (6.0, 1, 500_010), (12.4, 1, 1_000_010)]
    assert energy(folder, first + second) == pytest.approx(3 + 5 + 1)


@pytest.mark.parametrize(
    "rows",
    [
        [],
        [(0.0, 0, 5)],
        [(0.0, 0, 5), (1.0, 0, 9)],
        [(11.5, 0, 5), (12.5, 0, 9)],
        [(0.0, 0, 5), (12.5, 0, 9)],
        [(0.0, 0, 5), (6.0, 0, 5), (12.5, 0, 5)],
    ],
)
def test_energy_of_a_part_of_the_run_is_none(folder, rows):
    assert energy(folder, rows) is None


def test_where_no_energy_could_be_read_there_is_none(folder):
    folder.energy.write_text("# not measured: energy cannot be measured: there is no /sys/class/powercap\n")
    assert "energy" not in measure_run(folder, START, END, {}, EVIDENCE)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1]",
        "{",
        '{"cpu_s": "x", "duration_s": 0}',
        '{"cpu_s": NaN, "duration_s": -1}',
        f'{{"cpu_s": {"9" * 401}, "lag_max_s": 1e400}}',
        '{"cpu_s": true, "lag_max_s": 1e200}',
        "[" * 100_000,
    ],
)
def test_forged_files_do_no_harm(folder, text):
    folder.playback.write_text(text)
    folder.frames.write_text("nonsense\n\x00,,\n")
    assert set(measure_run(folder, START, END, {}, EVIDENCE)) == {"duration", "poses"}


def test_numbers_that_nothing_measures_are_missing(folder):
    lines = ["1,inf,inf,0", "2,-1e308,1e308,0", "3,nan,1,0", "4,1.0,1.5,0"]
    folder.frames.write_text("\n".join(["timestamp,received,done,dropped", *lines]))
    assert measure_run(folder, START, END, {}, EVIDENCE)["latency.max"] == 0.5


def test_the_players_share_is_a_part_of_the_cpu_mean(folder):
    """The player alone keeps a core busy for 2 of 12.5 s: both figures say 0.16 cores, whatever the playback took."""
    write_profile(folder, [(k / 10, 1.0 if k <= 20 else 0.0, 1) for k in range(1, 126)])
    folder.playback.write_text(json.dumps({"cpu_s": 2.0, "duration_s": 0.5}))
    metrics = measure_run(folder, START, END, {}, EVIDENCE)
    assert metrics["cpu.player_mean"] == pytest.approx(metrics["cpu.mean"])


def test_half_written_lines_are_skipped(folder):
    folder.profiling.write_text("time,cpu_usage,memory_usage\n0.1,1.0,100\n0.2,1.")
    assert len(read_profile(folder.profiling)) == 1


def test_weighted_percentile():
    values = np.array([1.0, 2.0, 3.0])
    assert weighted_percentile(values, np.array([90.0, 6.0, 4.0]), 95) == 2.0
    assert weighted_percentile(values, np.array([1.0, 1.0, 98.0]), 50) == 3.0


@pytest.mark.integration
def test_plots(folder):
    for rows in ([], [(0.1, 1.0, 1e8)]):
        write_profile(folder, rows)
        write_plots(folder)
        assert not folder.profiling_cpu_plot.exists()
    write_profile(folder, [(t / 10, 1.0 + np.sin(t / 20), 1e8 + t * 1e6) for t in range(1, 200)])
    write_plots(folder)
    for path in (folder.profiling_cpu_plot, folder.profiling_ram_plot):
        assert path.read_bytes().startswith(b"\x89PNG")
