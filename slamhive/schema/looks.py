"""What a run or a recording shows at a moment."""

from __future__ import annotations

from typing import Annotated

from slamhive.schema.fields import described
from slamhive.schema.model import Document

Position = tuple[float, float, float]


class FrameFate(Document):
    """The end of a frame that an algorithm was given."""

    timestamp_s: Annotated[float, described("Its timestamp in the recording.")]
    dropped: bool
    latency_s: Annotated[float | None, described("From its arrival to its result; null without a result.")]


class RunMoment(Document):
    """What is known of a run at a moment."""

    timestamp_s: Annotated[float, described("The timestamp that was asked for.")]
    error_m: Annotated[float | None, described("Position error of the nearest matched pose; null if none is near.")]
    frame: Annotated[FrameFate | None, described("The nearest frame; null if none is near.")]


class Sweep(Document):
    """One sweep of a LiDAR."""

    time_s: Annotated[float, described("When it was received, from the start of the recording.")]
    points: Annotated[int, described("How many points it has.")]
    positions_m: Annotated[
        tuple[Position, ...], described("In the frame of the sensor, thinned out if there are many.")
    ]
