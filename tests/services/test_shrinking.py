"""``slamhive gate shrink``: with made-up runs, and once with real ones."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.cli import main
from slamhive.documents.gate import ShrinkAnswer
from slamhive.documents.submission import Submission
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.gate import BisectOutcome, Margin
from slamhive.domain.metrics import metric
from slamhive.domain.question import RunBudget
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.domain.verdict import VerdictKind
from slamhive.packages.dataset_file import dataset_to_yaml, load_dataset
from slamhive.services.gates.shrinking import Fault, ShrinkRequest, ShrinkSearch
from slamhive.services.gates.trials import TrialRuns
from slamhive.services.hive import Hive
from tests.services.tiny_project import MAPPING

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

RECORDED_S = (1000.0, 1100.0)
CLIPPED = Dataset(
    name="track",
    folder=Path("track"),
    bag="track.bag",
    duration_s=100.0,
    sensors=(Sensor("lidar", SensorKind.LIDAR, "/points", 10.0), Sensor("imu", SensorKind.IMU, "/imu", 100.0)),
    groundtruth=None,
    checksum="",
)
Outcome = Callable[[str, float, float], float | None]
"""The error of a run of an algorithm on a clip (from and to in s); None if it crashes."""


class MadeUpTrials:
    """Trials whose runs end at once."""

    def __init__(self, outcome: Outcome) -> None:
        self._outcome = outcome
        self._runs: dict[Submission, list[Any]] = {}
        self.clips: list[tuple[float, float]] = []

    def check(self, _submission: Submission) -> None:
        pass

    def of(self, submission: Submission) -> TrialRuns:
        return TrialRuns(tuple(self._runs.get(self._key(submission), ())), "ate.rmse")

    def ask(self, submission: Submission, wanted: int) -> list[int]:
        runs = self._runs.setdefault(self._key(submission), [])
        span = submission.variant[-1].options if submission.variant else {"begin_s": 1000.0, "end_s": 1100.0}
        begin_s, end_s = (float(span[key]) - RECORDED_S[0] for key in ("begin_s", "end_s"))
        while len(runs) < wanted:
            error_m = self._outcome(submission.algorithm, begin_s, end_s)
            crashed = error_m is None
            runs.append(
                SimpleNamespace(
                    id=len(runs) + 1,
                    dataset="track",
                    state=RunState.FAILED if crashed else RunState.SUCCEEDED,
                    reason=FailureReason.NONZERO_EXIT if crashed else None,
                    judged=None if crashed else VerdictKind.GOOD,
                    metrics={} if crashed else {"ate.rmse": error_m},
                    started_at=None,
                    ended_at=None,
                )
            )
        return []

    @staticmethod
    def _key(submission: Submission) -> Any:
        return submission.algorithm, submission.variant


def searched(
    outcome: Outcome, *, other: str | None = None, failure: FailureReason | None = None, **options: Any
) -> tuple[float, float, BisectOutcome, ShrinkAnswer]:
    request = ShrinkRequest(7, metric("ate.rmse"), Margin(0.05), Path("clip"), **options)
    own = Submission("slam@2", "track")
    good = None if other is None else replace(own, algorithm=other)
    fault = Fault(request, MadeUpTrials(outcome), own, "is bad", other=good, failure=failure)  # type: ignore[arg-type]
    search = ShrinkSearch(request, fault, CLIPPED, RECORDED_S, lambda _line: None)
    clip, steps, found = search.run(lambda _runs: None)
    run = SimpleNamespace(id=7, dataset="track")
    answer = search.answer(run, clip, steps, BisectOutcome.UNDECIDED, ["lidar"])  # type: ignore[arg-type]
    return clip[0] - RECORDED_S[0], clip[1] - RECORDED_S[0], found, answer


@pytest.mark.parametrize("seed", range(3))
def test_the_part_in_which_a_regression_shows_is_found_in_noise(seed: int):
    rng = np.random.default_rng(seed)

    def error_m(algorithm: str, begin_s: float, end_s: float) -> float:
        shown = algorithm == "slam@2" and begin_s <= 61.0 and end_s >= 66.5
        return 0.05 * (1.3 if shown else 1.0) * math.exp(rng.normal(0, 0.03))

    begin_s, end_s, outcome, answer = searched(error_m, other="slam@1")
    assert outcome is BisectOutcome.FOUND
    assert (begin_s <= 61.0, end_s >= 66.5) == (True, True)
    assert end_s - begin_s <= 100 / 5
    assert answer.decisions <= 2 * math.log2(100 / 1.5) + 1


def test_a_failure_that_does_not_always_come_is_found():
    rng = np.random.default_rng(1)

    def crash(_algorithm: str, begin_s: float, end_s: float) -> float | None:
        return None if begin_s <= 20.0 and end_s >= 25.0 and rng.random() < 0.9 else 0.05

    begin_s, end_s, outcome, _ = searched(crash, failure=FailureReason.NONZERO_EXIT)
    assert (outcome, begin_s <= 20.0, end_s >= 25.0, end_s - begin_s <= 20.0) == (BisectOutcome.FOUND, True, True, True)


def test_another_failure_on_a_short_clip_does_not_count():
    def too_slow(_algorithm: str, _begin_s: float, end_s: float) -> float | None:
        return None if end_s < 50 else 0.05  # short clips crash, the whole does not

    with pytest.raises(InvalidInput, match=r"say that the recording does not show it: 0 of \d+ runs"):
        searched(too_slow, failure=FailureReason.TIMEOUT)


def test_an_error_above_a_number_needs_no_other_version():
    def drift(_algorithm: str, begin_s: float, end_s: float) -> float:
        return 0.002 * (end_s - begin_s)

    begin_s, end_s, outcome, _ = searched(drift, worse_than=0.03)
    assert outcome is BisectOutcome.FOUND
    assert end_s - begin_s == pytest.approx(15.0, abs=2.0)


def test_a_spent_budget_says_how_far_it_came():
    def always(_algorithm: str, _begin_s: float, _end_s: float) -> float | None:
        return None

    _, _, outcome, answer = searched(always, failure=FailureReason.NONZERO_EXIT, budget=RunBudget(runs=12))
    assert outcome is BisectOutcome.UNDECIDED
    assert answer.words.startswith("Undecided after ")


# With real runs of processes.


def record(folder: Path) -> None:
    """60 s with one message a second of two sensors and of something else; the LiDAR meets a pothole at 50 s."""
    store = get_typestore(Stores.ROS1_NOETIC)
    folder.mkdir(parents=True)
    with Writer(folder / "street.bag") as bag:
        topics = {
            topic: bag.add_connection(topic, "std_msgs/msg/String", typestore=store)
            for topic in ("/points", "/imu", "/other")
        }
        for second in range(60):
            for topic, connection in topics.items():
                text = "pothole" if topic == "/points" and second == 50 else topic
                message = store.types["std_msgs/msg/String"](text)
                raw = store.serialize_ros1(message, "std_msgs/msg/String")
                bag.write(connection, (100 + second) * 1_000_000_000, raw)
    truth = "".join(f"{100 + i} {i} {i * i / 40} 0 0 0 0 1\n" for i in range(60))
    (folder / "groundtruth.txt").write_text(f"# time x y z qx qy qz qw\n{truth}")
    dataset = replace(
        CLIPPED,
        name="street",
        folder=folder,
        bag="street.bag",
        duration_s=59.0,
        groundtruth=GroundTruth("groundtruth.txt", gravity_aligned=True),
        checksum="sha256:" + "0" * 64,
    )
    (folder / "dataset.yaml").write_text(dataset_to_yaml(dataset))


def test_a_crash_is_shown_by_the_second_half_of_a_real_recording(hive: Hive, tmp_path: Path):
    record(hive.settings.datasets_folder / "street")
    mapping = hive.project_root / "algorithms" / "tiny" / "slamhive" / "mapping.py"
    bags = 'pathlib.Path(os.environ["SLAMHIVE_DATASET"]).glob("*.bag")'
    crash = f'if any(b"pothole" in path.read_bytes() for path in {bags}):\n    sys.exit(7)\n'
    mapping.write_text(MAPPING.replace('print("tiny', crash + 'print("tiny'))
    (run,) = hive.runs.submit(Submission("tiny", "street", {"seconds": 0}))
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run.id).exit_code == 7
    options = ["--step", "30", "--error", "0.5", "--to", str(tmp_path / "clip"), "--json"]
    done = CliRunner().invoke(main, ["gate", "shrink", str(run.id), *options])
    assert done.exit_code == 0, done.output
    answer = ShrinkAnswer.read(json.loads(done.stdout))
    assert (answer.begin_s, round(answer.end_s, 6), answer.decisions) == (30.0, 59.0, 3)
    assert (answer.sensors, answer.left_out) == (("lidar",), ("imu",))
    clip = load_dataset(tmp_path / "clip")
    assert [sensor.name for sensor in clip.sensors] == ["lidar"]
    assert clip.duration_s == pytest.approx(29.0, abs=0.1)
    with AnyReader([clip.bag_path]) as reader:
        assert {entry.topic: entry.msgcount for entry in reader.connections if entry.msgcount} == {"/points": 30}
    truth = (tmp_path / "clip" / "groundtruth.txt").read_text().splitlines()
    assert (truth[0][0], len(truth), truth[1].split()[0]) == ("#", 31, "130")
    made = hive.searches.find("")
    refused = CliRunner().invoke(main, ["gate", "shrink", str(run.id), *options])
    assert (refused.exit_code, "exists already; choose another folder" in refused.stderr) == (2, True)
    again = CliRunner().invoke(main, ["gate", "shrink", str(run.id), *options[:4], "--to", str(tmp_path / "again")])
    assert hive.searches.find("") == made
    assert (
        f"Run {run.id} failed (nonzero exit): 29.0 s of 59.0 s, from 30.0 s on, with lidar, still show it"
        in again.stderr
    )
    assert "30.0" in again.stdout
