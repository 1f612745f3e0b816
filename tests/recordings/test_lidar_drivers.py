"""Point clouds as drivers write them: which field is the time of a point, in which unit, and from which zero."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from slamhive.recordings.importers.lidar_drivers import DRIVERS, layout_of
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.variants.payloads import CODECS, POINTS
from slamhive.runtime.messages import stamp_ns, to_points
from slamhive.runtime.point_times import SweepInstant, TimeReference, TimeUnit
from tests.cases import case

TYPES = get_typestore(Stores.ROS2_HUMBLE).types
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
STAMP_NS = 1_700_000_000_250_000_000
OFFSETS_S = np.linspace(0, 0.0999, 400)
RATE_HZ = 10.0


def cloud(kinds: dict[str, str], values: dict[str, Any], *, big: bool = False) -> Any:
    """A sweep with x, y, z and more fields, as a message."""
    order = ">" if big else "<"
    layout = np.dtype([(name, order + kind) for name, kind in {"x": "f4", "y": "f4", "z": "f4", **kinds}.items()])
    points = np.zeros(len(OFFSETS_S), layout)
    points["x"] = 2.0 + np.arange(len(points))
    for name, numbers in values.items():
        points[name] = numbers
    places: dict[str, Any] = dict(layout.fields or {})
    fields = [
        TYPES["sensor_msgs/msg/PointField"](name=name, offset=place[1], datatype=CODES[place[0].str[1:]], count=1)
        for name, place in places.items()
    ]
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=STAMP_NS // 10**9, nanosec=STAMP_NS % 10**9)
    return TYPES["sensor_msgs/msg/PointCloud2"](
        header=TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=big,
        point_step=layout.itemsize,
        row_step=layout.itemsize * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=True,
    )


def written(kind: str, unit: TimeUnit, reference: TimeReference, offsets_s: Any) -> Any:
    """The numbers of a field whose times are these offsets from the timestamp of the message."""
    ticks = round(1 / unit.seconds)
    zero = STAMP_NS * ticks / 10**9 if reference is TimeReference.ABSOLUTE else 0
    values = zero + offsets_s * ticks
    return values.astype(kind) if kind.startswith("f") else np.rint(values).astype(kind)


def check(message: Any, field: str, expected_s: Any, instant: SweepInstant) -> str:
    layout, note = layout_of(message, RATE_HZ)
    assert (layout.times.field, layout.times.stamp) == (field, instant), note
    found_s = layout.times.since_timestamp_s(to_points(message), stamp_ns(message) * 1e-9)
    assert found_s == pytest.approx(expected_s, abs=1e-6)
    return note


WAYS = [
    (driver, instant)
    for driver in DRIVERS
    for instant in SweepInstant
    if not driver.kind.startswith("u") or instant is SweepInstant.START  # whole numbers without sign count from there
]


@pytest.mark.parametrize(("driver", "instant"), WAYS, ids=[f"{way[0].makers} {way[0].kind} {way[1]}" for way in WAYS])
def test_each_driver_is_recognised_with_any_instant_as_timestamp(driver, instant):
    offsets_s = OFFSETS_S - instant.fraction * 0.1
    values = written(driver.kind, driver.unit, driver.reference, offsets_s)
    message = cloud({driver.field: driver.kind, "ring": "u2"}, {driver.field: values})
    note = check(message, driver.field, offsets_s, instant)
    assert f"field {driver.field} ({driver.makers}), {driver.unit} from" in note


@pytest.mark.parametrize(
    ("field", "kind", "unit", "reference"),
    [
        ("timestamp", "f8", TimeUnit.S, TimeReference.TIMESTAMP),
        ("timestamp", "f8", TimeUnit.NS, TimeReference.TIMESTAMP),
        ("timestamp", "f8", TimeUnit.US, TimeReference.ABSOLUTE),
        ("timestamp", "f8", TimeUnit.MS, TimeReference.TIMESTAMP),
        ("time", "f4", TimeUnit.US, TimeReference.TIMESTAMP),
        ("time", "f8", TimeUnit.S, TimeReference.ABSOLUTE),
        ("time", "u4", TimeUnit.NS, TimeReference.TIMESTAMP),
        ("t", "f4", TimeUnit.S, TimeReference.TIMESTAMP),
        ("t", "u4", TimeUnit.US, TimeReference.TIMESTAMP),
        ("t", "f8", TimeUnit.NS, TimeReference.ABSOLUTE),
        ("offset_time", "f4", TimeUnit.MS, TimeReference.TIMESTAMP),
        ("rel_time", "f4", TimeUnit.S, TimeReference.TIMESTAMP),
    ],
)
def test_numbers_show_the_unit_and_the_zero_where_no_driver_does(field, kind, unit, reference):
    message = cloud({field: kind}, {field: written(kind, unit, reference, OFFSETS_S)})
    check(message, field, OFFSETS_S, SweepInstant.START)
    layout, _ = layout_of(message, RATE_HZ)
    assert (layout.times.unit, layout.times.reference) == (unit, reference)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.full(400, 1.7e9), "is 1700000000 for all points"),
        (np.zeros(400), "is 0 for all points"),
        (STAMP_NS * 1e-9 + 500 + OFFSETS_S, "is 500.000 s from the message's timestamp"),
        (np.full(400, np.nan), "not finite"),
    ],
)
def test_times_that_are_none_are_not_used_and_the_reason_is_said(values, words):
    layout, note = layout_of(cloud({"timestamp": "f8"}, {"timestamp": values}), RATE_HZ)
    assert layout.times.field == ""
    assert words in note
    assert "not used" in note


def test_a_second_field_counts_where_the_first_is_not_filled_in():
    message = cloud(
        {"time": "f4", "t": "u4"}, {"time": 0, "t": written("u4", TimeUnit.NS, TimeReference.TIMESTAMP, OFFSETS_S)}
    )
    check(message, "t", OFFSETS_S, SweepInstant.START)


@pytest.mark.parametrize("ring", ["ring", "line", "channel", "laser_id"])
def test_the_number_of_the_beam(ring):
    layout, _ = layout_of(cloud({ring: "u2"}, {ring: np.arange(400) % 32}), RATE_HZ)
    assert (layout.ring_field, layout.beams) == (ring, 32)


def test_the_order_of_bytes_changes_nothing():
    kinds, values = (
        {"timestamp": "f8", "ring": "u2"},
        {"timestamp": STAMP_NS * 1e-9 + OFFSETS_S, "ring": np.arange(400) % 16},
    )
    big, little = cloud(kinds, values, big=True), cloud(kinds, values)
    assert layout_of(big, RATE_HZ) == layout_of(little, RATE_HZ)
    codec = CODECS[POINTS]
    points, expected = codec.decode(big, "/points"), codec.decode(little, "/points")
    assert points.dtype == expected.dtype
    assert (points == expected).all()
    again = codec.encode(big, points)
    assert not again.is_bigendian
    assert np.asarray(again.data).tobytes() == np.asarray(little.data).tobytes()


def test_a_real_cloud_of_big_endian_numbers_is_changed_as_it_is_read():
    source = case("ros1_bags") / "pc_big.bag"
    with open_bag(source) as reader:
        found = next(entry for entry in messages(reader, source, ["/points"]))
        message = decode(reader, source, found[0], found[2])
    points = CODECS[POINTS].decode(message, "/points")
    seen = to_points(message)
    assert message.is_bigendian
    assert np.column_stack([points[axis] for axis in "xyz"]) == pytest.approx(seen.points_m)
    assert to_points(CODECS[POINTS].encode(message, points)).points_m == pytest.approx(seen.points_m)
