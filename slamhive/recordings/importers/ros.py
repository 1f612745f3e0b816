"""Plans the import of a recording that is ROS or MCAP already: what all its importers share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.base.files import size_bytes, visible_files
from slamhive.domain.sensors import Sensor
from slamhive.recordings.importers.calibration import read_calibrations
from slamhive.recordings.importers.lenient_reader import ZSTD, LenientReader, storage_files, unlisted
from slamhive.recordings.importers.lidar_drivers import livox_points
from slamhive.recordings.importers.odd_images import is_odd, plain_image
from slamhive.recordings.importers.recording import (
    LIVOX,
    TO_VERSION_2,
    Matching,
    SourceBag,
    match_topics,
    old_version,
    open_source,
)
from slamhive.recordings.importers.sensors import SensorBuilder
from slamhive.recordings.importers.truth import FoundTruth, read_truth_file, read_truth_topic
from slamhive.recordings.importers.video_messages import VIDEO_TYPES, VideoDecoder, codec_of
from slamhive.recordings.importing import (
    NO_TRUTH,
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    KeptRecording,
    Loss,
    RewrittenRecording,
    check_clock,
)
from slamhive.recordings.reader import DAMAGE, reindexing
from slamhive.recordings.staging import Progress
from slamhive.recordings.writers import NS_PER_S, BagWriter
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, Array
from slamhive.runtime.messages import stamp_ns as stamp_ns_of

OPTIONS = frozenset(
    {
        "groundtruth",
        "groundtruth_topic",
        "calibration",
        "topics",
        "typestore",
        "message_definitions",
        "depth_units_per_m",
    }
)
"""The options that all these importers take."""
_IMAGES = (IMAGE, COMPRESSED_IMAGE, *VIDEO_TYPES)
_SAME_CLOCK_NS = NS_PER_S
_SHOW_EVERY = 100


def plan_recording(
    paths: Sequence[Path], options: ImportOptions, text: DatasetText, *, truth: FoundTruth | None = None
) -> ImportPlan:
    """Plan the import of a recording.

    Args:
        paths: The file, the folder of a ROS 2 bag, or the parts of a ROS 1 recording.
        options: What users say.
        text: Title and so on.
        truth: Ground truth that an importer found beside the recording, used unless users name another.

    Raises:
        InvalidInput: The recording, a calibration or the ground truth cannot be used, or they do not fit together.
    """
    if options.groundtruth is not None and options.groundtruth_topic is not None:
        raise InvalidInput(
            f"there are two ground truths: {options.groundtruth} and topic {options.groundtruth_topic}",
            "give --groundtruth or --groundtruth-topic",
        )
    known = read_calibrations(options.calibration)
    with open_source(paths, options, lenient=True) as bag:
        if options.groundtruth_topic is not None:
            truth = read_truth_topic(bag, options.groundtruth_topic)
        without = None if options.groundtruth_topic is None else options.groundtruth_topic.partition(":")[0]
        matching = match_topics(bag, options.topics, without=without)
        frame = "" if truth is None else truth.frame
        builder = SensorBuilder(bag, matching, known, frame, options.depth_units_per_m)
        sensors, recorded_ns = builder.sensors()
        recorded_s = recorded_ns[0] / NS_PER_S, recorded_ns[1] / NS_PER_S
        if options.groundtruth is not None:
            truth = read_truth_file(options.groundtruth, recorded_s, f"file {options.groundtruth.name}")
        if truth is not None:
            check_clock(truth.times_s, recorded_s, f"the ground truth ({truth.source})", "the recording")
        planned = None if truth is None else truth.planned
        notes = (*matching.notes, *builder.notes, *_late_pictures(bag, matching), *_notes(bag, truth, recorded_ns))
        if planned is not None and truth is not None and truth.antenna:
            arm_m = builder.position_m(truth.antenna)
            planned = replace(planned, lever_arm_m=arm_m)
            where = "is not known on the body: 0 0 0 is assumed" if arm_m is None else "is known on the body"
            notes = (*notes, f"the antenna ({truth.antenna}) {where} (lever_arm_m in dataset.yaml)")
        recording = _recording(paths, bag, matching, sensors, options)
    return ImportPlan(recording, planned, text, notes=notes)


def text_of(path: Path, kind: str) -> DatasetText:
    """Title and description of a recording of which nothing else is known."""
    return DatasetText(title=f"{kind} {path.stem}", description=f"Imported from {path.name}.")


def _recording(
    paths: Sequence[Path], bag: SourceBag, matching: Matching, sensors: tuple[Sensor, ...], options: ImportOptions
) -> KeptRecording | RewrittenRecording:
    topics = [sensor.topic for sensor in sensors]
    odd = _odd_topics(bag, [topic.name for topic in matching.topics.values()])
    skipped = {name: bag.first_picture(name).skipped for name in odd}
    counts = {name: topic.count - skipped.get(topic.name, 0) for name, topic in matching.topics.items()}
    livox = any(topic.type in LIVOX for topic in matching.topics.values())
    if len(paths) == 1 and not bag.refused and not livox and not odd:
        check = partial(check_messages, topics=topics, total=sum(counts.values()))
        return KeptRecording(paths[0], sensors, counts, bag.start_ns, bag.end_ns, check)
    expected = {sensor.topic: counts[sensor.name] for sensor in sensors}
    write = partial(_rewrite, tuple(paths), options, sensors, expected)
    needed_bytes = sum(size_bytes(path) for path in paths)
    for topic in (bag.topics[name] for name in odd):
        needed_bytes += topic.count * bag.first_picture(topic.name).pixels.nbytes
    return RewrittenRecording(write, sensors, counts, bag.start_ns, bag.end_ns, needed_bytes)


def _odd_topics(bag: SourceBag, topics: Iterable[str]) -> set[str]:
    """The topics of images that become plain ones, by the first message of each."""
    images = [bag.topics[name] for name in topics if bag.topics[name].type in _IMAGES]
    return {topic.name for topic in images if is_odd(bag.first(topic.name), topic.type)}


def _late_pictures(bag: SourceBag, matching: Matching) -> Iterator[str]:
    """Notes on video that does not begin with a whole picture."""
    for topic in matching.topics.values():
        skipped = bag.first_picture(topic.name).skipped if topic.type in _IMAGES else 0
        if skipped:
            note = f"{skipped} packets of {topic.name} before the first whole picture of the video show nothing"
            yield Loss(skipped, topic.count, note)


def _notes(bag: SourceBag, truth: FoundTruth | None, recorded_ns: tuple[int, int]) -> list[str]:
    # Notes on a recording that is damaged or was not finished; the first one says how much of it is lost.
    notes: list[str] = []
    reader = bag.reader
    if isinstance(reader, LenientReader):
        notes += reader.notes
        if notes and reader.lost:
            notes[0] = Loss(reader.lost, reader.message_count + reader.lost, notes[0])
    if bag.refused:
        notes.append(
            f"{bag.path.name} is written again as a ROS 1 bag with the topics of its sensors, since the player of runs "
            f"refuses it as it is: {bag.refused.rstrip('.')}"
        )
    if truth is None:
        notes.append(NO_TRUTH)
    elif not truth.gravity_aligned:
        notes.append("the z axis of the ground truth is not known to point up (gravity_aligned in dataset.yaml)")
    notes += () if truth is None else truth.notes
    apart_s = (recorded_ns[0] - bag.start_ns) / NS_PER_S
    if abs(apart_s) > 60:
        side = "before" if apart_s < 0 else "after"
        notes.append(f"headers are {abs(apart_s):.0f} s {side} the clock of the recording; the time of headers counts")
    return notes


def check_messages(path: Path, progress: Progress, *, topics: Sequence[str], total: int) -> None:
    """Read all messages of the sensors; raises InvalidInput where one is damaged or missing."""
    with open_source([path], ImportOptions()) as bag:
        read = 0
        for read, _ in enumerate(bag.raw(*topics), start=1):
            if read % _SHOW_EVERY == 0:
                progress(min(read / total, 1.0), f"checking message {read} of {total}")
    if read != total:
        raise InvalidInput(
            f"{path.name} holds {read} messages of its sensors, but its index says {total}",
            f"it may be truncated: compare its size with the original, or {reindexing(path)}",
        )


def _rewrite(
    paths: tuple[Path, ...],
    options: ImportOptions,
    sensors: tuple[Sensor, ...],
    counts: Mapping[str, int],
    out: BagWriter,
    progress: Progress,
) -> None:
    """Write the messages of all sensors to one ROS 1 bag: Livox's as ``PointCloud2``, odd images as plain ones.

    Raises InvalidInput where a message is damaged, or a topic of video has fewer pictures than ``counts`` says.
    """
    by_topic = {sensor.topic: sensor for sensor in sensors}
    total = sum(counts.values())
    videos: dict[str, VideoDecoder[tuple[int, int]]] = {}
    shown = dict.fromkeys(by_topic, 0)

    def show(topic: str, pictures: Iterable[tuple[tuple[int, int], Array]]) -> None:
        for (stamp_ns, received_ns), pixels in pictures:
            out.image(by_topic[topic], stamp_ns, pixels, "rgb8", received_ns)
            shown[topic] += 1

    with open_source(paths, options, lenient=True) as bag:
        cdr = bag.reader.is2
        ros2 = bag.reader.typestore if cdr else None
        odd = _odd_topics(bag, by_topic)
        for number, (connection, received_ns, raw) in enumerate(bag.raw(*by_topic), start=1):
            if connection.msgtype in LIVOX:
                stamp_ns, timebase_ns, points = livox_points(raw, cdr=cdr)
                if abs(timebase_ns - stamp_ns) < _SAME_CLOCK_NS:
                    stamp_ns = timebase_ns
                out.points(by_topic[connection.topic], stamp_ns, received_ns, points)
            elif connection.topic in odd:
                message = bag.decode(connection, raw)
                codec = codec_of(message, connection.msgtype)
                if codec is not None:
                    video = videos.setdefault(connection.topic, VideoDecoder(codec))
                    moment = stamp_ns_of(message), received_ns
                    show(connection.topic, video.pictures(message.data, moment))
                else:
                    pixels, encoding = plain_image(message, connection.msgtype)
                    out.image(by_topic[connection.topic], stamp_ns_of(message), pixels, encoding, received_ns)
            else:
                bag.define(connection)
                try:
                    out.copy(connection, received_ns, raw, ros2)
                except DAMAGE as error:
                    raise bag.damaged(error, f"a message of {connection.topic}") from None
            if number % _SHOW_EVERY == 0:
                progress(min(number / total, 1.0), f"writing message {number} of {total}")
    for topic, video in videos.items():
        show(topic, video.rest())
        if shown[topic] != counts[topic]:
            raise InvalidInput(
                f"the video of {topic} shows {shown[topic]} pictures in {counts[topic]} packets",
                "copy the recording again, or leave the camera out with --topic",
            )


# Importer of ROS 1 bags, kept as they are.


_MAGIC = b"#ROSBAG V2.0"
_MOST_PARTS = 1000
_LONGEST_GAP_S = 60.0
"""`rosbag record --split` begins a part within a second; a longer gap makes another recording."""
_MOST_SHARED = 0.1
"""Of the shorter part: recorders with several threads write a few messages after the next part has started."""


class Ros1Importer:
    """A ``.bag`` file of ROS 1, or a folder of bags that are parts of one recording."""

    title = "ROS 1 bag: a .bag file, or a folder of the .bag files of one recording"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the ending and the first bytes."""
        if path.is_dir():
            bags = [file for file in visible_files(path, "*.bag") if starts_with(file, _MAGIC)]
            return Detection(tuple(bag.name for bag in bags[:1]), (), weak=True)
        if not path.is_file() or path.suffix != ".bag":
            return Detection((), ())
        old = old_version(path)
        if old:
            return Detection((f"{path.name}, a ROS bag of version {old}",), (f"version 2.0 ({TO_VERSION_2})",))
        return Detection((path.name,), () if starts_with(path, _MAGIC) else ("the first line of a ROS 1 bag",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors from topics and calibration, the recording as it is; parts become one bag."""
        return plan_recording(_parts(source, options), options, text_of(source, "ROS 1 bag"))


def _parts(source: Path, options: ImportOptions) -> list[Path]:
    """The bags of one recording in the order of time; raises InvalidInput if they are several recordings."""
    if not source.is_dir():
        return [source]
    bags = visible_files(source, "*.bag")
    if not 0 < len(bags) <= _MOST_PARTS:
        raise InvalidInput(f"{source} holds {len(bags)} bags", "give the folder of one recording")
    return _in_order(source, bags, options)


def _in_order(source: Path, files: Sequence[Path], options: ImportOptions) -> list[Path]:
    """The parts of one recording in the order of time.

    Raises InvalidInput if they are several recordings: one begins long after another, or both have a topic at once.
    """
    spans: list[tuple[int, int, frozenset[str], Path]] = []
    for file in files:
        with open_source([file], options, lenient=True) as part:
            spans.append((part.start_ns, part.end_ns, frozenset(part.topics), file))
    spans.sort(key=lambda span: (span[0], span[3].name))
    for index, (start_ns, end_ns, topics, file) in enumerate(spans[1:], start=1):
        apart_s = (start_ns - max(span[1] for span in spans[:index])) / NS_PER_S
        double = next(
            (
                span
                for span in spans[:index]
                if span[2] & topics
                and min(span[1], end_ns) - start_ns > _MOST_SHARED * min(span[1] - span[0], end_ns - start_ns)
            ),
            None,
        )
        if double is not None:
            both = ", ".join(sorted(double[2] & topics)[:3])
            why = f"{double[3].name} and {file.name} have {both} at the same time"
        elif apart_s > _LONGEST_GAP_S:
            why = f"{file.name} begins {apart_s:.0f} s after those before it end"
        else:
            continue
        raise InvalidInput(f"the files in {source} are no parts of one recording: {why}", "give one of them")
    return [span[3] for span in spans]


def starts_with(path: Path, magic: bytes) -> bool:
    """Tell if the file at ``path`` begins with ``magic``."""
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


# Importer of plain MCAP files with ROS 2 messages, kept as they are.


_MCAP_MAGIC = b"\x89MCAP0\r\n"


class McapImporter:
    """An ``.mcap`` file without ``metadata.yaml``."""

    title = "MCAP file with ROS 2 messages: an .mcap file"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the ending and the first bytes."""
        if path.is_file() and path.name.endswith(".mcap.zstd"):
            return Detection((path.name,), () if starts_with(path, ZSTD) else ("the first bytes of zstd",))
        if not path.is_file() or path.suffix != ".mcap":
            return Detection((), ())
        return Detection((path.name,), () if starts_with(path, _MCAP_MAGIC) else ("the first bytes of MCAP",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors from topics and calibration, the recording as it is."""
        return plan_recording([source], options, text_of(source, "MCAP file"))


# Importer of ROS 2 bags, kept as they are.


_METADATA = "metadata.yaml"
_HEAD_BYTES = 100_000
_KEY = b"rosbag2_bagfile_information"
_SQLITE = b"SQLite format 3\0"


class Ros2Importer:
    """A folder with SQLite or MCAP files, compressed or not; or a single ``.db3`` file.

    ``metadata.yaml`` is there as well, unless the recorder was killed.
    """

    title = "ROS 2 bag: a folder with metadata.yaml (SQLite or MCAP), or a .db3 file"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By ``metadata.yaml`` and the files it lies with, or the first bytes of a ``.db3`` file."""
        if path.is_file() and path.suffix == ".db3":
            return Detection((path.name,), () if starts_with(path, _SQLITE) else ("the first bytes of SQLite",))
        if path.is_file() and path.name.endswith(".db3.zstd"):
            return Detection((path.name,), () if starts_with(path, ZSTD) else ("the first bytes of zstd",))
        storages = [file.name for file in storage_files(path)] if path.is_dir() else []
        metadata = path / _METADATA
        if not metadata.is_file():
            return Detection(tuple(storages[:1]), (), weak=True)
        with metadata.open("rb") as file:
            if _KEY not in file.read(_HEAD_BYTES):
                return Detection(tuple(storages[:1]), (), weak=True)
        return Detection((_METADATA, *storages[:1]), () if storages else ("a .db3 or .mcap file",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors from topics and calibration, the recording as it is."""
        files = storage_files(source) if source.is_dir() else []
        if len(files) > 1 and unlisted(source, files):
            _in_order(source, files, options)
        return plan_recording([source], options, text_of(source, "ROS 2 bag"))
