"""Figure data: thinning, malformed files, and real evaluations of real runs."""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamhive.base.project import project_root
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.job import EvaluationTask
from slamhive.services.runs.series import MAX_POINTS, PathSeries, read_track, run_series, thin_keeping_extremes
from slamhive.web.figures import ShownEstimate, best_plane, plane_figures, run_figures, space_figures, timeline
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

EUROC = project_root().parent / "shared" / "data" / "euroc_vio_runs"


def test_thinning_keeps_every_peak():
    values = np.zeros(100_000)
    values[[7, 50_001, 99_990]] = [5.0, -3.0, 9.0]
    kept = thin_keeping_extremes(values)
    assert len(kept) <= MAX_POINTS
    assert {5.0, -3.0, 9.0} <= set(values[kept].tolist())
    assert (np.diff(kept) > 0).all()


def test_a_gap_parts_a_path_however_it_is_thinned(tmp_path: Path):
    path = tmp_path / "traj.txt"
    stamps_s = [*range(10_000), *range(10_500, 12_000)]
    path.write_text("".join(f"{stamp} {stamp} 0 0 0 0 0 1\n" for stamp in stamps_s))
    track = read_track(path, gap_s=1.0)
    assert track is not None
    assert len(track.times_s) <= MAX_POINTS
    assert sorted(set(track.pieces.tolist())) == [0, 1]
    assert track.times_s[track.pieces == 1].min() >= 10_500 > track.times_s[track.pieces == 0].max()


def test_lost_tracking_is_drawn_apart_from_the_path():
    stamps_s = np.array([0.0, 1.0, 5.0, 6.0])
    pieces = np.array([0, 0, 1, 1])
    track = PathSeries(stamps_s, np.column_stack([stamps_s, stamps_s, stamps_s]), 4, pieces)
    errors_m = np.array([0.1, 0.2, 0.3, 0.4])
    estimate = ShownEstimate("estimate", track, "#123456", errors_m, origin_s=0.0)
    line, lost = plane_figures(None, estimate)["path_xy"]["data"][:2]
    assert _numbers(line["x"]) == [0.0, 1.0, None, 5.0, 6.0]
    assert lost["name"] == "tracking lost"
    assert _numbers(lost["x"]) == [1.0, 5.0, None]
    assert _numbers(line["times_s"]) == [0.0, 1.0, None, 5.0, 6.0]
    assert _numbers(line["errors_m"]) == pytest.approx([0.1, 0.2, None, 0.3, 0.4])
    in_space = space_figures(None, estimate)["path"]["data"]
    assert [trace["name"] for trace in in_space][:2] == ["estimate", "tracking lost"]


def _numbers(values: Any) -> list[float | None]:
    """What a trace holds, whether it is packed or not."""
    packed = isinstance(values, dict)
    numbers = np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"]).tolist() if packed else values
    return [None if value is None or math.isnan(value) else value for value in numbers]


@pytest.mark.parametrize(
    "text", ["", "\n", "# only a comment\n", "1 2 3\n", "a b c d e f g h\n", "nan nan nan nan 0 0 0 1\n", "\x00\xff"]
)
def test_a_malformed_trajectory_draws_nothing(tmp_path: Path, text: str):
    path = tmp_path / "traj.txt"
    path.write_text(text)
    assert read_track(path) is None
    assert read_track(tmp_path / "missing.txt") is None


def test_one_pose_is_a_path(tmp_path: Path):
    (tmp_path / "traj.txt").write_text("1 2 3 4 0 0 0 1\n")
    track = read_track(tmp_path / "traj.txt")
    assert track is not None
    assert track.positions_m.tolist() == [[2.0, 3.0, 4.0]]
    assert best_plane(track) in {"xy", "xz", "yz"}


def test_a_single_pose_can_be_drawn(web: Web):
    folder = web.hive.runs.folder(web.runs["bare"])
    folder.trajectory.write_text("1 2 3 4 0 0 0 1\n")
    figures = web.client.get(f"/runs/{web.runs['bare']}/figures.json").get_json()["figures"]
    assert _numbers(figures["path_xy"]["data"][0]["x"]) == [2.0]
    track = read_track(folder.trajectory)
    assert track is not None
    scene = space_figures(track, None)["path"]["layout"]["scene"]
    assert all(math.isfinite(value) for value in scene["aspectratio"].values())


def test_dropped_frames_are_counted_over_the_recording(web: Web):
    run = web.hive.runs.get(web.runs["bare"])
    folder = web.hive.runs.folder(run.id)
    dropped = "".join(f"{1000 + at},{at},,1\n" for at in (2.0, 2.5, 4.25))
    folder.frames.write_text(f"timestamp,received,done,dropped\n1000.0,0,0.1,0\n{dropped}1006.0,6,6.1,0\n")
    series = run_series(run, folder)
    trace = run_figures(series, "eye-slam", "#123456")["dropped"]["data"][0]
    steps = dict(zip(_numbers(trace["x"]), _numbers(trace["y"]), strict=True))
    assert {at: count for at, count in steps.items() if count} == {2.0: 2.0, 4.0: 1.0}
    known = timeline(series)
    assert known is not None
    assert known["origins"]["dropped"] == known["origin_s"] == 1000.0


FRAMES = "timestamp,received,done,dropped\n1000.0,0.0,0.03,0\n"


@pytest.mark.parametrize(
    "frames",
    [FRAMES + "9" * 200_000 + ",,,\n", FRAMES.replace("\n", "\r"), FRAMES + "\x00,,\n", FRAMES + "inf,1,2,0\n"],
)
def test_hostile_frame_times_draw_what_can_be_drawn(web: Web, frames: str):
    run_id = web.runs["bare"]
    web.hive.runs.folder(run_id).frames.write_bytes(frames.encode())
    assert web.client.get(f"/runs/{run_id}/figures.json").status_code == 200
    latency = web.hive.runs.series(run_id).latency
    assert latency is not None
    assert latency.values.tolist() == [0.03]


def test_all_plots_over_time_share_the_time_of_the_recording(web: Web):
    run = web.hive.runs.get(web.runs["bare"])
    folder = web.hive.runs.folder(run.id)
    folder.frames.write_text("timestamp,received,done,dropped\n1000.0,0,0.1,0\n1002.0,1,1.1,0\n")
    folder.profiling.write_text("time,cpu_usage,memory_usage\n0.5,1.0,100\n2.0,1.0,100\n4.0,1.0,100\n")
    series = run_series(replace(run, metrics={"startup": 2.0}), folder)
    assert series.cpu is not None
    assert series.cpu.times_s.tolist() == [-1.5, 0.0, 3.0]
    assert series.played_s == (0.0, 2.0)
    figures = run_figures(series, "eye-slam", "#123456")
    ranges = [figures[key]["layout"]["xaxis"]["range"] for key in ("cpu", "memory", "latency")]
    assert ranges == [[-1.5, 3.0]] * 3
    assert [(area["x0"], area["x1"]) for area in figures["cpu"]["layout"]["shapes"]] == [(-1.5, 0.0), (2.0, 3.0)]
    known = timeline(series)
    assert known is not None
    assert known["origins"] == dict.fromkeys(("latency", "cpu", "memory"), 1000.0)
    assert (known["from_s"], known["until_s"]) == (1000.0, 1002.0)


def test_usage_of_an_older_run_is_over_the_time_of_the_run(web: Web):
    run = web.hive.runs.get(web.runs["bare"])
    folder = web.hive.runs.folder(run.id)
    folder.profiling.write_text("time,cpu_usage,memory_usage\n0.5,1.0,100\n2.0,1.0,100\n")
    series = run_series(replace(run, metrics={}), folder)
    assert series.cpu is not None
    assert series.cpu.times_s.tolist() == [0.5, 2.0]
    title = run_figures(series, "eye-slam", "#123456")["cpu"]["layout"]["xaxis"]["title"]["text"]
    assert title == "time since the start of the run [s]"


@pytest.mark.integration
@pytest.mark.shared_data
def test_figures_show_what_evo_computed_on_a_real_run(web: Web):
    if not EUROC.is_dir():
        pytest.skip("../shared/data/euroc_vio_runs is not there")
    from slamhive.evaluation.references import References  # noqa: PLC0415
    from slamhive.evaluation.work import run_task  # noqa: PLC0415 - evo takes a second to import

    run_id = web.runs["bare"]
    estimate = min((EUROC / "vio_stereo" / "MH_01").glob("*.txt"))
    folder = web.hive.runs.folder(run_id)
    folder.trajectory.write_bytes(estimate.read_bytes())
    protocol = Protocol(Alignment.SE3)
    world.evaluate_run(web.hive, run_id)
    output = folder.evaluation(protocol.fingerprint)
    task = EvaluationTask(str(run_id), estimate, EUROC / "MH_01" / "groundtruth.txt", output, protocol)
    result = run_task(task, References())
    assert result.reason is None
    content = web.client.get(f"/runs/{run_id}/figures.json").get_json()
    assert f"{result.matched_poses:,} matched poses" in content["captions"]["error"]
    series = web.hive.runs.series(run_id)
    assert series.error is not None
    assert series.error.values.max() == pytest.approx(result.metrics["ate.max"], abs=1e-8)
    assert series.aligned


def test_no_figure_offers_to_upload_itself():
    drawing = [path for path in (project_root() / "static").glob("*.js") if "Plotly.react" in path.read_text()]
    assert [path.name for path in drawing] == ["report.js"], "one place draws, so that one place forbids it"
    script = drawing[0].read_text()
    assert script.count("Plotly.react") == 1
    assert '"sendChartToCloud"' in script
    assert 'plotlyServerURL: ""' in script
