"""The layout of a LiDAR's points, recognised from the fields that each maker's driver writes."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamhive.bags.bag_writer import NS_PER_S
from slamhive.domain.lidar_layout import LidarLayout
from slamhive.runtime.messages import stamp_ns, to_points
from slamhive.runtime.point_times import PointTimes, SweepInstant, TimeReference, TimeUnit

_TIMES: dict[tuple[str, str], tuple[TimeUnit, TimeReference]] = {
    ("time", "f4"): (TimeUnit.S, TimeReference.TIMESTAMP),  # Velodyne
    ("t", "u4"): (TimeUnit.NS, TimeReference.TIMESTAMP),  # Ouster
    ("offset_time", "u4"): (TimeUnit.NS, TimeReference.TIMESTAMP),  # Livox
    ("timestamp", "f8"): (TimeUnit.S, TimeReference.ABSOLUTE),  # Hesai, RoboSense
    ("time_stamp", "f8"): (TimeUnit.S, TimeReference.ABSOLUTE),
}
"""The unit and the zero of each field of times, by its name and numpy type."""
_RINGS = ("ring", "line")
_NEAR_S = 1.0
"""Times of points that count from the header's clock lie at most so far from the message's timestamp."""


_SHORTEST_SPREAD = 0.1
"""The part of a sweep that its times cover at least."""


def layout_of(message: Any, rate_hz: float) -> tuple[LidarLayout, str]:
    """What one ``PointCloud2`` shows of the layout, and a note for the user; raises InvalidInput if it is damaged.

    Args:
        message: The first one of the topic.
        rate_hz: The rate of the sweeps.
    """
    cloud = to_points(message)
    ring = next((name for name in _RINGS if name in cloud.fields), "")
    organised = int(message.height) > 1
    rings = cloud.fields.get(ring, np.empty(0))
    beams = int(message.height) if organised else int(rings.max()) + 1 if rings.size else None
    duration_s = 1.0 / rate_hz
    names = [name for name, kind in _TIMES if name in cloud.fields and cloud.fields[name].dtype.str[1:] == kind]
    if not names:
        times = PointTimes(duration_s)
        note = f"points have no time that is known (fields {', '.join(('x', 'y', 'z', *cloud.fields))})"
        return LidarLayout(times, ring, organised=organised, beams=beams), note
    field = names[0]
    unit, reference = _TIMES[field, cloud.fields[field].dtype.str[1:]]
    offsets_s = cloud.fields[field].astype(np.float64) * unit.seconds
    if reference is TimeReference.ABSOLUTE:
        offsets_s -= stamp_ns(message) / NS_PER_S
        if offsets_s.size and np.abs(offsets_s).max() > _NEAR_S:
            words = f"the times of points in field {field} are {offsets_s[0]:.3f} s from the message's timestamp"
            return LidarLayout(PointTimes(duration_s), ring, organised=organised, beams=beams), f"{words}: not used"
    times = PointTimes(duration_s, field, unit, reference, _instant(offsets_s, duration_s))
    note = (
        f"the time of a point is its field {field}, {unit} from {_ZEROS[reference]}; timestamps mean the {times.stamp}"
    )
    return LidarLayout(times, ring, organised=organised, beams=beams), f"{note} of a sweep"


_ZEROS = {
    TimeReference.TIMESTAMP: "the message's timestamp",
    TimeReference.ABSOLUTE: "the zero of the clock",
    TimeReference.SWEEP_START: "the start of the sweep",
}


def _instant(offsets_s: Any, duration_s: float) -> SweepInstant:
    """Which instant of the sweep the timestamp is, by the points before and after it."""
    if not offsets_s.size or np.ptp(offsets_s) < _SHORTEST_SPREAD * duration_s:
        return SweepInstant.START  # one column, or times that are not filled in
    middle = float(offsets_s.min() + offsets_s.max()) / 2
    if middle < -0.25 * duration_s:
        return SweepInstant.END
    return SweepInstant.MIDDLE if abs(middle) < 0.25 * duration_s else SweepInstant.START
