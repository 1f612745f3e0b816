"""Edits the content of the messages of one topic."""

from __future__ import annotations

from typing import Any

from slamhive.bags.variants.calibration import follow_sensor, image_size, same_intrinsics
from slamhive.bags.variants.payloads import CAMERA_INFO, CODECS, TYPES_BY_KIND, Edit
from slamhive.bags.variants.step import Message
from slamhive.bags.variants.streams import TopicStream, Treatment, camera_info_topic
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput

_CAMERAS = {SensorKind.CAMERA, SensorKind.DEPTH}


def topics_of(dataset: Dataset, treatments: tuple[Treatment, ...], present: dict[str, str]) -> dict[str, Treatment]:
    """The topics that change, by sensor: its own and, for cameras, that of its ``CameraInfo``.

    Args:
        dataset: Whose messages they are, for the words of an error.
        treatments: Of all its sensors.
        present: Types of the topics in the recording.

    Raises:
        InvalidInput: a sensor's topic is not in the recording.
    """
    topics: dict[str, Treatment] = {}
    own = {treatment.before.topic for treatment in treatments}
    for treatment in treatments:
        if not treatment.steps:
            continue
        sensor = treatment.before
        if sensor.topic not in present:
            raise InvalidInput(
                f"{dataset.bag} holds no topic {sensor.topic}, where {dataset.name} has its sensor {sensor.name}",
                f"it holds: {', '.join(sorted(present))}",
            )
        topics[sensor.topic] = treatment
        info = camera_info_topic(sensor.topic)
        if sensor.kind in _CAMERAS and info in present and info not in own:
            topics[info] = treatment
    return topics


def make_edit(topic: str, message_type: str, stream: TopicStream) -> Edit | None:
    """The function that changes the content of a topic's messages, None if nothing changes.

    Raises InvalidInput where the steps ask for a change and the topic carries something else than its sensor should.
    """
    before, after = stream.treatment.before, stream.treatment.after
    if message_type == CAMERA_INFO:
        return _info_edit(topic, before, after)
    if not stream.transforms:
        return None
    if message_type not in TYPES_BY_KIND[before.kind]:
        expected = " or ".join(TYPES_BY_KIND[before.kind])
        raise InvalidInput(
            f"{topic} carries {message_type}, which cannot be changed", f"a {before.kind.value} sends {expected}"
        )
    return _payload_edit(topic, message_type, stream)


def _payload_edit(topic: str, message_type: str, stream: TopicStream) -> Edit:
    codec = CODECS[message_type]
    sensor = stream.treatment.before
    size = image_size(sensor) if sensor.kind in _CAMERAS else None

    def edit(message: Any, index: int, received_ns: int) -> Any:
        payload = codec.decode(message, topic)
        if size is not None and payload.shape[1::-1] != size:
            raise InvalidInput(
                f"{topic}: message {index} is {payload.shape[1]}x{payload.shape[0]} pixels, dataset.yaml says "
                f"{size[0]}x{size[1]}",
                "correct the size and intrinsics in dataset.yaml",
            )
        for transform, seed in stream.transforms:
            payload = transform(payload, Message(index, received_ns, seed))
        return codec.encode(message, payload)

    return edit


def _info_edit(topic: str, before: Sensor, after: Sensor) -> Edit | None:
    old_size = image_size(before)
    if old_size == image_size(after) and same_intrinsics(before, after):
        return None

    def edit(message: Any, index: int, _received_ns: int) -> Any:
        if (message.width, message.height) != old_size:
            raise InvalidInput(
                f"{topic}: message {index} describes {message.width}x{message.height} pixels, dataset.yaml says "
                f"{old_size[0]}x{old_size[1]}",
                "correct the size and intrinsics in dataset.yaml",
            )
        return follow_sensor(message, before, after, topic)

    return edit
