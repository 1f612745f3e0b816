"""Images that algorithms do not read: an import makes plain ones of them, pixel for pixel where nothing is lost."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import SensorKind
from slamhive.recordings.importers.odd_images import ODD_ENCODINGS, decode_rvl, plain_image
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, ImportPlan, perform
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, convert
from slamhive.runtime.recording import Recording
from tests.cases import case
from tests.fuzzing import mutated
from tests.recordings.test_import_ros import silent

pytestmark = pytest.mark.quick

STORE = get_typestore(Stores.ROS1_NOETIC)
START_NS, PERIOD_NS, FRAMES = 10**12, 100_000_000, 3
HEIGHT, WIDTH = 48, 64
RGB = np.dstack([
    np.tile(np.linspace(20, 200, WIDTH), (HEIGHT, 1)),
    np.tile(np.linspace(200, 60, HEIGHT)[:, None], (1, WIDTH)),
    np.full((HEIGHT, WIDTH), 90.0),
]).astype(np.uint8)  # fmt: skip
"""Smooth, so that what a camera leaves out of colour can be put back."""
DEPTH_MM = np.where(np.indices((HEIGHT, WIDTH)).sum(axis=0) % 7 == 0, 0, 500 + 31 * np.indices((HEIGHT, WIDTH))[1])
DEPTH_MM = DEPTH_MM.astype(np.uint16)


def header(index: int) -> Any:
    stamp_ns = START_NS + index * PERIOD_NS
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return STORE.types["std_msgs/msg/Header"](seq=index, stamp=stamp, frame_id="camera")


def image(encoding: str, pixels: Any, index: int = 0, *, big: bool = False, padding: int = 0) -> Any:
    """A message; ``pixels`` is (rows, numbers), which need not be the height and width of the image."""
    rows = np.ascontiguousarray(pixels.reshape(len(pixels), -1)).astype(pixels.dtype.newbyteorder(">" if big else "<"))
    data = np.pad(rows.view(np.uint8), ((0, 0), (0, padding)), constant_values=7)
    kind = STORE.types[IMAGE]
    return kind(
        header=header(index), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=int(big),
        step=data.shape[1], data=data.reshape(-1),
    )  # fmt: skip


def compressed(text: str, data: bytes, index: int = 0) -> Any:
    return STORE.types[COMPRESSED_IMAGE](header=header(index), format=text, data=np.frombuffer(data, np.uint8))


def bayer(pattern: str) -> Any:
    """Of each pixel the colour that a filter of this pattern lets through."""
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = RGB[row::2, column::2, "rgb".index(colour)]
    return mosaic


def yuv(order: str) -> Any:
    """``Y`` of each pixel, and ``U`` and ``V`` of every second one (BT.601, full colour in 16 to 240)."""
    r, g, b = (RGB[..., place].astype(np.float64) for place in range(3))
    y = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    u = 128 - 0.148 * r - 0.291 * g + 0.439 * b
    v = 128 + 0.439 * r - 0.368 * g - 0.071 * b
    packed = np.zeros((HEIGHT, WIDTH, 2))
    luma, chroma = order.index("y"), 1 - order.index("y")
    packed[..., luma] = y
    packed[:, ::2, chroma], packed[:, 1::2, chroma] = u[:, ::2], v[:, ::2]
    return np.rint(packed).astype(np.uint8)


def rvl(depth: Any) -> bytes:
    """The image as the reference implementation compresses it (Wilson 2017)."""
    nibbles: list[int] = []

    def number(value: int) -> None:
        while True:
            value, low = value >> 3, value & 7
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    pixels, place, previous = depth.reshape(-1).astype(int).tolist(), 0, 0
    while place < len(pixels):
        zeros = next((k for k, value in enumerate(pixels[place:]) if value), len(pixels) - place)
        number(zeros)
        place += zeros
        count = next((k for k, value in enumerate(pixels[place:]) if not value), len(pixels) - place)
        number(count)
        for value in pixels[place : place + count]:
            delta = value - previous
            number((delta << 1) ^ (delta >> 31))
            previous = value
        place += count
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return np.array([depth.shape[1], depth.shape[0], *words], dtype="<u4").tobytes()


def config(a: float = 0.0, b: float = 0.0) -> bytes:
    return np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()


def png(pixels: Any) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


MESSAGES: dict[str, Any] = {
    **{f"bayer_{pattern}8": image(f"bayer_{pattern}8", bayer(pattern)) for pattern in ("rggb", "bggr", "gbrg", "grbg")},
    "bayer_rggb16": image("bayer_rggb16", bayer("rggb").astype(np.uint16) * 257),
    "bayer_rggb16 big": image("bayer_rggb16", bayer("rggb").astype(np.uint16) * 257, big=True),
    "yuv422": image("yuv422", yuv("uy")),
    "yuv422 padded": image("yuv422", yuv("uy"), padding=10),
    "uyvy": image("uyvy", yuv("uy")),
    "yuv422_yuy2": image("yuv422_yuy2", yuv("yu")),
    "rgb16": image("rgb16", RGB.astype(np.uint16) * 257),
    "bgra16": image("bgra16", np.dstack((RGB[..., ::-1], RGB[..., :1])).astype(np.uint16) * 257, big=True),
}
QUANT_A, QUANT_B = 100.0 * 101.0, 1.0 - 101.0 * 100.0 / 10.0
STORED = np.where(DEPTH_MM == 0, 0, QUANT_A / (np.maximum(DEPTH_MM, 1) / 1000.0) + QUANT_B).astype(np.uint16)
DEPTHS: dict[str, Any] = {
    "16UC1 png": compressed("16UC1; compressedDepth png", config() + png(DEPTH_MM)),
    "16UC1": compressed("16UC1; compressedDepth", config() + png(DEPTH_MM)),
    "16UC1 rvl": compressed("16UC1; compressedDepth rvl", config() + rvl(DEPTH_MM)),
    "32FC1 png": compressed("32FC1; compressedDepth png", config(QUANT_A, QUANT_B) + png(STORED)),
    "32FC1 rvl": compressed("32FC1; compressedDepth rvl", config(QUANT_A, QUANT_B) + rvl(STORED)),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_colours_are_those_that_the_camera_saw(name):
    pixels, encoding = plain_image(MESSAGES[name], IMAGE)
    assert (encoding, pixels.shape) == ("rgb8", (HEIGHT, WIDTH, 3))
    assert pixels.dtype == np.uint8
    inside = np.s_[2:-2, 2:-2]
    assert np.abs(pixels.astype(int) - RGB)[inside].max() <= 6


def check_depth(name: str, pixels: Any, encoding: str) -> None:
    if name.startswith("16UC1"):
        assert encoding == "16UC1"
        assert (pixels == DEPTH_MM).all()
        return
    assert encoding == "32FC1"
    assert (np.isnan(pixels) == (DEPTH_MM == 0)).all()
    known = DEPTH_MM > 0
    # a step of the inverse depth is d^2 / A
    assert (np.abs(pixels[known] - DEPTH_MM[known] / 1000) <= (DEPTH_MM[known] / 1000) ** 2 / QUANT_A * 1.01).all()


@pytest.mark.parametrize("name", DEPTHS)
def test_depths_are_those_that_were_compressed(name):
    check_depth(name, *plain_image(DEPTHS[name], COMPRESSED_IMAGE))


@pytest.mark.parametrize(
    "pixels", [np.zeros((3, 5)), np.full((3, 5), 65535), np.eye(40) * 1234, np.arange(600).reshape(20, 30)]
)
def test_rvl_gives_any_image_back(pixels):
    expected = pixels.astype(np.uint16)
    assert (decode_rvl(rvl(expected)) == expected).all()


def write(path: Path, topic: str, messages: list[Any], kind: str, **stated: Any) -> None:
    """A recording of one camera with its ``CameraInfo``, in which ``stated`` replaces fields."""
    info = STORE.types["sensor_msgs/msg/CameraInfo"](
        header=header(0), height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", D=np.zeros(5),
        K=np.array([60.0, 0, 31.5, 0, 60, 23.5, 0, 0, 1]), R=np.eye(3).reshape(-1), P=np.zeros(12), binning_x=0,
        binning_y=0, roi=STORE.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )  # fmt: skip
    for name, value in stated.items():
        setattr(info, name, value)
    with Writer(path) as writer:
        of_info = writer.add_connection("/camera/camera_info", "sensor_msgs/msg/CameraInfo", typestore=STORE)
        connection = writer.add_connection(topic, kind, typestore=STORE)
        writer.write(of_info, START_NS, STORE.serialize_ros1(info, "sensor_msgs/msg/CameraInfo"))
        for index, message in enumerate(messages):
            raw = STORE.serialize_ros1(message, kind)
            writer.write(connection, START_NS + index * PERIOD_NS + 5_000_000, raw)


def imported(source: Path, folder: Path) -> tuple[ImportPlan, list[tuple[int, int, Any]]]:
    """The plan, and of each image of the dataset as a run gets it: when it was received, its timestamp, its pixels."""
    plan = plan_import(source, ImportOptions())[1]
    dataset = perform(plan, folder, silent)
    (sensor,) = dataset.sensors
    with Recording(dataset.bag_path, {sensor.name: sensor.topic}) as reader:
        found = [
            (entry.recorded_ns, entry.message.header.stamp.sec * 10**9 + entry.message.header.stamp.nanosec,
             convert(entry.message, entry.kind))
            for entry in reader.messages()
        ]  # fmt: skip
    return plan, found


@pytest.mark.parametrize("name", ["bayer_grbg8", "yuv422", "bgra16"])
def test_a_run_gets_plain_images(tmp_path, name):
    source = tmp_path / "a.bag"
    write(
        source,
        "/camera/image_raw",
        [MESSAGES[name].__class__(**{**vars(MESSAGES[name]), "header": header(k)}) for k in range(FRAMES)],
        IMAGE,
    )
    plan, found = imported(source, tmp_path / "made")
    assert plan.sensors[0].calibration["encoding"] == "rgb8"
    assert any(f"({MESSAGES[name].encoding}) become rgb8" in note for note in plan.notes)
    stamps_ns = [START_NS + index * PERIOD_NS for index in range(FRAMES)]
    assert [entry[:2] for entry in found] == [(stamp_ns + 5_000_000, stamp_ns) for stamp_ns in stamps_ns]
    assert all((entry[2] == plain_image(MESSAGES[name], IMAGE)[0]).all() for entry in found)


@pytest.mark.parametrize("name", DEPTHS)
def test_a_run_gets_plain_depths(tmp_path, name):
    source = tmp_path / "a.bag"
    messages = [DEPTHS[name].__class__(**{**vars(DEPTHS[name]), "header": header(k)}) for k in range(FRAMES)]
    write(source, "/camera/image_raw/compressedDepth", messages, COMPRESSED_IMAGE)
    plan, found = imported(source, tmp_path / "made")
    (sensor,) = plan.sensors
    assert sensor.kind is SensorKind.DEPTH
    assert sensor.calibration["units_per_m"] == (1000 if name.startswith("16UC1") else 1)
    for entry in found:
        check_depth(name, entry[2], str(sensor.calibration["encoding"]))


def test_window_and_binning_of_camera_info_are_applied(tmp_path):
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=20, y_offset=10, height=2 * HEIGHT, width=2 * WIDTH, do_rectify=False
    )
    K = np.array([120.0, 0, 20 + 2 * 31.5, 0, 122, 10 + 2 * 23.5, 0, 0, 1])
    stated = {"height": 400, "width": 600, "K": K, "binning_x": 2, "binning_y": 2, "roi": roi}
    source = tmp_path / "a.bag"
    write(source, "/camera/image_raw", [image("rgb8", RGB, k) for k in range(FRAMES)], IMAGE, **stated)
    plan = plan_import(source, ImportOptions())[1]
    found = CameraIntrinsics.of(plan.sensors[0])
    assert (found.width, found.height) == (WIDTH, HEIGHT)
    assert (found.fx, found.fy, found.cx, found.cy) == (60, 61, 31.5, 23.5)
    assert "the CameraInfo of cam0 is of 600x400 pixels; its window and binning are applied" in plan.notes


def test_a_real_bag_of_yuv_has_images(tmp_path):
    source = case("ros1_bags") / "only_yuv422.bag"
    options = ImportOptions(calibration=(calibration(tmp_path, source),))
    plan = plan_import(source, options)[1]
    assert plan.sensors[0].calibration["encoding"] == "rgb8"
    dataset = perform(plan, tmp_path / "made", silent)
    (sensor,) = dataset.sensors
    with Recording(dataset.bag_path, {sensor.name: sensor.topic}) as reader:
        assert reader.count(sensor.name) == plan.counts[sensor.name] > 1


def calibration(folder: Path, source: Path) -> Path:
    from slamhive.recordings.importers.recording import open_source  # noqa: PLC0415

    with open_source([source], ImportOptions()) as opened:
        message = opened.first("/cam/image_raw")
    path = folder / "cam.yaml"
    path.write_text(
        "cam0: {camera_model: pinhole, intrinsics: [60, 60, 30, 20], distortion_model: none, distortion_coeffs: [], "
        f"resolution: [{message.width}, {message.height}], rostopic: /cam/image_raw}}\n"
    )
    return path


@pytest.mark.parametrize("name", [*MESSAGES, *DEPTHS])
def test_mutated_images_are_read_or_refused_in_a_line(name):
    message = {**MESSAGES, **DEPTHS}[name]
    kind = IMAGE if name in MESSAGES else COMPRESSED_IMAGE
    original, refused = np.asarray(message.data).tobytes(), []
    for seed in range(60):
        damaged = mutated(original, random.Random(f"{name}{seed}"))
        changed = message.__class__(**{**vars(message), "data": np.frombuffer(damaged, np.uint8)})
        try:
            pixels, _ = plain_image(changed, kind)
        except SlamHiveError as error:
            refused.append(str(error))
        else:
            assert pixels.size
    assert not [text for text in refused if "\n" in text]


def test_what_is_not_read_is_named():
    assert "nv12" in ODD_ENCODINGS
    with pytest.raises(InvalidInput, match="'bayer_xxxx8' is not read"):
        plain_image(image("bayer_xxxx8", bayer("rggb")), IMAGE)
    with pytest.raises(InvalidInput, match=r"8UC1; compressedDepth.* is not read"):
        plain_image(compressed("8UC1; compressedDepth", config() + png(DEPTH_MM)), COMPRESSED_IMAGE)
