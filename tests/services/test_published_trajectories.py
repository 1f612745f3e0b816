"""The archive of an experiment's trajectories: what is in it, the same bytes each time, and evaluated again."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.verdict import VerdictKind
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from tests.services.fake_executor import FakeExecutor, write_trajectory

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import trajectories  # noqa: E402

pytestmark = pytest.mark.integration

PUBLISHED, RESULTS = ROOT / "docs" / "results" / "trajectories.tar.xz", ROOT / "docs" / "results.md"
KITTI_06 = ROOT.parent / "shared" / "data" / "kitti06_stereo_51" / "groundtruth_tum.txt"
LINE = "1317.0000001 0.12345678 -0.0000004 12 0 0 0.70710678 0.70710678\n"


def test_timestamps_stay_and_other_numbers_have_six_decimals() -> None:
    assert trajectories.rounded(f"# timestamp tx\n{LINE}\n") == (
        "1317.0000001 0.123457 -0.000000 12.000000 0.000000 0.000000 0.707107 0.707107\n"
    )


def test_runs_are_packed_evaluated_again_and_a_forged_one_is_found(hive: Hive, tmp_path: Path) -> None:
    hive.executors.opened = {"process": FakeExecutor(on_start=write_trajectory(12))}
    text = "name: twice\nalgorithms: tiny\ndatasets: track\nrepeats: 2\n"
    hive.experiments.start(ExperimentSource(text, "twice.yaml"))
    hive.worker().run(until_idle=True)
    target = tmp_path / "results" / "trajectories.tar.xz"
    assert trajectories.pack_experiment("twice", target).startswith(f"{target}: 2 runs, 2 trajectories, 0.00 MB")
    before = target.read_bytes()
    trajectories.pack_experiment("twice", target)
    assert target.read_bytes() == before
    runs = trajectories.read_archive(target)
    assert [entry.about["file"] for entry in runs] == ["track/tiny-1.txt", "track/tiny-2.txt"]
    assert runs[0].text is not None
    assert runs[0].text.splitlines()[1] == "100.333333 1.000000 1.000000 0.000000 0.000000 0.000000 0.000000 1.000000"
    assert (runs[0].about["state"], runs[0].about["poses"]) == ("succeeded", 12)
    assert runs[0].about[trajectories.ERROR] > 1
    truth = hive.settings.data / "datasets" / "track" / "groundtruth.txt"
    told = trajectories.check_archive(target, {"track": truth})
    assert told == "2 trajectories have the error that their runs had"
    runs[1].about[trajectories.ERROR] += 0.001
    target.write_bytes(trajectories.archive_of(runs))
    with pytest.raises(InvalidInput, match=r"track/tiny-2\.txt has an ATE of \d+\.\d+ m, the run had"):
        trajectories.check_archive(target, {"track": truth})
    with pytest.raises(InvalidInput, match="has no trajectory on room with an error"):
        trajectories.check_archive(target, {"room": truth})
    target.write_bytes(before[:200])
    with pytest.raises(InvalidInput, match="holds no trajectories"):
        trajectories.read_archive(target)
    with pytest.raises(NotFound, match="unknown experiment 'thrice'"):
        trajectories.pack_experiment("thrice", target)


PAGE = """
## `room`

| Algorithm | Runs | Failed | Poses | ATE RMSE in m | CPU |
| --- | ---: | ---: | --- | --- | --- |
| `good` | 2 | 0 | 9 ± 0 | 0.0150 ± 0.0071 | 1 |
| `bad` | 1 | 1 | – | – | – |
"""


def row(algorithm: str, repeat: int, ate_m: float | None, verdict: str) -> trajectories.Packed:
    about = {"dataset": "room", "algorithm": algorithm, "repeat": repeat, "file": None, "verdict": verdict}
    return trajectories.Packed({**about, trajectories.ERROR: ate_m}, None)


def test_the_page_with_the_results_has_the_means_of_the_runs(tmp_path: Path) -> None:
    target = tmp_path / "trajectories.tar.xz"
    runs = [row("good", 1, 0.01, "good"), row("good", 2, 0.02, "good"), row("bad", 1, 7.0, "diverged")]
    target.write_bytes(trajectories.archive_of(runs))
    assert trajectories.compare_tables(target, PAGE) == "2 mean errors are those of the page"
    with pytest.raises(InvalidInput, match=r"good on room: the page has 0\.0151 m, the runs have 0\.0150 m"):
        trajectories.compare_tables(target, PAGE.replace("0.0150", "0.0151"))
    with pytest.raises(InvalidInput, match=r"bad on room: the page has 0\.1 m, the runs have – m"):
        trajectories.compare_tables(target, PAGE.replace("1 | 1 | – | –", "1 | 1 | – | 0.1"))
    target.write_bytes(trajectories.archive_of([*runs, row("more", 1, 0.1, "good")]))
    with pytest.raises(InvalidInput, match="do not have the same algorithms"):
        trajectories.compare_tables(target, PAGE)
    read = dict(trajectories.rows_in(RESULTS.read_text(encoding="utf-8")))
    assert read["room", "aloam"][trajectories.ATE_COLUMN] == "0.0248 ± 0.0000"
    assert len(read) == 39


def test_what_is_no_ground_truth_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="'room' names no ground truth; write DATASET=FILE"):
        trajectories.truths_of(["room"])
    with pytest.raises(NotFound, match=r"nothing\.txt does not exist"):
        trajectories.truths_of([f"room={tmp_path}/nothing.txt"])
    with pytest.raises(NotFound, match="does not exist"):
        trajectories.read_archive(tmp_path / "nothing.tar.xz")


def test_published_trajectories_give_the_tables_of_the_page() -> None:
    page = RESULTS.read_text(encoding="utf-8")
    assert trajectories.compare_tables(PUBLISHED, page) == "39 mean errors are those of the page"
    with pytest.raises(InvalidInput, match=r"svo on kitti_06: the page has 0\.142 m, the runs have 0\.141 m"):
        trajectories.compare_tables(PUBLISHED, page.replace("| 0.141 ± 0.000 |", "| 0.142 ± 0.000 |"))


def test_published_runs_are_five_of_each_configuration_with_verdicts_as_in_the_tables() -> None:
    runs = [entry.about for entry in trajectories.read_archive(PUBLISHED)]
    repeats = Counter((run["dataset"], run["algorithm"]) for run in runs)
    assert (len(repeats), set(repeats.values())) == (39, {5})
    failed = Counter((run["dataset"], run["algorithm"]) for run in runs if run["verdict"] != VerdictKind.GOOD)
    stated = {place: int(cells[2]) for place, cells in trajectories.rows_in(RESULTS.read_text(encoding="utf-8"))}
    assert {place: failed[place] for place in repeats} == stated


@pytest.mark.shared_data
@pytest.mark.skipif(not KITTI_06.is_file(), reason="the recorded data in ../shared/data is not here")
def test_published_trajectories_on_kitti_have_the_errors_that_are_stated() -> None:
    told = trajectories.check_archive(PUBLISHED, {"kitti_06": KITTI_06})
    assert told == "30 trajectories have the error that their runs had"
