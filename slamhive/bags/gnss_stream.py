"""Streams of GNSS positions."""

from __future__ import annotations

from slamhive.bags.bag_writer import BagWriter
from slamhive.bags.geometry import Array
from slamhive.bags.importing import Stream
from slamhive.domain.sensors import Sensor

_FIX_BYTES = 250


def gnss_stream(sensor: Sensor, times_ns: Array, positions: Array, variances_m2: Array | None = None) -> Stream:
    """The messages of a receiver.

    Args:
        sensor: The receiver.
        times_ns: Int64 (n,).
        positions: Latitude and longitude in degrees, altitude in m, (n, 3).
        variances_m2: Of east, north and up (n, 3); None if they are not known.
    """

    def write(bag: BagWriter, index: int) -> None:
        variances = None if variances_m2 is None else variances_m2[index]
        bag.nav_sat_fix(sensor, int(times_ns[index]), positions[index], variances)

    return Stream(sensor, times_ns, write, _FIX_BYTES)
