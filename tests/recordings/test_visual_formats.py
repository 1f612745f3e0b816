"""Import of visual folders and videos: what arrives, what is said, every mistake in one line; 7-Scenes as recorded."""

import cv2
import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.recordings.frame_files import read_image
from slamhive.recordings.importers.registry import detect_format
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.pose_file import read_times
from tests.recordings.format_world import (
    EUROC_START_NS,
    FORMATS,
    KITTI_360,
    SHARED,
    colour,
    convert,
    cut,
    depth,
    draw,
    options_of,
    plan,
    recorded,
    remove,
    rewrite,
    write,
)

pytestmark = pytest.mark.quick


def made(name, tmp_path):
    """The dataset of a small folder, its messages and its ground truth."""
    source = FORMATS[name](tmp_path / "source")
    dataset = convert(source, tmp_path / "made", name, **options_of(name, source))
    return dataset, recorded(dataset), read_tum(dataset.folder / "groundtruth.txt")


def pixels(message, kind, shape):
    return message.data.view(kind).reshape(shape)


def test_7_scenes_marks_unknown_depth_with_0(tmp_path):
    dataset, seen, truth = made("7-scenes", tmp_path)
    expected = depth(1)
    expected[0, 0] = 0
    assert np.array_equal(pixels(seen["/depth0/image_raw"][1], np.uint16, expected.shape), expected)
    assert np.array_equal(pixels(seen["/cam0/image_raw"][1], np.uint8, colour(1).shape), colour(1))
    assert dataset.sensor("depth0").calibration["units_per_m"] == 1000.0
    assert truth.stamps_s.tolist() == pytest.approx([0, 1 / 30, 2 / 30, 3 / 30])
    assert truth.positions_m[2].tolist() == [2, 2, 3]


@pytest.mark.parametrize("option", ["frame_rate_hz", "depth_units_per_m"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_or_scale_that_is_none_is_refused(tmp_path, option, value):
    source = FORMATS["7-scenes"](tmp_path)
    with pytest.raises(InvalidInput, match=r"a (frame rate|depth scale) of .* makes no sense; give a number above 0"):
        plan(source, "7-scenes", **{option: value})


def test_7_scenes_leaves_out_unknown_poses_and_says_so(tmp_path):
    source = FORMATS["7-scenes"](tmp_path / "seq-01")
    write(source / "frame-000002.pose.txt", *(["-inf -inf -inf -inf"] * 4))
    notes = plan(source, frame_rate_hz=10.0, **options_of("7-scenes", source)).notes
    assert notes[0] == "timestamps are nominal: 10 frames per second (--frame-rate)"
    assert notes[2] == "1 of 4 poses are not rigid and left out"


def test_eth3d_is_no_tum_rgbd_because_it_brings_its_calibration(tmp_path):
    dataset, seen, truth = made("eth3d", tmp_path)
    assert detect_format(tmp_path / "source") == "eth3d"
    assert dataset.sensor("cam0").calibration["fy"] == 20.25
    assert dataset.sensor("depth0").calibration["units_per_m"] == 5000.0
    assert len(truth) == 14
    assert len(seen["/cam0/camera_info"]) == len(seen["/depth0/image_raw"]) == 4
    stamps_s = [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in seen["/cam0/camera_info"]]
    assert read_times(dataset.folder / dataset.groundtruth.image_times).tolist() == pytest.approx(stamps_s, abs=1e-6)


@pytest.mark.integration
def test_tartanair_turns_optical_frames_into_the_frame_of_its_poses(tmp_path):
    dataset, seen, truth = made("tartanair", tmp_path)
    left, right = (np.array(dataset.sensor(name).T_body_sensor).reshape(4, 4) for name in ("cam0", "cam1"))
    assert (left[:3, :3] @ [0, 0, 1]).tolist() == [1, 0, 0]  # forward of the camera is x of NED
    assert (left[:3, :3] @ [0, 1, 0]).tolist() == [0, 0, 1]  # down is z
    assert right[:3, 3].tolist() == [0, 0.25, 0]  # the right camera sits to the right, y
    far = seen["/depth0/image_raw"][1]
    assert far.encoding == "32FC1"
    assert pixels(far, np.float32, (480, 640))[7, 7] == 3.5
    assert dataset.sensor("depth0").calibration["units_per_m"] == 1.0
    assert truth.quats_xyzw[1] == pytest.approx([0, 0, 0.6, 0.8])
    assert seen["/cam1/camera_info"][0].P[3] == -80.0


def test_replica_has_its_camera_beside_the_scenes(tmp_path):
    dataset, _, truth = made("replica", tmp_path)
    assert dataset.sensor("cam0").calibration["fx"] == 20.5
    assert dataset.sensor("depth0").calibration["units_per_m"] == 6553.5
    assert truth.positions_m[3].tolist() == [3, 2, 3]


def test_openloris_follows_the_chain_of_transforms_and_merges_the_imu(tmp_path):
    dataset, seen, _ = made("openloris", tmp_path)
    camera, imu = dataset.sensor("cam0"), dataset.sensor("imu0")
    assert (camera.calibration["cx"], camera.calibration["fy"]) == (15.5, 20.25)  # they come as fx cx fy cy
    assert (camera.T_body_sensor[3], imu.T_body_sensor[3]) == (0.5, 0.75)
    assert imu.T_body_sensor[7] == 4.0
    first = seen["/imu0"][0]  # 4 ms after the first acceleration, of 5 ms to the next
    assert first.angular_velocity.x == 1.0
    assert first.linear_acceleration.x == pytest.approx(0.8, abs=1e-4)


def test_vslam_lab_has_cameras_depth_and_imu(tmp_path):
    dataset, seen, truth = made("vslam-lab", tmp_path)
    assert [sensor.name for sensor in dataset.sensors] == ["cam0", "cam1", "depth0", "imu0"]
    assert dataset.sensor("cam0").calibration["model"] == "pinhole-radtan"
    assert dataset.sensor("cam1").calibration["encoding"] == "bgr8"
    assert dataset.sensor("cam1").T_body_sensor[3] == 0.1
    assert dataset.sensor("imu0").calibration == {
        "gyroscope_noise_density": 0.001,
        "accelerometer_noise_density": 0.02,
    }
    stamp = seen["/cam1/image_raw"][1].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == EUROC_START_NS + 50_000_000
    assert truth.quats_xyzw[3] == pytest.approx([0, 0, 0.6, 0.8])


def test_kitti_raw_gives_imu_gnss_and_poses_by_mercators_projection(tmp_path):
    dataset, seen, truth = made("kitti-raw", tmp_path)
    assert [sensor.name for sensor in dataset.sensors] == ["cam0", "cam2", "lidar0", "imu0", "gnss0"]
    lidar = np.array(dataset.sensor("lidar0").T_body_sensor).reshape(4, 4)
    assert lidar[:3, 3] == pytest.approx([0.8, -0.3, 0.8])
    cam2 = np.array(dataset.sensor("cam2").T_body_sensor).reshape(4, 4)
    cam0 = np.array(dataset.sensor("cam0").T_body_sensor).reshape(4, 4)
    assert (np.linalg.inv(cam0) @ cam2)[:3, 3] == pytest.approx([1, 0, 0])
    assert (seen["/imu0"][1].linear_acceleration.z, seen["/imu0"][1].angular_velocity.y) == (9.8, 0.02)
    assert (seen["/gnss0"][2].latitude, seen["/gnss0"][2].altitude) == (49.0 + 2e-5, 114.0)
    assert truth.positions_m[1] == pytest.approx([0, 6378137 * np.radians(1e-5), 1], rel=1e-4)
    assert truth.quats_xyzw[1] == pytest.approx([0, 0, np.sin(0.25), np.cos(0.25)])
    stamp = seen["/cam2/image_raw"][1].header.stamp
    assert (stamp.sec, stamp.nanosec) == (1317042145, 200_123_456)


def test_kitti_raw_says_which_scans_are_missing(tmp_path):
    drive = FORMATS["kitti-raw"](tmp_path)
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    found = plan(drive, accept_loss=True)
    assert found.counts["lidar0"] == 3
    assert "1 of the 4 files of velodyne_points are missing and left out" in found.notes


def test_kitti_360_has_the_transforms_of_its_own_scripts(tmp_path):
    """The numbers are those of ``kitti360scripts`` 1.0.0 on the same files: ``cam2world[1]``, and LiDAR to pose."""
    dataset, seen, truth = made("kitti-360", tmp_path)
    assert [sensor.name for sensor in dataset.sensors] == ["cam0", "cam1", "lidar0", "imu0", "gnss0"]
    extrinsics = {sensor.name: np.array(sensor.T_body_sensor).reshape(4, 4) for sensor in dataset.sensors}
    T_world_body = np.eye(4)
    T_world_body[:3, :3] = np.diag([1, -1, -1])
    T_world_body[:3, 3] = truth.positions_m[0]
    assert (T_world_body @ extrinsics["cam0"])[:3] == pytest.approx(np.array([
        [-1.98984246e-02, 9.99987500e-02, 9.94788572e-01, 1.00250000e03],
        [-9.99800007e-01, 0, -1.99986667e-02, 3.00170000e03],
        [-1.99984167e-03, -9.94987563e-01, 9.99787509e-02, 1.17700000e02],
    ]), abs=1e-9, rel=1e-8)  # fmt: skip
    assert (T_world_body @ extrinsics["cam1"])[:3] == pytest.approx(np.array([
        [1.98984246e-02, 9.99987500e-02, 9.94788572e-01, 1.00250000e03],
        [-9.99800007e-01, 0, 1.99986667e-02, 3.00110000e03],
        [1.99984167e-03, -9.94987563e-01, 9.99787509e-02, 1.17700000e02],
    ]), abs=1e-9, rel=1e-8)  # fmt: skip
    assert extrinsics["lidar0"][:3] == pytest.approx(np.array([
        [0.99498756, 0, -0.09999875, 0.66401045],
        [0, -1, 0, 0.6],
        [-0.09999875, 0, -0.99498756, -1.01799603],
    ]), abs=1e-8)  # fmt: skip
    stamp = seen["/cam1/image_raw"][2].header.stamp
    assert (stamp.sec, stamp.nanosec) == (1369730762, 204_381_184)
    assert truth.stamps_s[0] == pytest.approx(1369730762.104381184)
    # At rest, gravity is measured upwards, which is along minus z of the body.
    force = seen["/imu0"][0].linear_acceleration
    assert extrinsics["imu0"][:3, :3] @ [force.x, force.y, force.z] == pytest.approx([0.1, -0.2, -9.8])


def test_a_sequence_of_kitti_360_is_named_where_there_are_several(tmp_path):
    root = FORMATS["kitti-360"](tmp_path)
    write(root / "data_poses/2013_05_28_drive_0002_sync/poses.txt", "1 1 0 0 0 0 1 0 0 0 0 1 0")
    with pytest.raises(InvalidInput, match=r"has 2 sequences .* --sequence: 2013_05_28_drive_0000_sync, 2013"):
        plan(root)
    with pytest.raises(InvalidInput, match=r"none called '7'"):
        plan(root, sequence="7")
    with pytest.raises(InvalidInput, match=r"image_00/timestamps\.txt is missing|no recording of"):
        plan(root, sequence="2013_05_28_drive_0002_sync")
    assert plan(root, sequence="2013_05_28_drive_0000_sync").counts["cam0"] == 4


def test_a_video_has_the_timestamps_of_its_container(tmp_path):
    _, seen, truth = made("video", tmp_path)
    stamps = [message.header.stamp.nanosec for message in seen["/cam0/image_raw"]]
    assert stamps == [0, 100_000_000, 200_000_000, 300_000_000]
    shades = [int(pixels(message, np.uint8, (24, 32, 3))[12, 16].mean()) for message in seen["/cam0/image_raw"]]
    assert shades == pytest.approx([0, 40, 80, 120], abs=4)
    assert truth.positions_m[2].tolist() == [2, 2, 3]


@pytest.mark.parametrize(
    ("name", "damage", "problem"),
    [
        ("7-scenes", remove("frame-000001.depth.png"), None),
        ("7-scenes", cut("frame-000001.depth.png", 100), "depth.png is truncated"),
        ("7-scenes", lambda s: write(s / "frame-000001.pose.txt", "1 0 0 0"), "has 1 rows; expected a 4x4"),
        ("7-scenes", lambda s: draw(s / "frame-1.color.png", colour(1)), "have the same number"),
        ("eth3d", rewrite("calibration.txt", " 11.5", ""), r"calibration\.txt, line 1: 3 columns instead of 4"),
        ("eth3d", rewrite("calibration.txt", "20.5", "0"), r"0 20\.25 15\.5 11\.5 are no intrinsics"),
        ("tartanair", rewrite("pose_left.txt", "0.6 0.8", "0.6 0.9"), "line 1: quaternion has norm"),
        ("tartanair", rewrite("pose_left.txt", r".*\n", ""), "poses, there are . images"),
        ("tartanair", cut("depth_left/000001_left_depth.npy", 500), "npy cannot be read"),
        ("replica", rewrite("../cam_params.json", '"fx": 20.5, ', ""), "lacks fx"),
        ("replica", rewrite("traj.txt", "1 0 0 0", "2 0 0 0"), "line 1: no rigid transform"),
        ("replica", cut("results/frame000002.jpg", 400), "frame000002.jpg is truncated: it ends after 400 bytes"),
        (
            "openloris",
            rewrite("trans_matrix.yaml", "parent_frame: base_link", "parent_frame: map"),
            "no chain of trans",
        ),
        ("openloris", rewrite("sensors.yaml", "d400_color", "d500_color"), "lacks d400_color_optical_frame"),
        ("openloris", remove("trans_matrix.yaml"), r"trans_matrix\.yaml does not exist"),
        ("vslam-lab", rewrite("rgb.csv", "path_rgb_1", "path"), "lacks the columns of rgb_1"),
        ("vslam-lab", rewrite("calibration.yaml", "radtan4", "fov1"), "distortion type fov1 is unknown"),
        ("vslam-lab", rewrite("imu_0.csv", ",9.81\n", "\n"), r"imu_0\.csv, line 2: 6 columns, not 7"),
        ("vslam-lab", rewrite("groundtruth.csv", "0.6,0.8", "0.6,0"), r"groundtruth\.csv, line 2: quaternion has norm"),
        ("kitti-raw", rewrite("oxts/timestamps.txt", "2011-09-26", "2011-19-26"), "line 1: .* is no time"),
        ("kitti-raw", rewrite("oxts/timestamps.txt", r"25\.1", "26.1"), "line 2: the timestamp is not after"),
        ("kitti-raw", rewrite("oxts/data/0000000001.txt", "49.0", "95.0"), "its numbers make no sense"),
        ("kitti-raw", rewrite("../calib_imu_to_velo.txt", "R: 1", "R: 2"), r"calib_imu_to_velo\.txt: R is no rotation"),
        ("kitti-raw", rewrite("../calib_cam_to_cam.txt", "P_rect_02", "P"), r"calib_cam_to_cam\.txt lacks P_rect_02"),
        ("kitti-raw", rewrite("../calib_velo_to_cam.txt", "T: 0 ", "T: "), r"T has 2 numbers; expected 3"),
        (
            "kitti-360",
            rewrite("calibration/perspective.txt", "R_rect_01: ", "R_rect_01: 2"),
            "R_rect_01 makes no sense",
        ),
        ("kitti-360", rewrite("calibration/calib_cam_to_velo.txt", "0.8", "0.8 1"), "13 columns"),
        ("kitti-360", rewrite("calibration/calib_cam_to_pose.txt", "image_00", "image"), "lacks image_00"),
        ("kitti-360", rewrite(f"data_poses/{KITTI_360}/poses.txt", "3 1 0 0", "9 1 0 0"), "frame 9 has no timestamp"),
        (
            "kitti-360",
            rewrite(f"data_poses/{KITTI_360}/poses.txt", "3 1 0 0", "3 2 0 0"),
            "frame 3 is no rigid transform",
        ),
        ("kitti-360", rewrite(f"data_poses/{KITTI_360}/poses.txt", "3 1 0 0", "2 1 0 0"), "frames do not increase"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(tmp_path, name, damage, problem):
    source = FORMATS[name](tmp_path / "source")
    options = options_of(name, source)
    damage(source)
    data = tmp_path / "data"
    if problem is None:
        assert plan(source, name, **options).counts == {"cam0": 4, "depth0": 3}
        return
    with pytest.raises(InvalidInput, match=problem) as caught:
        convert(source, data / "made", name, **options)
    assert "\n" not in str(caught.value)
    assert not data.exists() or list(data.iterdir()) == []


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda path: {"calibration": ()}, "does not say what its camera is; give intrinsics with --calibration"),
        (lambda path: path.write_bytes(b"RIFF") and {}, "cannot be read as a video"),
        (
            lambda path: path.with_name("camera.yaml").write_text("a: 1") and {},
            "is no calibration that is read",
        ),
        (lambda path: rewrite("camera.yaml", "width: 32", "width: 64")(path.parent), r"avi is 32x24 .* says 64x24"),
        (lambda path: write(path.with_name("truth.txt"), "1000 0 0 0 0 0 0 1"), "the clocks do not meet"),
    ],
)
def test_a_bad_video_is_one_clear_line(tmp_path, damage, problem):
    path = FORMATS["video"](tmp_path)
    options = options_of("video", path)
    changed = damage(path)
    with pytest.raises(InvalidInput, match=problem):
        plan(path, "video", **{**options, **(changed or {})})


@pytest.mark.parametrize(("ending", "encoding"), [(".pgm", "mono8"), (".ppm", "bgr8"), (".jpg", "bgr8")])
def test_other_kinds_of_images_are_read_and_checked(tmp_path, ending, encoding):
    path = tmp_path / f"frame{ending}"
    expected = colour(1) if encoding == "bgr8" else colour(1)[:, :, 0]
    draw(path, expected)
    decoded = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    assert np.array_equal(read_image(path, encoding), decoded)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InvalidInput, match="is truncated"):
        read_image(path, encoding)


@pytest.mark.integration
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
def test_7_scenes_as_recorded(tmp_path):
    source = SHARED / "sevenscenes_rgbd_90"
    assert detect_format(source) == "7-scenes"
    dataset = convert(source, tmp_path / "made")
    assert plan(source).counts == {"cam0": 90, "depth0": 90}
    ours, theirs = (read_tum(path) for path in (dataset.folder / "groundtruth.txt", next(source.glob("*30Hz.txt"))))
    assert np.allclose(ours.stamps_s, theirs.stamps_s, atol=1e-5)
    assert np.allclose(ours.positions_m, theirs.positions_m, atol=1e-5)
    assert np.allclose(np.abs(np.sum(ours.quats_xyzw * theirs.quats_xyzw, axis=1)), 1, atol=1e-5)
