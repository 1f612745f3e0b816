"""The frames of a ROS 1 bag: when each was taken and when it was recorded, without decoding them."""

from __future__ import annotations

import struct
from pathlib import Path

import rosbag

from slamhive.base.errors import InvalidInput
from slamhive.runtime.ros1.timing import BagFrame

_HEADER = struct.Struct("<III")
"""How every message with a header begins: sequence number, seconds and nanoseconds of its timestamp."""


def bag_frames(recording: Path, topic: str) -> list[BagFrame]:
    """All messages of ``topic`` in the order of recording. Raises InvalidInput for a damaged bag."""
    frames = []
    try:
        with rosbag.Bag(str(recording)) as bag:
            for _, raw, recorded in bag.read_messages(topics=[topic], raw=True):
                _, seconds, nanoseconds = _HEADER.unpack_from(raw[1])
                frames.append(BagFrame(seconds + nanoseconds * 1e-9, recorded.to_sec()))
    except (rosbag.ROSBagException, struct.error, OSError, ValueError) as error:
        raise InvalidInput(f"{recording} cannot be read as a ROS 1 bag: {error}", "import it again") from None
    if not frames:
        raise InvalidInput(f"{recording.name} has no messages on {topic}", "correct the topic in dataset.yaml")
    return frames
