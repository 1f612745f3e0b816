"""Plans of importers with their ground truth, and the way from a plan to a dataset.

An importer reads the small files of a recording (lists, calibration, ground truth) and returns an
:class:`ImportPlan`. Commands show the plan before anything is written. :func:`perform` then streams the messages
of all sensors in order of time, so memory does not grow with the recording.
"""

from __future__ import annotations

import heapq
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.files import size_bytes
from slamhive.domain.dataset import RELATIONS_FILE, Dataset, GroundTruth
from slamhive.domain.protocol import Duplicates
from slamhive.domain.sensors import Sensor
from slamhive.recordings.geometry import Array, quaternions_from_rotations
from slamhive.recordings.staging import (
    GROUND_TRUTH_FILE,
    IMAGE_TIMES_FILE,
    UNCERTAINTIES_FILE,
    NewDataset,
    Progress,
    new_dataset,
)
from slamhive.recordings.writers import NS_PER_S, BagWriter
from slamhive.trajectory.layout import parse_ground_truth
from slamhive.trajectory.pose_file import format_times
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import rotations_from_quats

_LOG = logging.getLogger(__name__)
HIGHEST_RATE_HZ = 100_000
_RECORDED, _HASHED = 0.9, 0.98
"""The fractions of an import after which the recording is written, and its checksum known."""
_COPIED = 0.5
"""The part of the first one after which a kept recording is copied. Then its messages are checked."""

OPTION_HELP: dict[str, str] = {
    "groundtruth": "ground truth file in TUM format",
    "groundtruth_topic": "topic that holds the ground truth",
    "calibration": "calibration file, for instance Kalibr's camchain.yaml or a dataset.yaml",
    "topics": "topic of a sensor, as SENSOR=TOPIC",
    "typestore": "message types of recordings that do not contain them, for instance ros2_humble",
    "message_definitions": "folder of .msg files for types that the recording does not define",
    "depth_units_per_m": "value of a depth pixel that means one metre",
    "frame_rate_hz": "frames per second, for formats that do not store timestamps",
    "sequence": "name of the sequence, for sources that hold several",
}
"""All options that an importer may take: the fields of :class:`ImportOptions` without those for all importers."""


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Facts about a recording that users state and its files do not; None or empty means "look for yourself".

    :data:`OPTION_HELP` explains the fields. Two count for all importers. ``accept_loss``: a :class:`Loss` is no error,
    however large. ``uncertainty_m`` is the standard deviation of true positions along each axis.
    """

    groundtruth: Path | None = None
    groundtruth_topic: str | None = None
    calibration: tuple[Path, ...] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    typestore: str | None = None
    message_definitions: Path | None = None
    depth_units_per_m: float | None = None
    frame_rate_hz: float | None = None
    sequence: str | None = None
    accept_loss: bool = False
    uncertainty_m: float | None = None

    @property
    def given(self) -> tuple[str, ...]:
        """The names of the options that have a value."""
        return tuple(name for name in OPTION_HELP if getattr(self, name))


def read_topics(texts: Iterable[str]) -> dict[str, str]:
    """The topic of each sensor, from texts SENSOR=TOPIC. Raises InvalidInput."""
    topics: dict[str, str] = {}
    for text in texts:
        sensor, equals, topic = text.partition("=")
        if not sensor or not equals or not topic:
            raise InvalidInput(
                f"--topic {text!r} is not SENSOR=TOPIC", "write for instance --topic cam0=/left/image_raw"
            )
        if sensor in topics:
            raise InvalidInput(f"--topic names two topics for {sensor}: {topics[sensor]} and {topic}", "name one")
        topics[sensor] = topic
    return topics


@dataclass(frozen=True, eq=False)
class PlannedStream:
    """The messages of one sensor.

    Attributes:
        sensor: Where they come from.
        times_ns: When each was measured, int64 (n,), increasing.
        write: Writes message ``index`` (0..n-1) to the recording, stamped with its time.
        message_bytes: The size of one message in the recording, about.
        received_ns: When each was received, if later than measured; its order is that of the recording.
    """

    sensor: Sensor
    times_ns: Array
    write: Callable[[BagWriter, int], None]
    message_bytes: int
    received_ns: Array | None = None

    @property
    def order_ns(self) -> Array:
        """The times at which the messages stand in the recording."""
        return self.times_ns if self.received_ns is None else self.received_ns


@dataclass(frozen=True, eq=False)
class KeptRecording:
    """A ROS recording (a file, or the folder of a ROS 2 bag) that is copied as it is.

    ``counts`` holds the number of messages of each sensor by its name. ``check`` reads the copy and raises InvalidInput
    where it is damaged. ``checksum`` is what it should be, if that is known.
    """

    path: Path
    sensors: tuple[Sensor, ...]
    counts: Mapping[str, int]
    start_ns: int
    end_ns: int
    check: Callable[[Path, Progress], None] | None = None
    checksum: str | None = None

    @property
    def needed_bytes(self) -> int:
        """The size of the recording."""
        return size_bytes(self.path)


@dataclass(frozen=True, eq=False)
class RewrittenRecording:
    """A ROS recording whose messages are written again: parts become one bag, or messages another type.

    ``write`` writes all messages, in order of time. Everything else is as in :class:`KeptRecording`.
    """

    write: Callable[[BagWriter, Progress], None]
    sensors: tuple[Sensor, ...]
    counts: Mapping[str, int]
    start_ns: int
    end_ns: int
    needed_bytes: int


@dataclass(frozen=True, eq=False)
class PlannedTruth:
    """Ground truth: times (n,) in s, positions (n, 3) in m, unit quaternions (n, 4) x y z w, all of the body frame.

    ``quats_xyzw`` is None where only positions are known. ``sigmas_m`` (n, 3) are the standard deviations of positions
    along the axes of the world, ``uncertainty_m`` is one of all. ``image_times_s`` (k,) says when images were taken.
    """

    times_s: Array
    positions_m: Array
    quats_xyzw: Array | None
    gravity_aligned: bool
    source: str
    kitti_poses: str | None = None
    lever_arm_m: tuple[float, ...] | None = None
    uncertainty_m: float | None = None
    sigmas_m: Array | None = None
    image_times_s: Array | None = None

    @property
    def definition(self) -> GroundTruth:
        """The ground truth in the terms of ``dataset.yaml``."""
        return GroundTruth(
            GROUND_TRUTH_FILE,
            gravity_aligned=self.gravity_aligned,
            positions_only=self.quats_xyzw is None,
            kitti_poses=self.kitti_poses,
            source=self.source,
            lever_arm_m=self.lever_arm_m,
            uncertainty_m=self.uncertainty_m,
            uncertainties=None if self.sigmas_m is None else UNCERTAINTIES_FILE,
            image_times=None if self.image_times_s is None else IMAGE_TIMES_FILE,
        )

    def write(self, new: NewDataset) -> None:
        """Write it to the new dataset."""
        quats_xyzw = self.quats_xyzw
        if quats_xyzw is None:
            quats_xyzw = np.tile((0.0, 0.0, 0.0, 1.0), (len(self.times_s), 1))
        new.write_ground_truth(self.times_s, self.positions_m, quats_xyzw)
        if self.sigmas_m is not None:
            rows = zip(self.times_s.tolist(), self.sigmas_m.tolist(), strict=True)
            text = "".join(f"{time_s:.9f} {' '.join(f'{sigma_m:.9g}' for sigma_m in row)}\n" for time_s, row in rows)
            (new.aside / UNCERTAINTIES_FILE).write_text(text, encoding="utf-8")
        if self.image_times_s is not None:
            (new.aside / IMAGE_TIMES_FILE).write_bytes(format_times(self.image_times_s))


@dataclass(frozen=True, slots=True)
class DatasetText:
    """Text about a dataset for people, see :class:`~slamhive.domain.dataset.Dataset`."""

    title: str
    description: str = ""
    licence: str = ""
    citation: str = ""
    source: str = ""
    attributes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ImportPlan:
    """Plan of an import.

    Attributes:
        recording: The streams that are written, or the recording that is kept or rewritten.
        truth: The ground truth, None without.
        text: Title, licence, citation and so on.
        relations: The text of a file of relative poses, None without.
        files: More small files of the dataset by plain name, for instance ``calib.txt``.
        reference_map: The point cloud that maps are compared with, None without.
        notes: What users should know, one sentence each: what is left out, assumed or unusual. A
            :class:`~slamhive.recordings.importing.Loss` is one that is an error above a share.
    """

    recording: tuple[PlannedStream, ...] | KeptRecording | RewrittenRecording
    truth: PlannedTruth | None
    text: DatasetText
    relations: str | None = None
    files: Mapping[str, bytes] = field(default_factory=dict)
    reference_map: Path | None = None
    notes: tuple[str, ...] = ()

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors of the dataset, in the order of ``dataset.yaml``."""
        if isinstance(self.recording, tuple):
            return tuple(stream.sensor for stream in self.recording)
        return self.recording.sensors

    @property
    def counts(self) -> dict[str, int]:
        """The number of messages by name of sensor."""
        if isinstance(self.recording, tuple):
            return {stream.sensor.name: len(stream.times_ns) for stream in self.recording}
        return dict(self.recording.counts)

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        if not isinstance(self.recording, tuple):
            return (self.recording.end_ns - self.recording.start_ns) / NS_PER_S
        times = [stream.order_ns for stream in self.recording if len(stream.times_ns)]
        if not times:
            return 0.0
        return float(max(int(entry[-1]) for entry in times) - min(int(entry[0]) for entry in times)) / NS_PER_S

    @property
    def needed_bytes(self) -> int:
        """The size of the recording, about."""
        if isinstance(self.recording, tuple):
            return sum(len(stream.times_ns) * stream.message_bytes for stream in self.recording)
        return self.recording.needed_bytes


def rate_hz(times_ns: Array) -> float:
    """The mean rate of the times (n,) in ns; raises InvalidInput for fewer than two, or a rate that makes no sense."""
    span_ns = int(times_ns[-1] - times_ns[0]) if len(times_ns) else 0
    rate = round((len(times_ns) - 1) * NS_PER_S / span_ns, 6) if span_ns > 0 else 0.0
    if not 0 < rate <= HIGHEST_RATE_HZ:
        raise InvalidInput(
            f"{len(times_ns)} timestamps within {span_ns} ns make no recording",
            "two are needed at least, in the unit that the format asks for",
        )
    return rate


def perform(plan: ImportPlan, folder: Path, progress: Progress) -> Dataset:
    """Make the dataset ``folder`` as planned, complete or not at all.

    Raises:
        InvalidInput: A frame is damaged; names the file and what was found.
        Conflict: The dataset exists, or is being made.
        Unavailable: Not enough disk space.
    """
    with new_dataset(folder, plan.needed_bytes) as new:
        _record(new, plan.recording, _part(progress, 0.0, _RECORDED))
        if plan.truth is not None:
            plan.truth.write(new)
        files = {**plan.files, **({} if plan.relations is None else {RELATIONS_FILE: plan.relations.encode()})}
        for name, content in files.items():
            (new.aside / name).write_bytes(content)
        if plan.reference_map is not None:
            shutil.copyfile(plan.reference_map, new.aside / plan.reference_map.name)
        dataset = new.seal(
            progress=_part(progress, _RECORDED, _HASHED),
            **asdict(plan.text),
            sensors=plan.sensors,
            duration_s=plan.duration_s,
            groundtruth=None if plan.truth is None else plan.truth.definition,
            relations=None if plan.relations is None else RELATIONS_FILE,
            reference_map=None if plan.reference_map is None else plan.reference_map.name,
        )
        expected = plan.recording.checksum if isinstance(plan.recording, KeptRecording) else None
        if expected not in {None, dataset.checksum}:
            raise InvalidInput(
                f"the recording has checksum {dataset.checksum}, but its dataset.yaml says {expected}",
                "it was changed or damaged on the way: copy it again, or import the recording alone",
            )
    _LOG.info("imported dataset %s", dataset.name)
    progress(1.0, "done")
    return dataset


def _record(
    new: NewDataset, recording: tuple[PlannedStream, ...] | KeptRecording | RewrittenRecording, progress: Progress
) -> None:
    if isinstance(recording, tuple):
        total = sum(len(stream.times_ns) for stream in recording)
        with new.recording() as bag:
            for number, (stream, index) in enumerate(_in_order(recording), start=1):
                stream.write(bag, index)
                progress(number / total, f"writing message {number} of {total}")
    elif isinstance(recording, KeptRecording):
        new.keep(recording.path, _part(progress, 0.0, _COPIED))
        if recording.check is not None:
            new.check(recording.check, _part(progress, _COPIED, 1.0))
    else:
        with new.recording() as bag:
            recording.write(bag, progress)


def _in_order(streams: Sequence[PlannedStream]) -> Iterator[tuple[PlannedStream, int]]:
    """The messages of all streams as they are recorded; at equal times, in the order of the streams."""
    queues = [
        zip(stream.order_ns.tolist(), [position] * len(stream.order_ns), range(len(stream.order_ns)), strict=True)
        for position, stream in enumerate(streams)
    ]
    for _, position, index in heapq.merge(*queues):
        yield streams[position], index


def _part(progress: Progress, start: float, end: float) -> Progress:
    return lambda fraction, text: progress(start + (end - start) * fraction, text)


# The result of an importer's look at a folder.


@dataclass(frozen=True, slots=True)
class Detection:
    """Tell if a folder has a format: ``found`` is the evidence for it, ``missing`` what it lacks; both in words.

    Evidence that is ``weak``, such as bags in a folder, counts where no other format fits.
    """

    found: tuple[str, ...]
    missing: tuple[str, ...]
    weak: bool = False

    @property
    def complete(self) -> bool:
        """Tell if the folder can be converted."""
        return bool(self.found) and not self.missing


# Messages that an import leaves out although the recording has them, or says that it has them.


MOST_LOST = 0.01
"""The share of the messages of a sensor above which a loss is an error: the rest is not what was recorded."""


class Loss(str):
    """A note that says why ``lost`` of ``total`` messages are left out; it is an error above :data:`MOST_LOST`."""

    __slots__ = ("lost", "total")

    lost: int
    total: int

    def __new__(cls, lost: int, total: int, note: str) -> Self:
        """A loss whose ``note`` is what users read."""
        loss = super().__new__(cls, note)
        loss.lost, loss.total = lost, total
        return loss


def refuse_losses(notes: Iterable[str], *, accepted: bool) -> None:
    """Raise InvalidInput if one of ``notes`` is a loss above :data:`MOST_LOST`, unless the user has accepted it."""
    lost = [note for note in notes if isinstance(note, Loss) and note.lost > MOST_LOST * note.total]
    if lost and not accepted:
        share = max(note.lost / note.total for note in lost)
        raise InvalidInput(
            f"{'; '.join(lost)}: {'' if len(lost) == 1 else 'up to '}{share:.0%} is lost",
            f"complete or correct the recording; --accept-loss imports the rest, above {MOST_LOST:.0%} too",
        )


# Ground truth of an import: reads pose files, and checks that its clock meets that of the sensors.


def tum_truth(path: Path, source: str, *, gravity_aligned: bool) -> PlannedTruth:
    """The poses of the body in a TUM file, or its positions; of equal timestamps, the first. Raises InvalidInput."""
    try:
        poses, without = parse_ground_truth(read_bounded(path), str(path), Duplicates.FIRST)
    except NotFound as error:
        raise InvalidInput(error.message, "give the ground truth as a TUM file") from None
    quats_xyzw = None if without else poses.quats_xyzw
    return PlannedTruth(poses.stamps_s, poses.positions_m, quats_xyzw, gravity_aligned=gravity_aligned, source=source)


def of_body(truth: PlannedTruth, T_measured_body: Array) -> PlannedTruth:
    """The poses of the body, of those of a frame that is fixed to it; ``T_measured_body`` is (4, 4)."""
    if truth.quats_xyzw is None or np.array_equal(T_measured_body, np.eye(4)):
        return truth
    R_world_measured = rotations_from_quats(truth.quats_xyzw)
    return replace(
        truth,
        positions_m=truth.positions_m + R_world_measured @ T_measured_body[:3, 3],
        quats_xyzw=quaternions_from_rotations(R_world_measured @ T_measured_body[:3, :3]),
    )


NO_TRUTH = "there is no ground truth: runs get no ATE"
"""A note, to which :func:`~slamhive.recordings.importers.registry.plan_import` adds the options that give one."""


def matched_truth(truth: PlannedTruth | None, streams: Sequence[PlannedStream]) -> tuple[str, ...]:
    """Notes on the part of the recording that has no ground truth; raises InvalidInput if the clocks do not meet."""
    if truth is None:
        return (NO_TRUTH,)
    times_s = streams[0].times_ns / NS_PER_S
    check_clock(truth.times_s, (times_s[0], times_s[-1]), "the ground truth", streams[0].sensor.name)
    first_s, last_s = truth.times_s[0], truth.times_s[-1]
    outside = int(np.count_nonzero((times_s < first_s) | (times_s > last_s)))
    if not outside:
        return ()
    return (f"{outside} of {len(times_s)} messages of {streams[0].sensor.name} are before or after the ground truth",)


def check_clock(times_s: Array, recorded_s: tuple[float, float], truth: str, recorded: str) -> None:
    """Raise InvalidInput with both spans if ground truth and recording have no time in common.

    Args:
        times_s: The times of the ground truth, shape (n,), increasing.
        recorded_s: When the recording begins and ends.
        truth: What messages call the ground truth.
        recorded: What messages call the recording.
    """
    start_s, end_s = recorded_s
    if times_s[-1] < start_s or times_s[0] > end_s:
        raise InvalidInput(
            f"{truth} is from {times_s[0]:.3f} s to {times_s[-1]:.3f} s, "
            f"{recorded} from {start_s:.3f} s to {end_s:.3f} s: the clocks do not meet",
            "give the ground truth of this recording, with the timestamps of its sensors",
        )
