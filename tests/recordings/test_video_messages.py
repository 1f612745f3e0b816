"""Video in messages: each picture gets the timestamp of its own packet, also where the encoder reorders them."""

from __future__ import annotations

import random
import sys
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importers.video_messages import (
    COMPRESSED_VIDEO,
    FFMPEG_PACKET,
    VIDEO_DEFINITIONS,
    VideoDecoder,
    first_picture,
)
from slamhive.recordings.importing import ImportOptions, perform
from slamhive.runtime.messages import COMPRESSED_IMAGE, convert
from slamhive.runtime.recording import Recording
from tests.fuzzing import mutated
from tests.recordings.test_import_ros import silent

pytestmark = pytest.mark.quick

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(dict(VIDEO_DEFINITIONS))
START_NS, PERIOD_NS = 10**12, 100_000_000
FRAMES, EVERY = 24, 8
"""Each eighth picture is whole."""
HEIGHT, WIDTH, STEP = 48, 64, 8
TYPES = {"libx264": "h264", "libx265": "h265"}
DECODERS = {"libx264": "h264", "libx265": "hevc"}


@cache
def encoded(encoder: str, reordered: int) -> list[tuple[int, bytes]]:
    """(Number of the picture, packet) in the order of sending; picture n is grey, of brightness 8 n."""
    context: Any = av.CodecContext.create(encoder, "w")
    context.width, context.height, context.pix_fmt, context.time_base = WIDTH, HEIGHT, "yuv420p", Fraction(1, 10)
    options = f"keyint={EVERY}:min-keyint={EVERY}:bframes={reordered}:scenecut=0:repeat-headers=1"
    context.options = {
        "preset": "ultrafast",
        f"{encoder.removeprefix('lib')}-params": f"{options}:open-gop=0" + ":log-level=none" * (encoder == "libx265"),
    }
    pixels = [np.full((HEIGHT, WIDTH, 3), STEP * number, np.uint8) for number in range(FRAMES)]
    packets: list[Any] = []
    for number, picture in enumerate(pixels):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = number
        packets += context.encode(frame)
    packets += context.encode(None)
    return [(packet.pts, bytes(packet)) for packet in packets]


def message(kind: str, encoding: str, number: int, packet: bytes) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(START_NS + number * PERIOD_NS, 10**9))
    header = STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")
    data = np.frombuffer(packet, np.uint8)
    if kind == COMPRESSED_VIDEO:
        return STORE.types[kind](timestamp=stamp, frame_id="camera", data=data, format=encoding)
    if kind == COMPRESSED_IMAGE:
        return STORE.types[kind](header=header, format=encoding, data=data)
    return STORE.types[kind](
        header=header, width=WIDTH, height=HEIGHT, encoding=encoding, pts=number, flags=0, is_bigendian=False, data=data
    )


def recording(folder: Path, kind: str, encoding: str, packets: list[tuple[int, bytes]]) -> Path:
    path = folder / "take"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/cam/image_raw", kind, typestore=STORE)
        for place, (number, packet) in enumerate(packets):
            raw = STORE.serialize_cdr(message(kind, encoding, number, packet), kind)
            writer.write(connection, START_NS + place * PERIOD_NS, raw)
    (folder / "cam.yaml").write_text(
        "cam0: {camera_model: pinhole, intrinsics: [60, 60, 30, 20], distortion_model: none, distortion_coeffs: [], "
        f"resolution: [{WIDTH}, {HEIGHT}], rostopic: /cam/image_raw}}\n"
    )
    return path


def options(folder: Path, *, accept_loss: bool = False) -> ImportOptions:
    return ImportOptions(calibration=(folder / "cam.yaml",), accept_loss=accept_loss)


def pictures(folder: Path, source: Path, asked: ImportOptions) -> dict[int, float]:
    """{Number of the picture by its timestamp: mean brightness of what an algorithm gets}."""
    _, plan = plan_import(source, asked)
    dataset = perform(plan, folder / "made", silent)
    (sensor,) = dataset.sensors
    with Recording(dataset.bag_path, {sensor.name: sensor.topic}) as reader:
        assert reader.count(sensor.name) == plan.counts[sensor.name]
        entries = [(entry.message.header.stamp, convert(entry.message, entry.kind)) for entry in reader.messages()]
    assert all(pixels.shape == (HEIGHT, WIDTH, 3) for _, pixels in entries)  # type: ignore[union-attr]
    times_ns = [stamp.sec * 10**9 + stamp.nanosec - START_NS for stamp, _ in entries]
    return {
        time_ns // PERIOD_NS: float(np.mean(np.asarray(pixels)))
        for time_ns, (_, pixels) in zip(times_ns, entries, strict=True)
    }


@pytest.mark.parametrize("reordered", [0, 2])
@pytest.mark.parametrize("encoder", TYPES)
@pytest.mark.parametrize("kind", [COMPRESSED_VIDEO, FFMPEG_PACKET, COMPRESSED_IMAGE])
def test_each_picture_has_the_timestamp_of_its_packet(tmp_path, kind, encoder, reordered):
    encoding = encoder if kind == FFMPEG_PACKET else TYPES[encoder]
    source = recording(tmp_path, kind, encoding, encoded(encoder, reordered))
    found = pictures(tmp_path, source, options(tmp_path))
    assert sorted(found) == list(range(FRAMES))
    assert found == pytest.approx({number: STEP * number for number in range(FRAMES)}, abs=1.5)


def test_a_recording_that_begins_between_whole_pictures_says_what_it_loses(tmp_path):
    source = recording(tmp_path, COMPRESSED_VIDEO, "h264", encoded("libx264", 0)[3:])
    with pytest.raises(InvalidInput, match=r"5 packets of /cam/image_raw before the first whole picture.*24% is lost"):
        plan_import(source, options(tmp_path))
    found = pictures(tmp_path, source, options(tmp_path, accept_loss=True))
    assert sorted(found) == list(range(EVERY, FRAMES))
    assert found[EVERY] == pytest.approx(STEP * EVERY, abs=1.5)


def test_a_topic_without_a_whole_picture_is_left_out_with_the_reason(tmp_path):
    source = recording(tmp_path, COMPRESSED_VIDEO, "h264", encoded("libx264", 0)[1:EVERY])
    with pytest.raises(InvalidInput, match="none of the first video packets holds a whole picture"):
        plan_import(source, options(tmp_path))


def test_an_unknown_codec_is_named(tmp_path):
    source = recording(tmp_path, COMPRESSED_VIDEO, "mpeg7", encoded("libx264", 0))
    with pytest.raises(InvalidInput, match="video of format 'mpeg7' is not read"):
        plan_import(source, options(tmp_path))


def test_without_pyav_the_remedy_is_an_extra(tmp_path, monkeypatch):
    source = recording(tmp_path, COMPRESSED_VIDEO, "h264", encoded("libx264", 0))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InvalidInput, match=r"video needs PyAV.*slamhive\[video\]"):
        plan_import(source, options(tmp_path))


def test_a_lost_packet_of_reordered_pictures_moves_no_timestamp(tmp_path):
    packets = encoded("libx264", 2)
    last_whole = max(place for place, (number, _) in enumerate(packets) if number % EVERY == 0)
    source = recording(tmp_path, COMPRESSED_VIDEO, "h264", packets[:1] + packets[last_whole:])
    found = pictures(tmp_path, source, options(tmp_path))
    assert found == pytest.approx({number: STEP * number for number in found}, abs=1.5)


@pytest.mark.parametrize("encoder", DECODERS)
def test_mutated_packets_are_decoded_or_refused_in_a_line(encoder):
    packets = [packet for _, packet in encoded(encoder, 0)]
    for seed in range(20):
        chance = random.Random(f"{encoder}{seed}")
        decoder = VideoDecoder[int](DECODERS[encoder])
        place = chance.randrange(len(packets))
        try:
            for number, packet in enumerate(packets[:12]):
                data = np.frombuffer(mutated(packet, chance) if number == place else packet, np.uint8)
                assert all(pixels.ndim == 3 for _, pixels in decoder.pictures(data, number))
            list(decoder.rest())
        except InvalidInput as error:
            refused = error.message
            assert "cannot be decoded" in refused


def test_no_packet_is_read_beyond_those_in_which_a_picture_is_looked_for():
    read: list[int] = []

    def packets() -> Any:
        for number in range(5000):
            read.append(number)
            yield message(COMPRESSED_VIDEO, "h264", number, b"\0\0\0\1\x09\x10")

    with pytest.raises(InvalidInput, match="whole picture"):
        first_picture("h264", packets())
    assert len(read) < 1100
