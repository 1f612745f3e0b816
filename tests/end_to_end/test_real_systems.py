"""Real SLAM systems in their Docker images, on recorded and on rendered data, through the whole product."""

from __future__ import annotations

import os
from dataclasses import replace
from unittest import mock

import pytest

from slamhive.base.project import project_root
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from tests.real_datasets import dataset

pytestmark = [pytest.mark.integration, pytest.mark.docker]


@pytest.fixture
def kitti_06(systems: Hive) -> str:
    return dataset(systems, "kitti_06")


@pytest.fixture
def room(systems: Hive) -> str:
    return dataset(systems, "room")


def run(hive: Hive, *submissions: Submission, slots: int = 1) -> list[RunRecord]:
    run_ids = [entry.id for submission in submissions for entry in hive.runs.submit(submission)]
    with mock.patch.object(hive, "settings", hive.settings.with_values({"worker_slots": slots})):
        hive.worker(only=run_ids).run(until_idle=True)
    ended = [hive.runs.get(run_id) for run_id in run_ids]
    for entry in ended:
        assert entry.state is RunState.SUCCEEDED, f"{entry.detail}: {hive.runs.log(entry.id)[-2000:]}"
    return ended


def figure(entry: RunRecord, key: str) -> float:
    assert entry.metrics is not None
    return entry.metrics[key]


@pytest.mark.alone
@pytest.mark.shared_data
def test_orb_slam3_stereo_on_kitti_06(systems, kitti_06):
    for entry in run(systems, Submission("orb-slam3-stereo", kitti_06, {"nFeatures": 2000}, repeat=3)):
        assert entry.poses is not None
        assert entry.poses >= 50
        assert figure(entry, "ate.rmse") < 0.10
        assert entry.protocol is not None
        assert entry.protocol.label.startswith("SE(3)")
        vocabulary = systems.runs.record(entry.id)["about"]["vocabulary"]
        assert vocabulary["words"] > 5000


@pytest.mark.alone
@pytest.mark.shared_data
def test_orb_slam3_mono_on_kitti_06(systems, kitti_06):
    for entry in run(systems, Submission("orb-slam3-mono", kitti_06, {"nFeatures": 2000}, repeat=3)):
        assert entry.poses is not None
        assert entry.poses >= 45
        assert figure(entry, "ate.rmse") < 0.5
        assert entry.protocol is not None
        assert entry.protocol.label.startswith("Sim(3)")


@pytest.mark.alone
def test_lidar_systems_on_the_room(systems, room):
    # Each needs less than half of the core that its slot gives it, so they need not wait for each other.
    slots = min(2, len(os.sched_getaffinity(0)))
    for entry in run(systems, Submission("kiss-icp", room), Submission("rko-lio", room), slots=slots):
        assert figure(entry, "ate.rmse") < 0.10
        assert figure(entry, "tracked_fraction") > 0.95
        assert 0 < figure(entry, "cpu.player_mean") < figure(entry, "cpu.mean") < 2
        assert 20e6 < figure(entry, "ram.max") < 1e9
        assert figure(entry, "latency.median") > 0
        folder = systems.runs.folder(entry.id)
        for path in (folder.profiling, folder.profiling_cpu_plot, folder.profiling_ram_plot, folder.log, folder.config):
            assert path.stat().st_size > 0, path


def test_two_rows_of_the_published_results_hold(systems, room):
    """Sequential: errors are those of the table on any machine, however busy it is."""
    published = systems.claims.read(project_root() / "docs" / "examples" / "claims" / "results.yaml")
    rows = published.only(("kiss-icp", "rko-lio"), (room,))
    entries = [
        replace(
            entry,
            submission=replace(entry.submission, playback_mode=PlaybackMode.SEQUENTIAL),
            claims=tuple(claim for claim in entry.claims if claim.metric == "ate.rmse"),
        )
        for entry in rows.entries
    ]
    check = replace(rows, entries=tuple(entries))
    work = systems.claims.start(check)
    assert (len(work.runs), work.refused) == (4, {})
    with mock.patch.object(systems, "settings", systems.settings.with_values({"worker_slots": 2})):
        systems.worker(only=work.runs).run(until_idle=True)
    answer = systems.claims.answer(check)
    assert answer.words == "2 of 2 hold", answer
