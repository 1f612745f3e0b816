"""Real SLAM systems in their Docker images, on recorded and on rendered data, through the whole product."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.bags.importing import ImportOptions
from slamhive.bags.room import RoomOptions
from slamhive.domain.run import RunState
from slamhive.schema.submission import Submission
from slamhive.services.hive import Hive, open_hive
from slamhive.store import RunRecord

pytestmark = [pytest.mark.integration, pytest.mark.docker]

KITTI_06 = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti06_stereo_51"


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    opened = open_hive({"data": tmp_path_factory.mktemp("data"), "executor": "docker", "min_free_disk_mb": 1})
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def kitti_06(hive: Hive) -> str:
    if not KITTI_06.is_dir():
        pytest.skip("the recorded data in ../shared/data is not here")
    planned = hive.catalogue.plan_import(KITTI_06, ImportOptions(), name="kitti_06")
    hive.catalogue.import_dataset(planned, lambda _fraction, _text: None)
    return "kitti_06"


@pytest.fixture(scope="module")
def room(hive: Hive) -> str:
    hive.catalogue.render_room(RoomOptions(name="room", duration_s=15, seed=1), lambda _fraction, _text: None)
    return "room"


def run(hive: Hive, *submissions: Submission) -> list[RunRecord]:
    run_ids = [entry.id for submission in submissions for entry in hive.runs.submit(submission)]
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
def test_orb_slam3_stereo_on_kitti_06(hive, kitti_06):
    for entry in run(hive, Submission("orb-slam3-stereo", kitti_06, {"nFeatures": 2000}, repeat=3)):
        assert entry.poses is not None
        assert entry.poses >= 50
        assert figure(entry, "ate.rmse") < 0.10
        assert entry.protocol is not None
        assert entry.protocol.label.startswith("SE(3)")
        vocabulary = hive.runs.record(entry.id)["about"]["vocabulary"]
        assert vocabulary["words"] > 5000


@pytest.mark.alone
@pytest.mark.shared_data
def test_orb_slam3_mono_on_kitti_06(hive, kitti_06):
    for entry in run(hive, Submission("orb-slam3-mono", kitti_06, {"nFeatures": 2000}, repeat=3)):
        assert entry.poses is not None
        assert entry.poses >= 45
        assert figure(entry, "ate.rmse") < 0.5
        assert entry.protocol is not None
        assert entry.protocol.label.startswith("Sim(3)")


@pytest.mark.alone
def test_lidar_systems_on_the_room(hive, room):
    for entry in run(hive, Submission("kiss-icp", room), Submission("rko-lio", room)):
        assert figure(entry, "ate.rmse") < 0.10
        assert figure(entry, "tracked_fraction") > 0.95
        assert 0 < figure(entry, "cpu.player_mean") < figure(entry, "cpu.mean") < 2
        assert 20e6 < figure(entry, "ram.max") < 1e9
        assert figure(entry, "latency.median") > 0
        folder = hive.runs.folder(entry.id)
        for path in (folder.profiling, folder.profiling_cpu_plot, folder.profiling_ram_plot, folder.log, folder.config):
            assert path.stat().st_size > 0, path
