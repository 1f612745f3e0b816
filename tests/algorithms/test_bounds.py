"""Every package of the project, in its container, keeps the bounds that its ``algorithm.yaml`` states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from slamhive.bags.importing import ImportOptions
from slamhive.bags.room import RoomOptions
from slamhive.catalogue.algorithm_file import load_algorithms
from slamhive.domain.algorithm import Base
from slamhive.domain.protocol_choices import Alignment
from slamhive.domain.sensors import SensorKind
from slamhive.project import project_root
from slamhive.services.bounds import BoundTest, bound_tests
from slamhive.services.hive import Hive, open_hive
from slamhive.trajectory.offset import position_misfit
from slamhive.trajectory.transforms import move_sensor, rigid_transform
from slamhive.trajectory.tum import read_tum

pytestmark = [pytest.mark.integration, pytest.mark.docker]

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def make_room(hive: Hive) -> None:
    hive.catalogue.render_room(RoomOptions(), lambda _fraction, _text: None)


def import_kitti_06(hive: Hive) -> None:
    folder = SHARED / "kitti06_stereo_51"
    if not folder.is_dir():
        pytest.skip("the recorded data in ../shared/data is not here")
    planned = hive.catalogue.plan_import(folder, ImportOptions(), name="kitti_06")
    hive.catalogue.import_dataset(planned, lambda _fraction, _text: None)


DATASETS: dict[str, Callable[[Hive], None]] = {"room": make_room, "kitti_06": import_kitti_06}


def all_tests() -> list[Any]:
    found = []
    for folder in sorted((project_root() / "algorithms").glob("*/algorithm.yaml")):
        algorithms = load_algorithms(folder.parent)
        mark = "classical" if algorithms[0].package.base is Base.ROS1 else "packages"
        for entry in bound_tests(algorithms):
            name = f"{entry.algorithm.name}-{entry.bound.dataset}"
            found.append(pytest.param(entry, id=name, marks=getattr(pytest.mark, mark)))
    return found


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    opened = open_hive({"data": tmp_path_factory.mktemp("data"), "executor": "docker", "min_free_disk_mb": 1})
    yield opened
    opened.close()


@pytest.mark.timeout(7200)  # the first run of a package builds its image
@pytest.mark.parametrize("entry", all_tests())
def test_each_algorithm_keeps_its_bounds(hive: Hive, entry: BoundTest) -> None:
    if not hive.catalogue.dataset_folder(entry.bound.dataset).is_dir():
        DATASETS[entry.bound.dataset](hive)
    (queued,) = hive.runs.submit(entry.submission())
    hive.worker(only=[queued.id]).run(until_idle=True)
    result = entry.result(hive.runs.get(queued.id))
    assert result.problem is None, f"{result.problem}\n{hive.runs.log(queued.id)[-2000:]}"
    if any(role.kind is SensorKind.LIDAR for role in entry.algorithm.inputs):
        early_m, error_m, late_m = errors_at_shifts(hive, entry, queued.id)
        assert error_m < min(early_m, late_m), "the timestamps of the poses are not those of the sweeps"


def errors_at_shifts(hive: Hive, entry: BoundTest, run_id: int) -> list[float]:
    """The ATE (RMSE, m) with timestamps moved by half a sweep backwards, not at all, and half a sweep forwards."""
    dataset = hive.catalogue.dataset(entry.bound.dataset)
    assert dataset.groundtruth_path is not None
    sensors = entry.algorithm.assign(dataset)
    T_body_sensor = rigid_transform(sensors[entry.algorithm.trajectory_role].T_body_sensor, "T_body_sensor")
    truth = move_sensor(read_tum(dataset.groundtruth_path), T_body_sensor)
    misfit = position_misfit(truth, read_tum(hive.runs.folder(run_id).trajectory), Alignment.SE3)
    half_s = 0.5 / sensors["points"].rate_hz
    return [misfit(shift_s)[0] for shift_s in (-half_s, 0.0, half_s)]
