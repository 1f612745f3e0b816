"""A real SLAM system on smaller images: it stays right because its calibration shrinks with them, and only then."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.configuration import PlaybackMode, Variant, VariantStep, parse_step
from slamhive.domain.dataset import Dataset
from slamhive.domain.run import RunState
from slamhive.packages.dataset_file import dataset_to_yaml
from slamhive.runtime import config as run_config
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from tests.real_datasets import dataset, silent

pytestmark = [pytest.mark.integration, pytest.mark.docker]

ORB = "orb-slam3-stereo"
INTRINSICS = ("fx", "fy", "cx", "cy")
HALF_SIZE: Variant = (VariantStep("resolution", ("cam0", "cam1"), {"scale": 0.5}),)


@pytest.fixture(scope="module")
def half_size_run(systems: Hive) -> RunRecord:
    entry = run(systems, ORB, dataset(systems, "kitti_06"), HALF_SIZE)
    assert entry.state is RunState.SUCCEEDED, systems.runs.log(entry.id)[-2000:]
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
def test_half_size_images_are_tracked_with_their_own_calibration(systems, half_size_run):
    assert half_size_run.poses is not None
    assert half_size_run.poses >= 48
    assert ate_m(half_size_run) < 0.25
    config = run_config.load(systems.runs.folder(half_size_run.id).config)
    assert config.dataset_resolution == {"/cam0/image_raw": 0.5, "/cam1/image_raw": 0.5}
    seen = config.dataset_parameters
    source = systems.catalogue.dataset("kitti_06").sensor("cam0").calibration
    assert (seen["left_width"], seen["left_height"]) == (613, 185)
    assert seen["left_fx"] == pytest.approx(source["fx"] * 613 / 1226)
    assert seen["left_cx"] == pytest.approx((source["cx"] + 0.5) * 613 / 1226 - 0.5)


@pytest.mark.alone
@pytest.mark.shared_data
def test_the_run_is_measured_against_the_original_ground_truth(systems, half_size_run):
    (entry,) = systems.variants.entries("kitti_06")
    record = systems.runs.record(half_size_run.id)["dataset"]
    assert record["variant"] == entry.key
    assert record["checksum"] == systems.catalogue.dataset("kitti_06").checksum
    assert half_size_run.metrics is not None
    assert half_size_run.metrics["tracked_fraction"] > 0.9


@pytest.mark.alone
@pytest.mark.shared_data
def test_it_is_wrong_where_the_calibration_was_left_as_it_was(systems, half_size_run):
    unscaled = with_old_calibration(systems, "kitti_06_unscaled")
    entry = run(systems, ORB, unscaled.name)
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


def test_a_lidar_that_loses_its_connection_loses_its_way(systems):
    room = dataset(systems, "room")
    clean = run(systems, "kiss-icp", room)
    faulty = run(systems, "kiss-icp", room, (parse_step("drop_bursts per_minute=20 duration_s=1"),))
    assert clean.state is RunState.SUCCEEDED, clean.detail
    assert faulty.state is RunState.SUCCEEDED, faulty.detail
    assert clean.poses is not None
    assert faulty.poses is not None
    assert faulty.poses < 0.8 * clean.poses
    assert ate_m(faulty) > 5 * ate_m(clean)
