"""Effect of a variant's steps on each topic: the messages that stay, their timestamps, their transforms."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.calibration import follow_sensor, image_size, same_intrinsics
from slamhive.recordings.variants.payloads import CAMERA_INFO, CODECS, TYPES_BY_KIND, Edit
from slamhive.recordings.variants.step import Message, Operation, Seed, Step, Stream, Transform
from slamhive.recordings.variants.steps import make_step


@dataclass(frozen=True, slots=True)
class Treatment:
    """A sensor before and after, and the steps in between that do something to it."""

    before: Sensor
    after: Sensor
    steps: tuple[tuple[Step, int, Sensor], ...]
    """Each step, its place among those of its kind on this sensor, and the sensor as the step finds it."""
    silenced: bool = False
    """No message stays."""


_NOBODY = Sensor("", SensorKind.IMU, "", 1.0)
SILENCED = Treatment(_NOBODY, _NOBODY, (), silenced=True)
"""The treatment of a topic that is left out."""


class TopicStream:
    """Decides about the messages of one topic, which come in order of time.

    Args:
        treatment: Of the sensor that the topic belongs to.
        count: Messages in the source.
    """

    def __init__(self, treatment: Treatment, count: int) -> None:
        self.treatment = treatment
        self._operations: list[Operation] = []
        self._reached: list[int] = []
        self.transforms: list[tuple[Transform, Seed]] = []
        for step, position, sensor in treatment.steps:
            seed = step.stream_seed(position, sensor)
            operation = step.operation(Stream(sensor, count, seed))
            self._operations.append(operation)
            self._reached.append(0)
            if operation.transform is not None:
                self.transforms.append((operation.transform, seed))

    @property
    def uses_stamps(self) -> bool:
        """Header timestamps are needed to decide."""
        return any(operation.uses_stamps or operation.restamp is not None for operation in self._operations)

    def decide(self, stamp_ns: int) -> int | None:
        """The timestamp of the next message, None if it is dropped."""
        if self.treatment.silenced:
            return None
        for number, operation in enumerate(self._operations):
            index = self._reached[number]
            self._reached[number] += 1
            if operation.restamp is not None:
                stamp_ns = operation.restamp(index, stamp_ns)
            if operation.keep is not None and not operation.keep(index, stamp_ns):
                return None
        return stamp_ns


def treat(dataset: Dataset, variant: Variant) -> tuple[Treatment, ...]:
    """Every sensor of ``dataset`` with what ``variant`` does to it, in the order of ``dataset.yaml``.

    Raises:
        NotFound: a kind of step or a sensor that does not exist.
        InvalidInput: options that make no sense, a sensor the step cannot treat, or calibrations that no longer fit.
    """
    steps = _steps(dataset, variant)
    treatments = tuple(_treatment(sensor, steps) for sensor in dataset.sensors)
    # A depth image that shares a camera's pixels must go on sharing them.
    sensors = {treatment.after.name: treatment for treatment in treatments}
    for depth in treatments:
        camera = sensors.get(str(depth.before.calibration.get("registered_to", "")))
        if depth.before.kind is not SensorKind.DEPTH or camera is None:
            continue
        if _size(depth.before) == _size(camera.before) and _size(depth.after) != _size(camera.after):
            raise InvalidInput(
                f"{depth.after.name} would have {_size(depth.after)} pixels and {camera.after.name}, whose pixels it "
                f"shares, {_size(camera.after)}",
                "give both the same resolution",
            )
    return treatments


def camera_info_topic(image_topic: str) -> str:
    """Where ROS drivers publish the ``CameraInfo`` of an image topic: beside it (image_transport's rule)."""
    base = image_topic
    for transport in ("/compressed", "/compressedDepth"):
        base = base.removesuffix(transport)
    return f"{base.rpartition('/')[0]}/camera_info"


def _steps(dataset: Dataset, variant: Variant) -> list[tuple[Step, tuple[str, ...]]]:
    """Each step with the names of its sensors."""
    steps = []
    for declared in variant:
        step = make_step(declared.kind, declared.options)
        if not declared.sensors:
            raise InvalidInput(f"step {declared.kind} names no sensor", "give the sensors it is for")
        for name in declared.sensors:
            sensor = dataset.sensor(name)
            if not step.applies_to(sensor):
                what = f"{sensor.name} ({sensor.topic}), a {sensor.kind.value} sensor"
                raise InvalidInput(f"step {declared.kind} cannot be used on {what}")
        steps.append((step, declared.sensors))
    return steps


def _treatment(sensor: Sensor, steps: list[tuple[Step, tuple[str, ...]]]) -> Treatment:
    now = sensor
    seen: Counter[str] = Counter()
    effective: list[tuple[Step, int, Sensor]] = []
    for step, names in steps:
        if sensor.name not in names:
            continue
        step.check(now)
        if not step.is_identity(now):
            effective.append((step, seen[step.kind], now))
            seen[step.kind] += 1
            now = step.calibrate(now)
    return Treatment(sensor, now, tuple(effective))


def _size(sensor: Sensor) -> str:
    return f"{sensor.calibration['width']}x{sensor.calibration['height']}"


# Edits the content of the messages of one topic.


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
    if stream.treatment.silenced:
        return None
    if message_type == CAMERA_INFO:
        return _info_edit(topic, before, after)
    if not stream.transforms:
        return None
    if message_type not in TYPES_BY_KIND[before.kind]:
        expected = " or ".join(TYPES_BY_KIND[before.kind])
        raise InvalidInput(
            f"{topic} carries {message_type}, which cannot be changed", f"a {before.kind.value} sends {expected}"
        )
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
