"""Variants of ROS 1 bags: what stays is the same to the byte, what goes is gone, and the bag stays a good one."""

import hashlib
import struct
from contextlib import suppress
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.configuration import VariantStep
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.variants import ros1_rewrite
from slamhive.recordings.variants.build import build_variant, plan_variant
from slamhive.recordings.variants.ros1_index import Ros1File, parse_fields, read_index
from tests.recordings.variant_bags import (
    COMPRESSED,
    FRAMES,
    PERIOD_NS,
    SIZE,
    START_NS,
    build,
    camera,
    dataset,
    header,
    image,
    message,
    on_topic,
    pixels_of,
    read_bag,
    stereo,
    text,
    write_bag,
)

pytestmark = pytest.mark.integration

COMPRESSIONS = [None, "bz2", "lz4"]
THIRD = VariantStep("rate", ("cam0",), {"every": 3})
HALF = VariantStep("resolution", ("cam0",), {"scale": 0.5})


@pytest.fixture(params=COMPRESSIONS, ids=["plain", "bz2", "lz4"])
def source(request, tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    write_bag(folder / "d.bag", stereo(), request.param)
    return dataset(folder)


@pytest.fixture
def plain(tmp_path):
    folder = tmp_path / "plain"
    folder.mkdir()
    write_bag(folder / "d.bag", stereo())
    return dataset(folder)


def chunks_of(path):
    with Ros1File(path) as file:
        index = read_index(file)
        return [(chunk, file.read(chunk.data_position, chunk.data_bytes)) for chunk in index.chunks]


def test_every_third_message_stays_and_nothing_else_changes(source, tmp_path):
    made = build(source, tmp_path / "v", THIRD)
    thinned = ("/cam0/image_raw", "/cam0/camera_info")
    before, after = read_bag(source.bag_path), read_bag(made.bag_path)
    for topic in thinned:
        assert on_topic(made.bag_path, topic) == on_topic(source.bag_path, topic)[0::3]
    assert [entry for entry in after if entry.topic not in thinned] == [
        entry for entry in before if entry.topic not in thinned
    ]
    assert made.sensor("cam0").rate_hz == pytest.approx(20 / 3)
    assert made.sensor("cam1") == source.sensor("cam1")


def test_images_are_resized_as_opencv_does_it(source, tmp_path):
    made = build(source, tmp_path / "v", VariantStep("resolution", ("cam0",), {"scale": 0.7}))
    size = (int(SIZE[0] * 0.7), int(SIZE[1] * 0.7))
    before, after = (on_topic(path, "/cam0/image_raw") for path in (source.bag_path, made.bag_path))
    assert [entry.time_ns for entry in after] == [entry.time_ns for entry in before]
    for number, entry in enumerate(after):
        expected = cv2.resize(pixels_of(2 * number), size, interpolation=cv2.INTER_AREA)
        content = entry.message
        assert (content.width, content.height, content.step, content.encoding) == (*size, size[0], "mono8")
        np.testing.assert_array_equal(content.data.reshape(size[::-1]), expected)
        assert content.header == before[number].message.header
    assert on_topic(made.bag_path, "/cam1/image_raw") == on_topic(source.bag_path, "/cam1/image_raw")
    assert (made.sensor("cam0").calibration["width"], made.sensor("cam0").calibration["height"]) == size


def test_the_checksum_is_that_of_the_file(source, tmp_path):
    for number, steps in enumerate([(THIRD,), (HALF,), (THIRD, HALF)]):
        made = build(source, tmp_path / f"v{number}", *steps)
        assert made.checksum == f"sha256:{hashlib.sha256(made.bag_path.read_bytes()).hexdigest()}"


def test_the_folder_is_a_dataset_like_the_source(source, tmp_path):
    made = build(source, tmp_path / "v", THIRD, HALF)
    assert load_dataset(tmp_path / "v") == made
    assert made.groundtruth_path is not None
    assert source.groundtruth_path is not None
    assert made.groundtruth_path.read_bytes() == source.groundtruth_path.read_bytes()
    assert (tmp_path / "v" / "rosbag_play.py").is_file()
    assert "rate of cam0 (every 3)" in made.description


def test_compression_of_chunks_is_kept(source, tmp_path):
    made = build(source, tmp_path / "v", THIRD, HALF)
    expected = {chunk.compression for chunk, _ in chunks_of(source.bag_path)}
    assert len(expected) == 1
    assert {chunk.compression for chunk, _ in chunks_of(made.bag_path)} == expected


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_chunks_without_a_treated_message_are_copied_as_they_are(tmp_path, compression):
    write_bag(tmp_path / "d.bag", stereo(), compression, chunk=2000)
    source = dataset(tmp_path)
    made = build(source, tmp_path / "v", HALF)
    with Ros1File(source.bag_path) as file:
        index = read_index(file)
        treated = {c.id for c in index.connections.values() if c.topic.startswith("/cam0")}
        untouched = [
            file.read(chunk.position, chunk.end - chunk.position)
            for chunk in index.chunks
            if not treated & set(index.entries["connection"][chunk.rows.start : chunk.rows.stop].tolist())
        ]
    assert untouched
    content = made.bag_path.read_bytes()
    assert all(chunk in content for chunk in untouched)


def test_lz4_frames_are_those_that_ros_reads(tmp_path):
    """roslz4 refuses frames with a size, linked blocks or no checksum."""
    write_bag(tmp_path / "d.bag", stereo(), "lz4")
    made = build(dataset(tmp_path), tmp_path / "v", HALF, VariantStep("resolution", ("cam1",), {"scale": 0.5}))
    rewritten = [data for chunk, data in chunks_of(made.bag_path) if chunk.compression == "lz4"]
    assert rewritten
    for data in rewritten:
        magic, flags = struct.unpack_from("<LB", data)
        assert (magic, flags) == (0x184D2204, 0b01100100)


def test_each_connection_is_introduced_before_its_first_message(source, tmp_path):
    """So that a bag that lost its index can be indexed again."""
    made = build(source, tmp_path / "v", VariantStep("rate", ("cam0", "cam1"), {"every": 7}), HALF)
    known = set()
    with Ros1File(made.bag_path) as file:
        for chunk in read_index(file).chunks:
            data = file.chunk_data(chunk)
            position = 0
            while position < len(data):
                (size,) = struct.unpack_from("<L", data, position)
                fields = parse_fields(data[position + 4 : position + 4 + size])
                (content,) = struct.unpack_from("<L", data, position + 4 + size)
                if fields[b"op"] == b"\x07":
                    known.add(fields[b"conn"])
                assert fields[b"conn"] in known
                position += 8 + size + content


def test_equal_builds_make_equal_bytes(source, tmp_path):
    one, two = (build(source, tmp_path / name, THIRD, HALF) for name in ("one", "two"))
    assert one.bag_path.read_bytes() == two.bag_path.read_bytes()


def test_large_chunks_are_worked_on_in_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(ros1_rewrite, "PIECE_BYTES", 20_000)
    write_bag(tmp_path / "d.bag", stereo(), chunk=10**9)
    source = dataset(tmp_path)
    made = build(source, tmp_path / "v", THIRD, HALF)
    assert len(chunks_of(source.bag_path)) == 1
    assert len(chunks_of(made.bag_path)) > 3
    assert on_topic(made.bag_path, "/cam1/image_raw") == on_topic(source.bag_path, "/cam1/image_raw")
    assert len(on_topic(made.bag_path, "/cam0/image_raw")) == 4


def test_the_checksum_is_right_where_messages_differ_in_size(tmp_path):
    entries = [
        ("/cam0/image_raw", START_NS + n * PERIOD_NS, image(pixels_of(n), START_NS, frame="c" * (n % 4 + 1)))
        for n in range(FRAMES)
    ]
    write_bag(tmp_path / "d.bag", entries)
    made = build(dataset(tmp_path, (camera(),)), tmp_path / "v", HALF)
    assert made.checksum == f"sha256:{hashlib.sha256(made.bag_path.read_bytes()).hexdigest()}"
    assert len(read_bag(made.bag_path)) == FRAMES


def test_messages_are_counted_in_order_of_time_not_of_the_file(tmp_path):
    entries = [("/cam0/image_raw", START_NS + n * PERIOD_NS, image(pixels_of(n), START_NS)) for n in range(FRAMES)]
    write_bag(tmp_path / "d.bag", entries[10:] + entries[:10])
    made = build(dataset(tmp_path, (camera(),)), tmp_path / "v", THIRD)
    assert [entry.time_ns for entry in read_bag(made.bag_path)] == [
        START_NS + n * PERIOD_NS for n in range(0, FRAMES, 3)
    ]


def test_dropped_messages_are_never_decoded_and_kept_ones_need_no_known_type(tmp_path):
    entries = [("/gps", START_NS + n * PERIOD_NS, text(f"no fix {n}")) for n in range(9)]
    write_bag(tmp_path / "d.bag", entries)
    sensors = (Sensor("gps", SensorKind.IMU, "/gps", 20.0),)
    made = build(dataset(tmp_path, sensors), tmp_path / "v", VariantStep("rate", ("gps",), {"every": 4}))
    assert [entry.message.data for entry in read_bag(made.bag_path)] == ["no fix 0", "no fix 4", "no fix 8"]


@pytest.mark.parametrize(("hz", "expected"), [(10.0, 6), (5.0, 3), (1.0, 1), (8.0, 5)])
def test_a_target_rate_keeps_as_many_messages_a_second(plain, tmp_path, hz, expected):
    made = build(plain, tmp_path / "v", VariantStep("rate", ("cam0", "cam1"), {"hz": hz}))
    left, right = (on_topic(made.bag_path, f"/{name}/image_raw") for name in ("cam0", "cam1"))
    assert len(left) == expected
    assert [entry.time_ns for entry in left] == [entry.time_ns for entry in right]
    assert made.sensor("cam0").rate_hz == hz


def test_a_target_rate_goes_by_the_stamp_in_the_message(tmp_path):
    """Frames of a pair are received at different times; what is kept must not depend on that."""
    jitter = np.random.default_rng(1)
    entries = []
    for frame in range(40):
        for name in ("cam0", "cam1"):
            stamp_ns = START_NS + frame * PERIOD_NS
            received_ns = stamp_ns + int(jitter.integers(0, 40_000_000))
            entries.append((f"/{name}/image_raw", received_ns, image(pixels_of(frame), stamp_ns)))
    write_bag(tmp_path / "d.bag", entries)
    made = build(dataset(tmp_path), tmp_path / "v", VariantStep("rate", ("cam0", "cam1"), {"hz": 7.0}))
    stamps = [
        [
            (entry.message.header.stamp.sec, entry.message.header.stamp.nanosec)
            for entry in on_topic(made.bag_path, topic)
        ]
        for topic in ("/cam0/image_raw", "/cam1/image_raw")
    ]
    assert sorted(stamps[0]) == sorted(stamps[1])
    assert len(stamps[0]) == 14


@pytest.mark.parametrize("ending", ["jpeg", "png"])
def test_compressed_images_stay_compressed(tmp_path, ending):
    pixels = cv2.resize(pixels_of(0)[:6, :8], SIZE)
    data = cv2.imencode(f".{ending}", pixels)[1]
    entries = [("/cam0/image_raw", START_NS, message(COMPRESSED, header=header(START_NS), format=ending, data=data))]
    write_bag(tmp_path / "d.bag", entries)
    made = build(dataset(tmp_path, (camera(),)), tmp_path / "v", HALF)
    (entry,) = read_bag(made.bag_path)
    assert entry.message.format == ending
    decoded: Any = cv2.imdecode(entry.message.data, cv2.IMREAD_UNCHANGED)
    whole: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    expected = cv2.resize(whole, (32, 24), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(decoded.astype(int), expected.astype(int), atol=0 if ending == "png" else 6)


@pytest.mark.parametrize(
    ("encoding", "dtype", "channels"),
    [("mono16", np.uint16, 1), ("bgr8", np.uint8, 3), ("rgba8", np.uint8, 4), ("32FC1", np.float32, 1)],
)
def test_encodings_are_kept(tmp_path, encoding, dtype, channels):
    shape = SIZE[::-1] if channels == 1 else (*SIZE[::-1], channels)
    pixels = np.random.default_rng(0).integers(0, 255, shape).astype(dtype)
    write_bag(tmp_path / "d.bag", [("/cam0/image_raw", START_NS, image(pixels, START_NS, encoding))])
    made = build(dataset(tmp_path, (camera(),)), tmp_path / "v", HALF)
    (entry,) = read_bag(made.bag_path)
    assert entry.message.encoding == encoding
    got = entry.message.data.view(dtype).reshape(24, 32, *shape[2:])
    np.testing.assert_array_equal(got, cv2.resize(pixels, (32, 24), interpolation=cv2.INTER_AREA))


def test_padding_of_rows_is_left_out(tmp_path):
    padded = np.zeros((SIZE[1], SIZE[0] + 16), np.uint8)
    padded[:, : SIZE[0]] = pixels_of(3)
    content = image(padded, START_NS)
    content.width = SIZE[0]
    write_bag(tmp_path / "d.bag", [("/cam0/image_raw", START_NS, content)])
    made = build(dataset(tmp_path, (camera(),)), tmp_path / "v", HALF)
    (entry,) = read_bag(made.bag_path)
    expected = cv2.resize(pixels_of(3), (32, 24), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(entry.message.data.reshape(24, 32), expected)


@pytest.mark.parametrize("options", [{"every": 1}, {"hz": 20.0}])
def test_factors_of_one_are_the_dataset_itself(plain, tmp_path, options):
    steps = (VariantStep("rate", ("cam0",), options), VariantStep("resolution", ("cam0", "cam1"), {"scale": 1.0}))
    assert plan_variant(plain, steps) is None
    assert build(plain, tmp_path / "v", *steps) is plain
    assert not list((tmp_path / "v").iterdir())


@pytest.mark.parametrize(
    ("step", "error", "words"),
    [
        (VariantStep("rate", ("cam0",), {"hz": 30.0}), InvalidInput, "30 Hz is above the 20 Hz of cam0"),
        (VariantStep("rate", ("cam0",), {"every": 0}), InvalidInput, "step rate: every"),
        (VariantStep("rate", ("cam0",), {"every": 2, "hz": 3.0}), InvalidInput, "either every"),
        (VariantStep("rate", ("cam9",), {"every": 2}), NotFound, "cam9"),
        (VariantStep("rate", (), {"every": 2}), InvalidInput, "names no sensor"),
        (VariantStep("resolution", ("cam0",), {"scale": 0.0}), InvalidInput, "step resolution: scale"),
        (VariantStep("resolution", ("cam0",), {"scale": 1.5}), InvalidInput, "step resolution: scale"),
        (VariantStep("resolution", ("cam0",), {"scale": 0.1}), InvalidInput, "leaves 6x4 pixels of cam0 (64x48)"),
        (VariantStep("resolution", ("imu0",), {"scale": 0.5}), InvalidInput, "cannot be used on imu0"),
        (VariantStep("sharpen", ("cam0",)), NotFound, "sharpen"),
        (VariantStep("rate", ("imu0",), {"every": 2}), InvalidInput, "no topic /imu0"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(plain, tmp_path, step, error, words):
    sensors = (*plain.sensors, Sensor("imu0", SensorKind.IMU, "/imu0", 200.0))
    with pytest.raises(error) as caught:
        build(replace(plain, sensors=sensors), tmp_path / "v", step)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_images_of_another_size_than_described_are_refused(tmp_path):
    write_bag(tmp_path / "d.bag", [("/cam0/image_raw", START_NS, image(pixels_of(0)[:, :40], START_NS))])
    with pytest.raises(InvalidInput, match=r"message 0 is 40x48 pixels, dataset\.yaml says 64x48"):
        build(dataset(tmp_path, (camera(),)), tmp_path / "v", HALF)


def test_bayer_images_are_refused(tmp_path):
    write_bag(tmp_path / "d.bag", [("/cam0/image_raw", START_NS, image(pixels_of(0), START_NS, "bayer_rggb8"))])
    with pytest.raises(InvalidInput, match="bayer_rggb8"):
        build(dataset(tmp_path, (camera(),)), tmp_path / "v", HALF)


def test_a_truncated_mcap_file_is_refused_in_one_line(tmp_path):
    write_bag(tmp_path / "d.bag", stereo(1))
    source = dataset(tmp_path)
    (tmp_path / "d.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(InvalidInput, match="cannot be read as a recording"):
        build(replace(source, bag="d.mcap"), tmp_path / "v", THIRD)


def test_truncated_bags_are_explained_wherever_they_end(source, tmp_path):
    whole = source.bag_path.read_bytes()
    for number, size in enumerate(np.linspace(0, len(whole) - 1, 12).astype(int).tolist()):
        source.bag_path.write_bytes(whole[:size])
        with pytest.raises(InvalidInput) as caught:
            build(source, tmp_path / f"v{number}", THIRD, HALF)
        assert str(source.bag_path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_damaged_bytes_never_escape_as_anything_else(source, tmp_path):
    whole = source.bag_path.read_bytes()
    rng = np.random.default_rng(0)
    for number in range(15):
        broken = bytearray(whole)
        for position in rng.integers(13, len(whole), 20):
            broken[position] = int(rng.integers(0, 256))
        source.bag_path.write_bytes(broken)
        with suppress(InvalidInput):
            build(source, tmp_path / f"v{number}", THIRD, HALF)


def test_a_part_of_a_result_is_never_taken_for_a_bag(plain, tmp_path):
    """As a killed build would leave it; the foretold index is not there yet."""
    made = build(plain, tmp_path / "v", THIRD)
    whole = made.bag_path.read_bytes()
    for size in (4109, len(whole) // 2, len(whole) - 1):
        made.bag_path.write_bytes(whole[:size])
        with pytest.raises(InvalidInput), Ros1File(made.bag_path) as file:
            read_index(file)


def test_an_error_from_progress_ends_the_work(plain, tmp_path):
    class Cancelled(Exception):
        pass

    def progress(fraction, _text):
        if fraction > 0.3:
            raise Cancelled

    (tmp_path / "v").mkdir()
    with pytest.raises(Cancelled):
        build_variant(plain, (THIRD, HALF), tmp_path / "v", progress)
