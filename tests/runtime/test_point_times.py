"""Times of LiDAR points: every combination of unit, reference and timestamp gives the same seconds."""

import itertools

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.runtime.messages import PointCloud
from slamhive.runtime.point_times import PointTimes, SweepInstant, TimeReference, TimeUnit

pytestmark = pytest.mark.quick

SWEEP_S = 0.1
START_S = 1_600_000_000.0
TRUE_S = np.array([0.0, 0.025, 0.1])


def cloud(times):
    return PointCloud(np.zeros((len(times), 3)), {"time": np.asarray(times)})


@pytest.mark.parametrize(("unit", "reference", "stamp"), list(itertools.product(TimeUnit, TimeReference, SweepInstant)))
def test_all_conventions_give_the_same_seconds(unit, reference, stamp):
    times = PointTimes(SWEEP_S, "time", unit, reference, stamp)
    stamp_s = START_S + stamp.fraction * SWEEP_S
    zero_s = {TimeReference.SWEEP_START: START_S, TimeReference.TIMESTAMP: stamp_s, TimeReference.ABSOLUTE: 0.0}[
        reference
    ]
    raw = cloud((START_S + TRUE_S - zero_s) / unit.seconds)
    assert times.since_start_s(raw, stamp_s) == pytest.approx(TRUE_S, abs=1e-6)
    assert times.since_timestamp_s(raw, stamp_s) == pytest.approx(START_S + TRUE_S - stamp_s, abs=1e-6)
    assert times.end_s(stamp_s) == pytest.approx(START_S + SWEEP_S)


def test_unsigned_integers_do_not_wrap():
    times = PointTimes(SWEEP_S, "time", TimeUnit.NS, TimeReference.TIMESTAMP)
    raw = cloud(np.array([0, 100_000_000], dtype=np.uint32))
    assert times.since_start_s(raw, START_S) == pytest.approx([0.0, 0.1])


@pytest.mark.parametrize(
    ("unit", "reference", "raw"),
    [
        ("s", "sweep_start", [0, 100_000]),
        ("ms", "timestamp", [0, 1e8]),
        ("s", "sweep_start", [START_S, START_S + 0.1]),
        ("s", "absolute", [0.0, 0.1]),
    ],
)
def test_points_outside_their_sweep_reveal_a_wrong_unit_or_reference(unit, reference, raw):
    times = PointTimes.of(
        {"point_time_field": "time", "point_time_unit": unit, "point_time_reference": reference}, 10.0, "lidar0"
    )
    with pytest.raises(InvalidInput, match=r"after the start of a sweep of 0\.1 s; correct point_time_unit"):
        times.since_start_s(cloud(raw), START_S)


def test_keys_of_earlier_datasets_keep_their_meaning():
    values = {"points_point_time_field": "t", "points_point_time_unit": "ns", "points_stamp": "end", "left_fx": 1.0}
    times = PointTimes.of(values, 20.0, "points", "points_")
    assert times == PointTimes(0.05, "t", TimeUnit.NS, TimeReference.SWEEP_START, SweepInstant.END)
    assert PointTimes.of({}, 10.0, "l") == PointTimes(0.1)


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("point_time_unit", "fortnight", "lidar0: point_time_unit 'fortnight' is unknown; use one of s, ms, us, ns"),
        ("point_time_reference", "now", "lidar0: point_time_reference 'now' is unknown; use one of sweep_start"),
        ("stamp", "last", "lidar0: stamp 'last' is unknown; use one of start, middle, end"),
        ("scan_duration_s", 0, "lidar0: scan_duration_s 0 is not allowed"),
        ("scan_duration_s", "long", "lidar0: scan_duration_s 'long' is not allowed"),
    ],
)
def test_unknown_values_are_named(key, value, problem):
    with pytest.raises(InvalidInput, match=problem):
        PointTimes.of({key: value}, 10.0, "lidar0")


def test_an_empty_scan_has_no_times():
    assert PointTimes(0.1, "time").since_start_s(cloud([]), START_S).shape == (0,)
