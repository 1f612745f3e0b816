"""EuRoC import: the ASL layout, TUM-VI's variant of it, every way to break it, and V1_01 where it is."""

import json
import shutil

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.recordings.importers.registry import detect_format
from slamhive.trajectory.layout import read_tum
from tests.recordings.format_world import (
    EUROC_START_NS,
    FRAMES,
    SHARED,
    convert,
    cut,
    depth,
    draw,
    grey,
    make_euroc,
    plan,
    recorded,
    remove,
    rewrite,
    write,
)

pytestmark = pytest.mark.quick
TRUTH = "mav0/state_groundtruth_estimate0"


@pytest.fixture
def source(tmp_path):
    return make_euroc(tmp_path / "V9_09")


def truth_of(dataset):
    return read_tum(dataset.folder / "groundtruth.txt")


def test_images_samples_and_poses_arrive_unchanged(source, tmp_path):
    dataset = convert(source, tmp_path / "v9")
    seen = recorded(dataset)
    assert [sensor.name for sensor in dataset.sensors] == ["cam0", "cam1", "imu0"]
    image = seen["/cam1/image_raw"][2]
    assert np.array_equal(image.data.reshape(grey(12).shape), grey(12))
    assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == EUROC_START_NS + 100_000_000
    assert seen["/cam0/camera_info"][0].distortion_model == "plumb_bob"
    assert seen["/imu0"][3].angular_velocity.x == 0.3
    assert seen["/imu0"][3].linear_acceleration.z == 9.81
    cam1, imu0 = dataset.sensor("cam1"), dataset.sensor("imu0")
    assert cam1.T_body_sensor[:8] == (0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.1)
    assert cam1.calibration["model"] == "pinhole-radtan"
    assert imu0.calibration == {"gyroscope_noise_density": 1.6968e-04, "accelerometer_noise_density": 2e-3}
    truth = truth_of(dataset)
    assert truth.quats_xyzw[5] == pytest.approx([0.8, 0, 0, 0.6])
    assert truth.positions_m[5].tolist() == [5, 2, 3]
    assert dataset.title == "EuRoC, V9_09"


def test_the_folder_mav0_itself_is_accepted(source):
    assert detect_format(source / "mav0") == "euroc"
    assert plan(source / "mav0").text.title == "EuRoC, V9_09"


def test_tum_vi_has_fisheye_cameras_16_bit_images_and_poses_of_the_imu(tmp_path):
    source = make_euroc(tmp_path / "room9", distortion_model="equidistant")
    (source / TRUTH).rename(source / "mav0/mocap0")
    draw(source / f"mav0/cam0/data/{EUROC_START_NS}.png", depth(1))
    dataset = convert(source, tmp_path / "room9_made")
    assert dataset.sensor("cam0").calibration["model"] == "fisheye-kb"
    assert recorded(dataset)["/cam0/camera_info"][0].distortion_model == "equidistant"
    assert dataset.title == "TUM VI, room9"
    assert truth_of(dataset).positions_m[5].tolist() == [5, 2, 3]
    assert "mocap0 has no sensor.yaml" in plan(source).notes[0]


def test_poses_of_markers_become_those_of_the_body(source, tmp_path):
    (source / TRUTH).rename(source / "mav0/vicon0")
    write(source / "mav0/vicon0/sensor.yaml", "T_BS: {rows: 4, cols: 4, data: [1,0,0,0.5, 0,1,0,0, 0,0,1,0, 0,0,0,1]}")
    truth = truth_of(convert(source, tmp_path / "v9"))
    assert truth.positions_m[5] == pytest.approx([4.5, 2, 3])
    assert truth.quats_xyzw[5] == pytest.approx([0.8, 0, 0, 0.6])


def test_time_offsets_are_kept_and_unread_keys_named(source):
    for path, line in (
        ("cam0", "timeshift_cam_imu: 0.005"),
        ("cam1", "line_delay: 3.0e-5"),
        ("imu0", "misalignment: 1"),
    ):
        with (source / "mav0" / path / "sensor.yaml").open("a") as file:
            file.write(f"\n{line}\n")
    found = plan(source)
    assert found.sensors[0].calibration["time_offset_s"] == 0.005
    assert "time_offset_s" not in found.sensors[1].calibration
    assert found.notes[:2] == (
        "line_delay of cam1/sensor.yaml is not read",
        "misalignment of imu0/sensor.yaml is not read",
    )
    assert found.notes[2].startswith("cam0 needs 0.005 s added to its timestamps")


def test_a_prism_gives_positions_only(source, tmp_path):
    shutil.rmtree(source / TRUTH)
    write(source / "mav0/leica0/data.csv", "#t", *(f"{EUROC_START_NS + n * 50_000_000},{n},2,3" for n in range(FRAMES)))
    write(source / "mav0/leica0/sensor.yaml", "T_BS: {data: [1,0,0,0.3, 0,1,0,0.4, 0,0,1,0, 0,0,0,1]}")
    dataset = convert(source, tmp_path / "mh9")
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.positions_only
    assert dataset.groundtruth.source == "laser tracker (Leica MS50)"
    assert dataset.groundtruth.lever_arm_m == (0.3, 0.4, 0.0)
    assert plan(source).notes == (
        "ground truth is the positions of a prism, 0.500 m from the body (lever_arm_m)",
        "the ground truth has positions only: runs get no rotation errors",
    )


def test_the_authors_estimate_is_chosen_and_two_measurements_are_refused(source):
    for name in ("leica0", "vicon0"):
        shutil.copytree(source / TRUTH, source / "mav0" / name)
    assert plan(source).notes == ("ground truth is state_groundtruth_estimate0; vicon0, leica0 is left out",)
    shutil.rmtree(source / TRUTH)
    with pytest.raises(InvalidInput, match=r"several ground truths: vicon0, leica0; .*--groundtruth"):
        plan(source)
    write(source / "mine.txt", *(f"{EUROC_START_NS / 1e9 + n} 0 0 0 0 0 0 1" for n in range(2)))
    assert (
        "mine.txt; vicon0, leica0 of the folder is left out" in plan(source, groundtruth=source / "mine.txt").notes[0]
    )


def basalt(**changed):
    pose = {"px": 0.1, "py": -0.05, "pz": 0.02, "qx": 0.0, "qy": 0.0, "qz": 0.6, "qw": 0.8}
    fisheye = {"fx": 20.5, "fy": 20.25, "cx": 15.5, "cy": 11.5, "k1": 0.3, "k2": 0.1, "k3": -0.2, "k4": 0.05}
    whole = {
        "T_imu_cam": [pose, {**pose, "py": 0.08}],
        "intrinsics": [{"camera_type": "kb4", "intrinsics": fisheye}] * 2,
        "resolution": [[32, 24]] * 2,
        "calib_accel_bias": [0.1] + [0.0] * 8,
        "calib_gyro_bias": [0.0] * 12,
        "imu_update_rate": 1000.0,
        "accel_noise_std": [0.016] * 3,
        "gyro_noise_std": [0.000282] * 3,
        "accel_bias_std": [0.001] * 3,
        "gyro_bias_std": [0.0001] * 3,
        "cam_time_offset_ns": 2_000_000,
    }
    return json.dumps({"value0": {**whole, **changed}})


@pytest.fixture
def monado(tmp_path):
    """A folder as the Monado SLAM datasets have them: no ``sensor.yaml``, poses in ``gt``."""
    folder = make_euroc(tmp_path / "MIO01")
    for path in folder.glob("mav0/*/sensor.yaml"):
        path.unlink()
    (folder / "mav0/state_groundtruth_estimate0").rename(folder / "mav0/gt")
    rows = [line.split(",")[:8] for line in (folder / "mav0/gt/data.csv").read_text().splitlines()[1:]]
    (folder / "mav0/gt/data.csv").write_text("#timestamp\n" + "".join(",".join(row) + "\n" for row in rows))
    (folder / "calibration.json").write_text(basalt())
    return folder


def test_one_calibration_of_basalt_replaces_those_of_the_parts(monado, tmp_path):
    found = plan(monado)
    assert "gt has no sensor.yaml: its poses are taken as those of the IMU" in found.notes
    assert "calib_accel_bias of calibration.json is not read" in found.notes
    dataset = convert(monado, tmp_path / "made")
    cam1, imu = dataset.sensor("cam1"), dataset.sensor("imu0")
    assert np.array(cam1.T_body_sensor).reshape(4, 4) == pytest.approx(
        np.array([[0.28, -0.96, 0, 0.1], [0.96, 0.28, 0, 0.08], [0, 0, 1, 0.02], [0, 0, 0, 1]])
    )
    assert (cam1.calibration["model"], cam1.calibration["distortion"], cam1.calibration["time_offset_s"]) == (
        "fisheye-kb", (0.3, 0.1, -0.2, 0.05), 0.002
    )  # fmt: skip
    assert imu.calibration["accelerometer_noise_density"] == pytest.approx(0.016)
    assert dataset.title == "Monado SLAM, MIO01"
    assert truth_of(dataset).stamps_s.size == 31


def test_the_calibration_of_the_user_counts_most(monado, tmp_path):
    given = tmp_path / "mine.json"
    given.write_text(basalt(cam_time_offset_ns=0))
    assert "time_offset_s" not in plan(monado, calibration=(given,)).sensors[0].calibration


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"resolution": [[32, 24]]}, "no lists of one length"),
        ({"intrinsics": [{"camera_type": "ucm"}] * 2}, "camera_type ucm is not read; known: pinhole, kb4, ds"),
        ({"T_imu_cam": [{"px": 0, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 2}] * 2}, "quaternion has norm 2"),
        ({"cam_time_offset_ns": 2e10}, "cam_time_offset_ns is 20 s"),
        ({"accel_noise_std": "low"}, "accel_noise_std is 'low', no numbers"),
    ],
)
def test_a_mistake_in_basalts_calibration_is_one_clear_line(monado, changed, problem):
    (monado / "calibration.json").write_text(basalt(**changed))
    with pytest.raises(InvalidInput, match=problem):
        plan(monado)


def test_without_any_calibration_the_first_part_that_lacks_it_is_named(monado):
    (monado / "calibration.json").unlink()
    with pytest.raises(InvalidInput, match=r"cam0/sensor\.yaml does not exist"):
        plan(monado)


def test_what_is_left_out_is_said(source, tmp_path):
    remove(f"mav0/cam0/data/{EUROC_START_NS}.png")(source)
    path = source / "mav0/imu0/data.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[-1]]))
    poses = source / TRUTH / "data.csv"
    poses.write_text("\n".join(poses.read_text().splitlines()[13:]))
    with pytest.raises(InvalidInput, match=r"1 of the 4 files .*; 1 rows of .*: up to 25% is lost; .*--accept-loss"):
        plan(source)
    found = plan(source, accept_loss=True)
    assert found.notes == (
        "1 of the 4 files that data.csv lists are missing and left out",
        "1 rows of data.csv repeat a timestamp and are left out",
        "1 of 3 messages of cam0 are before or after the ground truth",
    )
    assert found.counts == {"cam0": 3, "cam1": 4, "imu0": 31}
    shutil.rmtree(source / TRUTH)
    assert plan(source, accept_loss=True).notes[-1] == (
        "there is no ground truth: runs get no ATE (--groundtruth FILE adds one)"
    )


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (remove("mav0/cam0/sensor.yaml"), r"cam0/sensor\.yaml does not exist"),
        (remove("mav0/cam0/data.csv"), r"cam0/data\.csv does not exist"),
        (rewrite("mav0/cam0/sensor.yaml", "intrinsics.*", ""), r"sensor\.yaml lacks intrinsics"),
        (rewrite("mav0/cam0/sensor.yaml", "20.5, ", ""), r"intrinsics has 3 numbers; expected 4"),
        (rewrite("mav0/cam0/sensor.yaml", "20.5", "-1"), r"focal lengths are -1"),
        (rewrite("mav0/cam0/sensor.yaml", "radial-tangential", "fov"), "pinhole with fov is unknown"),
        (rewrite("mav0/cam0/sensor.yaml", "0, -1, 0", "0, -2, 0"), "T_BS is no rigid transform"),
        (rewrite("mav0/cam0/sensor.yaml", r"\[32, 24\]", "[64, 24]"), "is 32x24 pixels, the calibration.*says 64x24"),
        (rewrite("mav0/cam0/sensor.yaml", "T_BS:", "T_BS: ["), r"sensor\.yaml"),
        (rewrite("mav0/imu0/data.csv", ",9.81", ""), r"imu0/data\.csv, line 2: 6 columns, not 7"),
        (rewrite("mav0/imu0/data.csv", "9.81", "down"), r"imu0/data\.csv, line 2: 'down' is not a number"),
        (rewrite("mav0/imu0/data.csv", "9.81", "nan"), r"imu0/data\.csv, line 2: 'nan' is not finite"),
        (
            rewrite("mav0/imu0/data.csv", r"\n14037152743", r"\n15037152743"),
            r"line 3: timestamp 1403.* comes after 1503",
        ),
        (rewrite("mav0/imu0/data.csv", r"\n14", r"\n-14"), r"line 2: timestamp -14.*out of range"),
        (rewrite("mav0/cam1/data.csv", r",14", ",../14"), "'../1403715274312143104.png' is no file in the folder"),
        (cut(f"mav0/cam1/data/{EUROC_START_NS}.png", 200), "png is truncated: it ends after 200 bytes"),
        (cut(f"mav0/cam1/data/{EUROC_START_NS + 150_000_000}.png", 0), "png is empty"),
        (lambda s: shutil.rmtree(s / "mav0/cam1/data"), "none of the 4 files that .* lists exists"),
        (rewrite(f"{TRUTH}/data.csv", "0.6,0.8", "0.6,0.9"), r"line 2: quaternion has norm 1\.08"),
        (lambda s: write(s / TRUTH / "data.csv", *(f"{n},0,0,0,1,0,0,0" for n in (1, 2))), "the clocks do not meet"),
        (lambda s: write(s / TRUTH / "data.csv", "#nothing"), "has no rows"),
        (lambda s: write(s / "mav0/imu0/data.csv", f"{EUROC_START_NS},0,0,0,0,0,0"), "make no recording"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(source, tmp_path, damage, problem):
    damage(source)
    data = tmp_path / "data"
    with pytest.raises(InvalidInput, match=problem) as caught:
        convert(source, data / "v9", "euroc")
    assert "\n" not in str(caught.value)
    assert not data.exists() or list(data.iterdir()) == []


@pytest.mark.integration
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
def test_v1_01_as_recorded(tmp_path):
    source = SHARED / "euroc_v101_static"
    assert detect_format(source) == "euroc"
    dataset = convert(source, tmp_path / "v101", groundtruth=source / "groundtruth_tum.txt")
    found = plan(source, groundtruth=source / "groundtruth_tum.txt")
    assert found.counts == {"cam0": 10, "cam1": 10, "imu0": 29120}
    assert dataset.duration_s == pytest.approx(145.595)
    left, right = (np.array(dataset.sensor(name).T_body_sensor).reshape(4, 4) for name in ("cam0", "cam1"))
    assert np.linalg.norm((np.linalg.inv(left) @ right)[:3, 3]) == pytest.approx(0.11, abs=1e-3)
    force_mps2 = [np.array([m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z])
                  for m in recorded(dataset)["/imu0"][:100]]  # fmt: skip
    assert np.linalg.norm(np.mean(force_mps2, axis=0)) == pytest.approx(9.8, abs=0.1)
