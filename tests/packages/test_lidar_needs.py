"""What packages need of LiDAR points, and how datasets that lack it are refused."""

from dataclasses import replace

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.algorithm import LidarNeed, LidarNeeds
from slamhive.domain.calibration import LidarLayout, PointOrder
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.runtime.point_times import PointTimes, TimeReference, TimeUnit
from tests.services.tiny_project import make_dataset

pytestmark = pytest.mark.quick

VELODYNE = LidarLayout(
    PointTimes(0.1, "time", reference=TimeReference.TIMESTAMP),
    "ring",
    PointOrder.COLUMNS,
    beams=16,
    maximum_range_m=100.0,
)


def lidar(layout=None, **calibration):
    values = layout.calibration(**calibration) if layout else calibration
    return Sensor("lidar0", SensorKind.LIDAR, "/points", 10.0, calibration=values)


def test_a_layout_survives_dataset_yaml():
    assert LidarLayout.of(lidar(VELODYNE, range_noise_m=0.01)) == VELODYNE
    assert LidarLayout.of(lidar()) == LidarLayout(PointTimes(0.1))


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("point_order", "spiral", "sensor lidar0: point_order 'spiral' is unknown"),
        ("beams", "many", "sensor lidar0: beams 'many' is no number"),
    ],
)
def test_a_layout_that_makes_no_sense_is_named(key, value, problem):
    with pytest.raises(InvalidInput, match=problem):
        LidarLayout.of(lidar(**{key: value}))


@pytest.mark.parametrize(
    ("needs", "layout", "problem"),
    [
        (LidarNeeds(), LidarLayout(PointTimes(0.1)), None),
        (LidarNeeds(LidarNeed.REQUIRED, LidarNeed.REQUIRED), VELODYNE, None),
        (
            LidarNeeds(LidarNeed.REQUIRED),
            LidarLayout(PointTimes(0.1)),
            "lio needs a time for each point; lidar0 of .* has none",
        ),
        (
            LidarNeeds(ring=LidarNeed.REQUIRED),
            LidarLayout(PointTimes(0.1)),
            "lio needs the ring of each point; .* has none",
        ),
        (LidarNeeds(organised=LidarNeed.REQUIRED), VELODYNE, "lio needs organised scans; .* has a list of points"),
        (LidarNeeds(point_time_units=(TimeUnit.NS,)), VELODYNE, "lio needs point times in ns; .* has them in s"),
        (LidarNeeds(LidarNeed.IGNORED, point_time_units=(TimeUnit.NS,)), VELODYNE, None),
        (
            LidarNeeds(point_time_references=(TimeReference.SWEEP_START, TimeReference.ABSOLUTE)),
            VELODYNE,
            "lio needs point times relative to sweep_start or absolute; .* has them relative to timestamp",
        ),
        (LidarNeeds(point_orders=(PointOrder.ROWS,)), VELODYNE, "points in the order rows; .* has columns"),
    ],
)
def test_what_is_missing_is_said_in_words(needs, layout, problem):
    if problem is None:
        needs.check(lidar(layout), "lio", "x")
        return
    with pytest.raises(InvalidInput, match=problem):
        needs.check(lidar(layout), "lio", "x")


def test_the_shipped_packages_state_their_needs(tmp_path):
    dataset = make_dataset(tmp_path)
    (kiss,), (rko,) = (load_algorithms(project_root() / "algorithms" / name) for name in ("kiss-icp", "rko-lio"))
    assert kiss.lidar.point_time is LidarNeed.OPTIONAL
    assert kiss.assign(dataset)["points"].name == "lidar"
    assert rko.lidar.point_time is LidarNeed.REQUIRED


def test_a_mode_states_needs_of_its_own():
    ringless = replace(VELODYNE, ring_field="")
    shipped = {entry.name: entry.lidar for entry in load_algorithms(project_root() / "algorithms" / "evalio")}
    assert {needs.point_time for needs in shipped.values()} == {LidarNeed.REQUIRED}
    for name in ("mad-icp", "ct-icp", "dlio"):
        shipped[name].check(lidar(ringless), name, "x")
    for name in ("form", "loam-evalio", "lio-sam-evalio"):
        with pytest.raises(InvalidInput, match=f"^{name} needs the ring of each point; lidar0 of dataset x has none"):
            shipped[name].check(lidar(ringless), name, "x")
