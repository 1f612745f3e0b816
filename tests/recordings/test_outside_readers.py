"""Recordings of Ouster's sensors and of Project Aria's glasses, which their makers' libraries read."""

import io
import json
import random
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.domain.calibration import CameraIntrinsics, CameraModel, LidarLayout
from slamhive.recordings.importers import outside_reader
from slamhive.recordings.importers.aria import ARIA
from slamhive.recordings.importers.outside_lidar import OUSTER
from slamhive.recordings.importers.outside_reader import ALIVE, POINT, RECORD_HEADER, rectified, watched
from slamhive.recordings.importers.registry import detect_format, plan_import
from slamhive.recordings.importing import ImportOptions, Loss, perform
from slamhive.runtime.messages import to_points
from slamhive.trajectory.layout import read_tum
from tests.fuzzing import mutated
from tests.recordings.format_world import convert, plan, recorded, silent
from tests.recordings.vrs_files import SHAPE, Glasses

pytestmark = pytest.mark.integration
START_NS = 1_700_000_000_000_000_000
MUTATIONS = 40

WRITE_PCAP = """
import struct
import sys
import numpy as np
from ouster.sdk import core, pcap

folder, start_ns = sys.argv[1], int(sys.argv[2])
info = core.SensorInfo.from_default(core.LidarMode._512x10)
info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
layout, packets = core.PacketFormat(info), []
for number in range(3):
    frame = core.LidarFrame(info)
    frame.frame_id = number + 1
    frame.field("RANGE")[:] = 5000
    frame.status[:] = 1
    frame.measurement_id[:] = np.arange(info.w)
    frame.timestamp[:] = start_ns + number * 100_000_000 + np.arange(info.w) * 195_312
    frame.packet_timestamp[:] = frame.timestamp[:: info.w // len(frame.packet_timestamp)]
    packets += core.frame_to_packets(frame, layout, 0, 0)
for number in range(6):
    sample = core.ImuPacket(layout)
    time_ns = start_ns + number * 10_000_000
    # the older packets count in g and degrees
    data = struct.pack("<QQQ6f", time_ns, time_ns, time_ns, 0, 0, 1, 180, 0, number)
    sample.buf[: len(data)] = np.frombuffer(data, dtype=np.uint8)
    sample.host_timestamp = time_ns
    packets.append(sample)
pcap.record(iter(packets), f"{folder}/drive.pcap", lidar_port=7502, imu_port=7503)
open(f"{folder}/drive.json", "w").write(info.to_json_string())
"""

WRITE_OSF = """
import sys
import numpy as np
from ouster.sdk import core, open_source, osf

folder, start_ns = sys.argv[1], int(sys.argv[2])
draw = np.random.default_rng(1)
info = core.SensorInfo.from_default(core.LidarMode._512x10)
info.sensor_to_body = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
with osf.Writer(f"{folder}/hall.osf", info) as writer:
    for number in range(4):
        frame = core.LidarFrame(info)
        frame.field("RANGE")[:] = draw.integers(0, 50_000, (info.h, info.w)) * draw.integers(0, 2, (info.h, info.w))
        frame.field("REFLECTIVITY")[:] = draw.integers(0, 256, (info.h, info.w))
        frame.timestamp[:] = start_ns + number * 100_000_000 + np.arange(info.w) * 195_312
        frame.status[:] = 1
        if number == 2:
            frame.status[:100] = 0
        fields = {
            "IMU_TIMESTAMP": start_ns + number * 100_000_000 + np.arange(10, dtype=np.uint64) * 10_000_000,
            "IMU_STATUS": np.array([1] * 9 + [0], dtype=np.uint16),
            "IMU_GYRO": np.full((10, 3), [0.1, 0.2, number], dtype=np.float32),
            "IMU_ACC": np.full((10, 3), [0, 0, 9.81], dtype=np.float32),
            "POSITION_LAT_LONG": np.full((2, 2), 47.4),
        }
        for name, values in fields.items():
            frame.add_field(name, values, core.FieldClass.FRAME_FIELD)
        writer.save(0, frame)
expected = {}
positions = core.XYZLut(info)
for number, frames in enumerate(open_source(f"{folder}/hall.osf")):
    frame = frames[0]
    seen = (frame.field("RANGE") > 0) & (frame.status == 1)
    expected[f"xyz{number}"] = positions(frame)[seen]
    expected[f"times{number}"] = np.broadcast_to(frame.timestamp, seen.shape)[seen]
    expected[f"bright{number}"] = frame.field("REFLECTIVITY")[seen]
in_sensor = np.array(info.imu_to_sensor_transform)
in_sensor[:3, 3] /= 1000
np.savez(f"{folder}/expected.npz", imu=info.sensor_to_body @ in_sensor, **expected)
"""


@pytest.fixture
def outside(monkeypatch, outside_python):
    for library in (OUSTER, ARIA):
        monkeypatch.setenv(library.variable, str(outside_python))
    return outside_python


def refused(source, format_name, parts):
    """What an import says of damage in one of ``parts``; each refusal is one line and leaves nothing behind."""
    draw = random.Random(f"{format_name} 1")
    refusals = []
    for number in range(MUTATIONS):
        part = draw.choice(parts)
        whole = part.read_bytes()
        part.write_bytes(mutated(whole, draw))
        made = part.parent / f"made{number}"
        try:
            perform(plan_import(source, ImportOptions(), format_name)[1], made, silent)
        except SlamHiveError as error:
            refusals.append(str(error))
            assert not made.exists()
        part.write_bytes(whole)
    assert not any("\n" in refusal for refusal in refusals)
    return refusals


@pytest.fixture(scope="module")
def written(tmp_path_factory, outside_python):
    """A folder with an OSF file, and what the library itself says of it."""
    folder = tmp_path_factory.mktemp("hall")
    subprocess.run([outside_python, "-c", WRITE_OSF, folder, str(START_NS)], check=True, timeout=120)
    return folder


@pytest.fixture
def hall(tmp_path, outside, written):
    return Path(shutil.copy(written / "hall.osf", tmp_path))


def test_points_and_times_of_an_osf_file_are_those_of_ousters_own_library(hall, written, tmp_path):
    dataset = convert(hall, tmp_path / "made")
    lidar, imu = dataset.sensors
    layout = LidarLayout.of(lidar)
    assert (layout.beams, layout.points_per_ring, len(layout.vertical_angles_deg)) == (64, 512, 64)
    assert layout.times.scan_duration_s == pytest.approx(0.1)
    assert np.reshape(lidar.T_body_sensor, (4, 4))[:3, 3].tolist() == [1, 2, 3]
    expected, seen = np.load(written / "expected.npz"), recorded(dataset)
    assert len(seen["/points"]) == 4
    for number, message in enumerate(seen["/points"]):
        cloud = to_points(message)
        # the library has its points by rings, the recording by columns
        order = np.argsort(cloud.field("ring"), kind="stable")
        assert np.abs(cloud.points_m[order] - expected[f"xyz{number}"]).max() < 4e-6
        assert cloud.field("intensity")[order].tolist() == expected[f"bright{number}"].tolist()
        times_ns = expected[f"times{number}"].astype(np.int64)
        since_s = layout.times.since_start_s(cloud, times_ns.min() * 1e-9)[order]
        assert since_s == pytest.approx((times_ns - times_ns.min()) * 1e-9, abs=1e-8)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == times_ns.min()
    # a tenth of the samples is marked as not valid
    assert len(seen["/imu"]) == 36
    assert [seen["/imu"][9].angular_velocity.z, seen["/imu"][9].linear_acceleration.z] == pytest.approx([1, 9.81])
    assert np.reshape(imu.T_body_sensor, (4, 4)) == pytest.approx(expected["imu"])
    assert np.linalg.norm(expected["imu"][:3, 3] - [1, 2, 3]) < 0.05


def test_a_capture_has_the_samples_of_older_packets_in_si_units(tmp_path, outside):
    subprocess.run([outside, "-c", WRITE_PCAP, tmp_path, str(START_NS)], check=True, timeout=120)
    dataset = convert(tmp_path / "drive.pcap", tmp_path / "made")
    seen = recorded(dataset)
    scans = [to_points(message) for message in seen["/points"]]
    assert [len(cloud.points_m) for cloud in scans] == [64 * 512] * 3
    assert np.linalg.norm(scans[0].points_m, axis=1) == pytest.approx(5, abs=0.05)
    assert len(seen["/imu"]) == 6
    last = seen["/imu"][-1]
    assert [last.angular_velocity.x, last.angular_velocity.z] == pytest.approx([np.pi, np.radians(5)])
    assert last.linear_acceleration.z == pytest.approx(9.80665)
    assert last.header.stamp.sec * 10**9 + last.header.stamp.nanosec == START_NS + 50_000_000


def test_what_an_osf_file_lacks_is_said(hall):
    notes = plan(hall).notes
    assert "1 of 4 scans of lidar0 lack columns, since packets were lost" in notes
    assert "the GNSS positions that lidar0 recorded are left out" in notes
    assert "there is no ground truth: runs get no ATE (--groundtruth FILE adds one)" in notes


def test_damaged_scans_of_an_osf_file_are_a_loss(hall):
    data = bytearray(hall.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 8] = b"damaged!"
    hall.write_bytes(data)
    with pytest.raises(InvalidInput, match=r"hall\.osf: 4 of 4 scans of OS-1-64 0 are damaged and left out"):
        plan(hall)


def test_a_capture_needs_the_description_of_its_sensor(tmp_path, outside):
    capture = tmp_path / "drive.pcap"
    capture.write_bytes(b"\xd4\xc3\xb2\xa1")
    with pytest.raises(InvalidInput, match=r"looks like ouster .*lacks the .json file of the sensor beside it"):
        detect_format(capture)
    (tmp_path / "drive.json").write_text("{}")
    assert detect_format(capture) == "ouster"
    with pytest.raises(InvalidInput, match=r"ouster cannot read drive.pcap: "):
        plan(capture)


def test_the_name_of_a_sensor_is_no_recording(tmp_path):
    (tmp_path / "os-122201000998.local").touch()
    with pytest.raises(InvalidInput, match=r"is no recording of Ouster: it lacks an \.osf file, or a \.pcap file"):
        plan(tmp_path / "os-122201000998.local", "ouster")


def test_a_damaged_stream_of_ousters_library_is_refused_in_one_line(tmp_path, monkeypatch):
    program, source = tmp_path / "replay", tmp_path / "hall.osf"
    program.write_text('#!/bin/sh\nexec cat "$(dirname "$0")/$4"\n')
    program.chmod(0o755)
    monkeypatch.setenv(OUSTER.variable, str(program))
    source.touch()
    sensor = {
        "product": "OS-1-64",
        "serial": "1",
        "timestamp_mode": "TIME_FROM_PTP_1588",
        "columns": 4,
        "elevations_deg": [1.0, 0.0],
        "T_body_sensor": np.eye(4).reshape(-1).tolist(),
        "T_sensor_imu": np.eye(4).reshape(-1).tolist(),
        "listed": 2,
        "partial": 0,
        "posed": False,
        "second_returns": False,
        "gnss": False,
    }
    times_ns = START_NS + 100_000_000 * np.arange(2)
    arrays = {"scan0_times_ns": times_ns, "imu0_times_ns": times_ns, "imu0": np.ones((2, 6))}
    about = {"sensors": [sensor], "arrays": [[name, a.dtype.str, list(a.shape)] for name, a in arrays.items()]}
    (tmp_path / "plan").write_bytes(json.dumps(about).encode() + b"\n" + b"".join(a.tobytes() for a in arrays.values()))
    scans = (RECORD_HEADER.pack(int(ns), 8) + np.zeros(8, dtype=POINT).tobytes() for ns in times_ns)
    (tmp_path / "records").write_bytes(b"".join(scans))
    refusals = refused(source, "ouster", [tmp_path / "plan", tmp_path / "plan", tmp_path / "records"])
    assert len(refusals) > MUTATIONS // 10
    convert(source, tmp_path / "whole")


def test_a_file_that_is_no_vrs_file_is_refused_in_one_line(tmp_path, outside):
    (tmp_path / "walk.vrs").write_bytes(b"no VRS file" * 100)
    assert detect_format(tmp_path) == "aria"
    with pytest.raises(
        InvalidInput, match=r"aria cannot read walk.vrs: it is no VRS file, or its index is damaged; "
    ) as it:
        plan(tmp_path)
    assert "\x1b" not in str(it.value)


def test_without_the_library_it_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.delenv(ARIA.variable, raising=False)
    (tmp_path / "walk.vrs").touch()
    with pytest.raises(Unavailable, match=r"aria/bin/pip install projectaria-tools\), and set SLAMHIVE_ARIA_PYTHON"):
        plan(tmp_path)


@pytest.fixture
def walk(tmp_path):
    """A recording of glasses that turn and accelerate along sines of time, with what it holds."""
    times_ns = START_NS + np.arange(200, dtype=np.int64) * 1_000_000
    since_s = (times_ns - START_NS) / 1e9
    waves = np.stack([np.sin(20 * (since_s - delay_s)) for delay_s in (0.004, 0.0035)], axis=1)
    rectify, bias = np.array([[1.01, 0.01, 0], [0, 0.99, 0], [0, 0.02, 1]]), np.array([0.1, -0.2, 0.3])
    measured = np.concatenate([np.repeat(wave[:, None], 3, axis=1) @ rectify.T + bias for wave in waves.T], axis=1)
    made = Glasses(
        image_times_ns=START_NS + 33_000_000 * np.arange(3, dtype=np.int64),
        images=np.random.default_rng(1).integers(0, 256, (3, *SHAPE), dtype=np.uint8),
        imu_times_ns=times_ns,
        samples=measured,
        fisheye=(240.0, 318.5, 241.0, -0.02, 0.09, -0.06, 0.01),
        camera_offset_s=0.002,
        imu_offsets_s=(0.004, 0.0035),
        rectify=rectify,
        bias=bias,
        imu_position_m=(0.01, -0.1, 0.02),
    )
    made.write(tmp_path / "walk.vrs")
    return tmp_path / "walk.vrs", made


def test_a_vrs_file_becomes_what_the_glasses_saw_and_felt(walk, outside, tmp_path):
    source, made = walk
    dataset = convert(source, tmp_path / "made")
    camera, imu = dataset.sensors
    found = CameraIntrinsics.of(camera)
    assert (found.model, found.height, found.width) == (CameraModel.FISHEYE_KB, *SHAPE)
    focal_px, *others = made.fisheye
    assert (found.fx, found.fy, found.cx, found.cy, *found.distortion) == pytest.approx((focal_px, focal_px, *others))
    assert camera.calibration["time_offset_s"] == pytest.approx(-made.camera_offset_s)
    assert np.reshape(imu.T_body_sensor, (4, 4))[:3, 3] == pytest.approx(made.imu_position_m)
    seen = recorded(dataset)
    assert [message.data.tobytes() for message in seen["/cam0/image_raw"]] == [image.tobytes() for image in made.images]
    stamps_ns = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in seen["/cam0/image_raw"]]
    assert stamps_ns == made.image_times_ns.tolist()
    assert len(seen["/imu"]) > 190
    for message in seen["/imu"]:
        since_s = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - START_NS) / 1e9
        assert message.angular_velocity.z == pytest.approx(np.sin(20 * since_s), abs=1e-6)
        assert message.linear_acceleration.x == pytest.approx(np.sin(20 * since_s), abs=1e-4)


def test_a_damaged_vrs_file_is_read_or_refused_in_one_line(walk, outside):
    source, _ = walk
    whole, refusals = source.read_bytes(), []
    for cut in (100, 3000, len(whole) // 3):
        source.write_bytes(whole[:cut] + bytes(64) + whole[cut + 64 :])
        try:
            plan(source)
        except InvalidInput as error:
            refusals.append(str(error))
    assert any("walk.vrs" in refusal for refusal in refusals)
    assert not any("\n" in refusal or "\x1b" in refusal for refusal in refusals)


# What follows needs no library: a program writes what the reader would.

RATES_NS = {"cam0": 33_000_000, "imu0": 1_000_000}
FISHEYE = (240.0, 241.0, 31.0, 23.5, -0.02, 0.09, -0.06, 0.01)
WIDTH, HEIGHT = 64, 48


def rays(bent_px=0.0):
    """Pixels and their directions by the model of Kannala and Brandt, whose pixels may be moved as no model can."""
    fx, fy, cx, cy, *k = FISHEYE
    rows = []
    for angle in np.linspace(0.0, 1.3, 14):
        for azimuth in np.linspace(0, 2 * np.pi, 24, endpoint=False):
            radius = angle + sum(number * angle**power for number, power in zip(k, (3, 5, 7, 9), strict=True))
            u, v = cx + fx * radius * np.cos(azimuth), cy + fy * radius * np.sin(azimuth)
            bend = bent_px * np.cos(5 * azimuth)
            x, y, z = np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)
            rows.append([u + bend, v, x, y, z])
    return np.array(rows)


def told(**changes) -> bytes:
    """What the reader writes for one camera and one IMU, which turns and accelerates along sines of time."""
    times_ns = START_NS + np.arange(300) * RATES_NS["imu0"]
    since_s = (times_ns - START_NS) / 1e9
    wave = np.stack([np.sin(20 * (since_s - 0.004)), np.sin(20 * (since_s - 0.0035))], axis=1)
    arrays = {
        "cam0_times_ns": START_NS + RATES_NS["cam0"] * np.arange(3),
        "rays0": rays(changes.pop("bent_px", 0.0)),
        "imu0_times_ns": times_ns,
        "imu0": np.repeat(wave, 3, axis=1),
    }
    arrays.update({name: changes.pop(name) for name in list(changes) if name in arrays})
    about = {
        "device": "DVT-S",
        "cameras": [
            {
                "label": "camera-slam-left",
                "stream": "1201-1",
                "width": WIDTH,
                "height": HEIGHT,
                "channels": 1,
                "focal_px": 200.0,
                "model": "FISHEYE624",
                "time_offset_s": 0.002,
                "T_device_sensor": np.eye(4).reshape(-1).tolist(),
            }
        ],
        "imus": [
            {
                "label": "imu-right",
                "invalid": 0,
                "gyro_offset_s": 0.004,
                "force_offset_s": 0.0035,
                "T_device_sensor": np.eye(4).reshape(-1).tolist(),
            }
        ],
        "left_out": ["mic", "baro0"],
        "arrays": [[name, values.dtype.str, list(values.shape)] for name, values in arrays.items()],
        **changes,
    }
    return json.dumps(about).encode() + b"\n" + b"".join(values.tobytes() for values in arrays.values())


def picture(number: int):
    return np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def trajectory(*rows: str) -> str:
    position, quat = ("tx", "ty", "tz"), ("qx", "qy", "qz", "qw")
    names = [*(f"{name}_world_device" for name in (*position, *quat)), *(f"gravity_{axis}_world" for axis in "xyz")]
    return "\n".join([",".join(["graph_uid", "tracking_timestamp_us", *names]), *rows]) + "\n"


@pytest.fixture
def glasses(tmp_path, monkeypatch):
    """The folder of a recording, and a program beside it that writes the files ``plan`` and ``records``."""
    program = tmp_path / "replay"
    program.write_text('#!/bin/sh\nexec cat "$(dirname "$0")/$4"\n')
    program.chmod(0o755)
    monkeypatch.setenv(ARIA.variable, str(program))
    (tmp_path / "plan").write_bytes(ALIVE["plan"] * 2 + told())
    images = (
        ALIVE["records"] + RECORD_HEADER.pack(START_NS + RATES_NS["cam0"] * n, WIDTH * HEIGHT) + picture(n).tobytes()
        for n in range(3)
    )
    (tmp_path / "records").write_bytes(b"".join(images))
    folder = tmp_path / "walk"
    (folder / "mps" / "slam").mkdir(parents=True)
    (folder / "walk.vrs").touch()
    poses = [f"a,{START_NS // 1000 + 20_000 * n},{n},0,0,0,0,0,1,0,0,-9.81" for n in range(5)]
    other = f"b,{START_NS // 1000 + 200_000},7,7,7,0,0,0,1,0,0,-9.81"
    (folder / "mps" / "slam" / "closed_loop_trajectory.csv").write_text(trajectory(*poses, other))
    return folder


def test_images_imu_and_trajectory_of_glasses_become_a_dataset(glasses, tmp_path):
    made = plan(glasses)
    assert any("1 of 6 poses are in 1 other maps than the largest one" in note for note in made.notes)
    assert "left out: baro0, mic" in made.notes
    dataset = convert(glasses, tmp_path / "made")
    camera, _ = dataset.sensors
    found = CameraIntrinsics.of(camera)
    assert (found.model, found.width, found.height) == (CameraModel.FISHEYE_KB, WIDTH, HEIGHT)
    assert (found.fx, found.fy, found.cx, found.cy, *found.distortion) == pytest.approx(FISHEYE, abs=1e-5)
    assert camera.calibration["time_offset_s"] == -0.002
    seen = recorded(dataset)
    assert [message.data.tobytes() for message in seen["/cam0/image_raw"]] == [picture(n).tobytes() for n in range(3)]
    for message in seen["/imu"]:
        # Without the delays, both would be the same sine of time.
        since_s = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - START_NS) / 1e9
        expected = np.sin(20 * since_s)
        assert message.angular_velocity.x == pytest.approx(expected, abs=1e-9)
        assert message.linear_acceleration.x == pytest.approx(expected, abs=1e-4)
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.positions_m[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert truth.quats_xyzw[0].tolist() == [0, 0, 0, 1]
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.gravity_aligned


def test_how_far_the_camera_model_is_off_is_said(glasses):
    (glasses.parent / "plan").write_bytes(told(bent_px=3.0))
    note = next(note for note in plan(glasses).notes if note.startswith("cam0 is camera-slam-left"))
    assert "FISHEYE624 becomes fisheye-kb, 2.1 pixels apart (RMS), at most 3" in note


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"cam0_times_ns": np.array([START_NS, START_NS])},
            "timestamps of the images of camera-slam-left of walk.vrs do",
        ),
        ({"imu0": np.full((300, 6), np.nan)}, "a sample of imu-right of walk.vrs is not finite"),
        ({"imu0": np.ones((299, 6))}, "aria stopped while it read walk.vrs"),
        ({"rays0": np.ones((5, 5))}, "the calibration of camera-slam-left covers 5 of 625 pixels"),
        ({"cameras": []}, "aria stopped while it read walk.vrs"),
    ],
)
def test_a_mistake_in_a_recording_of_glasses_is_one_clear_line(glasses, changes, problem):
    (glasses.parent / "plan").write_bytes(told(**changes))
    with pytest.raises(InvalidInput, match=problem):
        plan(glasses)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("time,x\n1,2\n", "lacks the columns graph_uid, tracking_timestamp_us, tx_world_device"),
        (trajectory(), "has no poses"),
        (trajectory("a,x,0,0,0,0,0,0,1,0,0,-9.81"), "trajectory.csv:2: a value is no number"),
        (trajectory("a,1,0,0,0,0,0,0,0,0,0,-9.81"), "trajectory.csv:2: "),
        (trajectory(*(f"a,{n},0,0,0,0,0,0,1,0,0,-9.81" for n in (1, 2))), "the clocks do not meet"),
    ],
)
def test_a_mistake_in_a_trajectory_of_glasses_is_one_clear_line(glasses, text, problem):
    (glasses / "mps" / "slam" / "closed_loop_trajectory.csv").write_text(text)
    with pytest.raises(InvalidInput, match=problem):
        plan(glasses)


def test_samples_that_the_glasses_call_invalid_are_a_loss(glasses):
    imu = {**json.loads(told().split(b"\n")[0])["imus"][0], "invalid": 1}
    (glasses.parent / "plan").write_bytes(told(imus=[imu]))
    assert Loss(1, 301, "1 of 301 samples of imu-right are marked invalid") in plan(glasses).notes


def test_images_of_another_size_are_refused(glasses):
    (glasses.parent / "records").write_bytes(RECORD_HEADER.pack(START_NS, 5) + b"abcde")
    with pytest.raises(InvalidInput, match="image 0 of camera-slam-left has 5 bytes, not 48 x 64"):
        perform(plan(glasses), glasses.parent / "made", silent)


def test_a_damaged_stream_of_glasses_is_refused_in_one_line(glasses):
    parts = [glasses.parent / name for name in ("plan", "plan", "records")]
    assert len(refused(glasses, "aria", parts)) > MUTATIONS // 10


def test_a_library_that_crashes_is_named_with_its_signal(glasses):
    (glasses.parent / "replay").write_text("#!/bin/sh\necho 'check failed: index' >&2\nkill -ABRT $$\n")
    with pytest.raises(InvalidInput, match=r"aria cannot read walk.vrs: check failed: index \(ended by SIGABRT\)"):
        plan(glasses)


@pytest.mark.parametrize("end", ["", "head -c 2000 $file; ", "cat $file; exec >&-; "])
def test_a_library_that_hangs_is_ended(glasses, monkeypatch, end):
    monkeypatch.setattr("slamhive.recordings.importers.outside._MOST_SILENCE_S", 0.2)
    (glasses.parent / "replay").write_text(f'#!/bin/sh\nfile="$(dirname "$0")/$4"\n{end}exec sleep 600\n')
    with pytest.raises(InvalidInput, match=r"aria hangs while it reads walk.vrs: it gave nothing for 0.2 s, and was"):
        plan(glasses)


def test_a_reader_that_works_gives_signs_of_life(monkeypatch):
    out = io.BytesIO()
    monkeypatch.setattr(outside_reader, "SIGN_EVERY_S", 0.0)
    assert list(watched(range(3), "plan", out)) == [0, 1, 2]
    monkeypatch.setattr(outside_reader, "SIGN_EVERY_S", 1e9)
    assert list(watched(range(3), "plan", out)) == [0, 1, 2]
    assert out.getvalue() == b"\n\n\n"


def test_a_correction_of_measurements_is_found_from_four_points():
    matrix, bias = np.array([[1.1, 0.2, 0], [0, 0.9, 0.1], [0, 0, 1.05]]), np.array([0.1, -0.2, 0.3])
    rows = np.random.default_rng(2).normal(size=(20, 3))
    corrected = rectified(rows, lambda raw: np.linalg.inv(matrix) @ (raw - bias))
    assert corrected @ matrix.T + bias == pytest.approx(rows)
