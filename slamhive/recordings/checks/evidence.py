"""Evidence that one pass over a recording leaves for the checks: arrays of bounded size for each sensor.

Indices count the messages of a stream in the order of the recording. Times are integer nanoseconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamhive.domain.dataset import Dataset, Finding, NotChecked, Severity
from slamhive.domain.sensors import Sensor, SensorKind

Array = NDArray[Any]
Findings = Iterator[Finding | NotChecked]

TRUTH = "groundtruth"
"""What findings about the ground truth are about."""


@dataclass(frozen=True, eq=False)
class ImageEvidence:
    """The images of one camera.

    Attributes:
        shapes: (width, height, encoding) of all messages, with their number.
        prints: A number for the content of each image, (n,); equal images have equal numbers.
        brightness: Mean of each image from 0 to 1, (n,); NaN where it was not decoded.
        bright_share: Share of pixels at the upper limit, (n,); NaN as above.
        sharpness: Fine structure relative to coarse structure, (n,); NaN where it was not computed.
    """

    shapes: dict[tuple[int, int, str], int]
    prints: Array
    brightness: Array
    bright_share: Array
    sharpness: Array


@dataclass(frozen=True, eq=False)
class Depths:
    """Samples of the depth images: share of valid pixels and median of the valid values (raw), (m,) each."""

    valid_share: Array
    median_raw: Array


@dataclass(frozen=True, eq=False)
class MatchEvidence:
    """Points that two images have in common, as normalised coordinates on the plane z = 1, (m, 2) each.

    ``depths_raw`` are values of a depth image at the first points, (m,), 0 where there is none. ``stereo_depths_m`` are
    depths of the first points from a stereo pair, NaN where there is none.
    """

    first_ns: int
    second_ns: int
    first: Array
    second: Array
    depths_raw: Array | None = None
    stereo_depths_m: Array | None = None


@dataclass(frozen=True, eq=False)
class Sweeps:
    """The sweeps of one LiDAR.

    Attributes:
        counts: Number of finite points in each sweep, (n,), estimated from samples.
        fields: Names of the fields of the first message.
        ranges_m: Samples of ranges from all over the recording, (m,).
        zero_share: Share of sampled points at the origin.
        times_s: First and last time of a point since the start of each sampled sweep, (k, 2); empty without times.
        layout_problem: Why the declared layout cannot be used; None if it can.
        turns_rad: Signed angle that each sampled sweep turns from its first point in time to its last, (k,).
        seams_m: For pairs of neighbouring sweeps, median differences of range where the first ends and the second
            begins, and where the first begins and the second ends, (k, 2).
        clouds: Some sweeps for registration: index and points (m, 3).
    """

    counts: Array
    fields: tuple[str, ...]
    ranges_m: Array
    zero_share: float
    times_s: Array
    turns_rad: Array
    seams_m: Array
    clouds: tuple[tuple[int, Array], ...] = ()
    layout_problem: str | None = None


@dataclass(frozen=True, eq=False)
class StreamEvidence:
    """The messages of one sensor: timestamps of their headers and receive times, (n,) each, and their content.

    ``total`` is how many there are; more than the arrays hold if the recording is very long.
    """

    sensor: Sensor
    kind: str
    header_ns: Array
    received_ns: Array
    total: int
    imu: Array | None = None
    """(n, 6) angular rates and specific forces, in the units of the recording."""
    images: ImageEvidence | None = None
    depths: Depths | None = None
    sweeps: Sweeps | None = None
    motion: tuple[MatchEvidence, ...] = ()
    """Matches between images of this camera at different times."""
    stereo: tuple[MatchEvidence, ...] = ()
    """Matches between this camera and its stereo partner at the same time."""
    partner: Sensor | None = None

    def finding(self, check: str, severity: Severity, message: str, remedy: str, **more: Any) -> Finding:
        """A finding about this sensor; ``more`` are other fields of :class:`Finding`."""
        return Finding(check, severity, self.sensor.name, message, remedy, topic=self.sensor.topic, **more)


@dataclass(frozen=True, eq=False)
class Truth:
    """The rows of the ground-truth file as they are, not validated.

    ``times_s`` (n,), ``positions_m`` (n, 3), ``quats_xyzw`` (n, 4) with NaN for a file of positions only.
    """

    times_s: Array
    positions_m: Array
    quats_xyzw: Array


@dataclass(frozen=True, eq=False)
class DatasetEvidence:
    """All that the checks see. ``problem`` says why the ground truth cannot be read."""

    dataset: Dataset
    start_ns: int
    end_ns: int
    streams: dict[str, StreamEvidence] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)
    """All topics of the recording, with their types."""
    truth: Truth | None = None
    truth_problem: str | None = None

    @property
    def span_s(self) -> float:
        """Duration of the recording."""
        return (self.end_ns - self.start_ns) * 1e-9

    def of_kind(self, *kinds: SensorKind) -> list[StreamEvidence]:
        """The streams of sensors of these kinds that have messages."""
        return [stream for stream in self.streams.values() if stream.sensor.kind in kinds and stream.total]

    def is_follower(self, stream: StreamEvidence) -> bool:
        """Tell if it is the second camera of a stereo pair."""
        return any(
            other.partner is not None and other.partner.name == stream.sensor.name for other in self.streams.values()
        )

    def where(self, stream: StreamEvidence, indices: Array) -> dict[str, Any]:
        """The fields of a finding that say where messages ``indices`` (n,) were received, and how many."""
        return {"at_s": float((stream.received_ns[indices[0]] - self.start_ns) * 1e-9), "count": len(indices)}

    def since_start_s(self, time_s: float) -> float:
        """A time of the header clock in s from the start of the recording."""
        return float(time_s - self.header_start_ns * 1e-9)

    @property
    def header_start_ns(self) -> int:
        """The earliest header timestamp; the start of the recording if there is none."""
        # Single timestamps may be wrong, so the median of each stream's clock offset decides.
        offsets = [int(np.median(s.header_ns - s.received_ns)) for s in self.streams.values() if len(s.header_ns)]
        return self.start_ns + (int(np.median(offsets)) if offsets else 0)
