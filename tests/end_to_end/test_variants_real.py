"""A real SLAM system on smaller images: it stays right because its calibration shrinks with them, and only then."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.bags.importing import ImportOptions
from slamhive.bags.room import RoomOptions
from slamhive.catalogue.dataset_file import dataset_to_yaml
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.dataset import Dataset
from slamhive.domain.run import RunState
from slamhive.domain.variant import Variant, VariantStep, parse_step
from slamhive.runtime import config as run_config
from slamhive.schema.submission import Submission
from slamhive.services.hive import Hive, open_hive
from slamhive.store import RunRecord

pytestmark = [pytest.mark.integration, pytest.mark.docker]

KITTI_06 = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti06_stereo_51"
ORB = "orb-slam3-stereo"
INTRINSICS = ("fx", "fy", "cx", "cy")
HALF_SIZE: Variant = (VariantStep("resolution", ("cam0", "cam1"), {"scale": 0.5}),)


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    opened = open_hive({"data": tmp_path_factory.mktemp("data"), "executor": "docker", "min_free_disk_mb": 1})
    yield opened
    opened.close()


def silent(_fraction: float, _text: str) -> None:
    pass


@pytest.fixture(scope="module")
def half_size_run(hive: Hive) -> RunRecord:
    if not KITTI_06.is_dir():
        pytest.skip("the recorded data in ../shared/data is not here")
    hive.catalogue.import_dataset(hive.catalogue.plan_import(KITTI_06, ImportOptions(), name="kitti_06"), silent)
    entry = run(hive, ORB, "kitti_06", HALF_SIZE)
    assert entry.state is RunState.SUCCEEDED, hive.runs.log(entry.id)[-2000:]
    return entry


def run(hive: Hive, algorithm: str, dataset: str, variant: Variant = ()) -> RunRecord:
    """Message by message: frames that a busy machine loses are not what is asked about here."""
    parameters = {"nFeatures": 2000} if algorithm == ORB else {}
    wanted = Submission(algorithm, dataset, parameters, playback_mode=PlaybackMode.SEQUENTIAL, variant=variant)
    (queued,) = hive.runs.submit(wanted)
    hive.worker(only=[queued.id]).run(until_idle=True)
    return hive.runs.get(queued.id)


def ate_m(entry: RunRecord) -> float:
    assert entry.metrics is not None
    return entry.metrics["ate.rmse"]


@pytest.mark.alone
@pytest.mark.shared_data
def test_half_size_images_are_tracked_with_their_own_calibration(hive, half_size_run):
    assert half_size_run.poses is not None
    assert half_size_run.poses >= 48
    assert ate_m(half_size_run) < 0.25
    config = run_config.load(hive.runs.folder(half_size_run.id).config)
    assert config.dataset_resolution == {"/cam0/image_raw": 0.5, "/cam1/image_raw": 0.5}
    seen = config.dataset_parameters
    source = hive.catalogue.dataset("kitti_06").sensor("cam0").calibration
    assert (seen["left_width"], seen["left_height"]) == (613, 185)
    assert seen["left_fx"] == pytest.approx(source["fx"] * 613 / 1226)
    assert seen["left_cx"] == pytest.approx((source["cx"] + 0.5) * 613 / 1226 - 0.5)


@pytest.mark.alone
@pytest.mark.shared_data
def test_the_run_is_measured_against_the_original_ground_truth(hive, half_size_run):
    (entry,) = hive.variants.entries("kitti_06")
    record = hive.runs.record(half_size_run.id)["dataset"]
    assert record["variant"] == entry.key
    assert record["checksum"] == hive.catalogue.dataset("kitti_06").checksum
    assert half_size_run.metrics is not None
    assert half_size_run.metrics["tracked_fraction"] > 0.9


@pytest.mark.alone
@pytest.mark.shared_data
def test_it_is_wrong_where_the_calibration_was_left_as_it_was(hive, half_size_run):
    unscaled = with_old_calibration(hive, "kitti_06_unscaled")
    entry = run(hive, ORB, unscaled.name)
    lost = entry.state is RunState.FAILED or (entry.poses or 0) < 48
    assert lost or ate_m(entry) > 3 * ate_m(half_size_run), f"{entry.poses} poses, ATE {entry.metrics}"


def with_old_calibration(hive: Hive, name: str) -> Dataset:
    """The half-size images as a dataset whose description still has the intrinsics of the large ones."""
    source = hive.catalogue.dataset("kitti_06")
    with hive.variants.hold(source, HALF_SIZE, silent) as small:
        folder = hive.settings.datasets_folder / name
        shutil.copytree(small.dataset.folder, folder)
        cameras = tuple(
            replace(sensor, calibration={**sensor.calibration, **{key: old.calibration[key] for key in INTRINSICS}})
            for sensor, old in zip(small.dataset.sensors, source.sensors, strict=True)
        )
        unscaled = replace(small.dataset, name=name, folder=folder, sensors=cameras)
    (folder / "dataset.yaml").write_text(dataset_to_yaml(unscaled))
    return unscaled


def test_a_lidar_that_loses_its_connection_loses_its_way(hive):
    hive.catalogue.render_room(RoomOptions(name="room", duration_s=15, seed=1), silent)
    clean = run(hive, "kiss-icp", "room")
    faulty = run(hive, "kiss-icp", "room", (parse_step("drop_bursts per_minute=20 duration_s=1"),))
    assert clean.state is RunState.SUCCEEDED, clean.detail
    assert faulty.state is RunState.SUCCEEDED, faulty.detail
    assert clean.poses is not None
    assert faulty.poses is not None
    assert faulty.poses < 0.8 * clean.poses
    assert ate_m(faulty) > 5 * ate_m(clean)
