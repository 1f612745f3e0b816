"""TUM RGB-D import: its own folders, those of Bonn and ICL-NUIM, and every way to break them."""

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.recordings.importers.registry import detect_format
from slamhive.trajectory.layout import read_tum
from tests.recordings.format_world import (
    FRAMES,
    TUM_START_S,
    colour,
    convert,
    depth,
    draw,
    grey,
    make_tum_rgbd,
    plan,
    recorded,
    remove,
    rewrite,
    tum_pose,
    with_calibration,
    write,
)

pytestmark = pytest.mark.quick
LARGE = np.zeros((480, 640, 3), dtype=np.uint8)


@pytest.fixture
def source(tmp_path):
    return make_tum_rgbd(tmp_path / "rgbd_dataset_freiburg9_xyz")


def make_large(source):
    """Replace the images by ones of the size that the published intrinsics are for."""
    for folder, pixels in (("rgb", LARGE), ("depth", LARGE[:, :, 0].astype(np.uint16))):
        for path in (source / folder).iterdir():
            draw(path, pixels)


def make_depth_shallow(source):
    for path in (source / "depth").iterdir():
        draw(path, grey(1))


def test_images_keep_their_own_timestamps_and_pixels(source, tmp_path):
    dataset = convert(source, tmp_path / "fr9", **with_calibration(source))
    seen = recorded(dataset)
    image, far = seen["/cam0/image_raw"][2], seen["/depth0/image_raw"][2]
    assert (image.encoding, far.encoding) == ("bgr8", "16UC1")
    assert np.array_equal(image.data.reshape(colour(2).shape), colour(2))
    assert np.array_equal(far.data.view(np.uint16).reshape(depth(2).shape), depth(2))
    first = seen["/cam0/image_raw"][0].header.stamp
    assert f"{first.sec}.{first.nanosec:09d}" == f"{TUM_START_S:.6f}000"
    assert far.header.stamp.nanosec - image.header.stamp.nanosec == 10_000_000
    depth0 = dataset.sensor("depth0").calibration
    assert (depth0["units_per_m"], depth0["registered_to"], depth0["fx"]) == (5000.0, "cam0", 20.5)
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.positions_m[4].tolist() == [4, 2, 3]
    assert truth.quats_xyzw[4] == pytest.approx([0, 0, 0.6, 0.8])


@pytest.mark.parametrize(
    ("name", "fx", "title", "gravity_aligned"),
    [
        ("rgbd_dataset_freiburg1_xyz", 517.3, "TUM RGB-D", True),
        ("rgbd_dataset_freiburg2_desk", 520.9, "TUM RGB-D", True),
        ("rgbd_dataset_freiburg3_office", 535.4, "TUM RGB-D", True),
        ("rgbd_bonn_balloon", 542.822841, "Bonn RGB-D Dynamic", False),
        ("my_own_kinect", 525.0, "TUM RGB-D", False),
    ],
)
def test_intrinsics_follow_from_the_name(tmp_path, name, fx, title, gravity_aligned):
    source = make_tum_rgbd(tmp_path / name)
    make_large(source)
    found = plan(source, depth_units_per_m=1000.0)
    camera, far = found.sensors
    assert (camera.calibration["fx"], far.calibration["units_per_m"]) == (fx, 1000.0)
    assert found.text.title == f"{title}, {name}"
    assert found.truth is not None
    assert found.truth.gravity_aligned is gravity_aligned
    assert ("ROS's default" in found.notes[0]) == (name == "my_own_kinect")


def test_icl_nuim_numbers_its_frames_and_has_a_negative_fy(tmp_path):
    source = make_tum_rgbd(tmp_path / "living_room_traj9")
    make_large(source)
    files = [sorted((source / kind).iterdir()) for kind in ("depth", "rgb")]
    names = [[f"{path.parent.name}/{path.name}" for path in paths] for paths in files]
    pairs = [f"{n} {far} {n} {near}" for n, (far, near) in enumerate(zip(*names, strict=True))]
    write(source / "associations.txt", *pairs)
    write(source / "livingRoom9.gt.freiburg", *(f"{n} {n} 0 -2.25 0 0 0 1" for n in range(1, FRAMES)))
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (source / name).unlink()
    assert detect_format(source) == "tum-rgbd"
    found = plan(source)
    assert found.sensors[0].calibration["fy"] == -480.0
    assert found.sensors[0].rate_hz == pytest.approx(30)
    assert found.truth is not None
    assert found.truth.times_s.tolist() == pytest.approx([1 / 30, 2 / 30, 3 / 30])
    assert "timestamps are nominal: 30 frames per second" in found.notes
    assert "1 of 4 messages of cam0 are before or after the ground truth" in found.notes
    (source / "again.gt.freiburg").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(InvalidInput, match=r"several ground truths: again\.gt\.freiburg, livingRoom9\.gt\.freiburg"):
        plan(source)


def test_the_times_of_the_colour_images_are_kept_with_the_ground_truth(source):
    found = plan(source, **with_calibration(source))
    assert found.truth is not None
    assert isinstance(found.recording, tuple)
    assert found.truth.image_times_s == pytest.approx(found.recording[0].times_ns / 1e9)
    assert found.truth.definition.image_times == "image_times.txt"


def test_what_is_left_out_is_said(source):
    next((source / "depth").iterdir()).unlink()
    write(source / "accelerometer.txt", "# timestamp ax ay az")
    remove("groundtruth.txt")(source)
    assert plan(source, accept_loss=True, **with_calibration(source)).notes == (
        "1 of the 4 files that depth.txt lists are missing and left out",
        "accelerometer.txt is left out: without angular rates it makes no IMU",
        "there is no ground truth: runs get no ATE (--groundtruth FILE adds one)",
    )


def test_kalibrs_calibration_is_read(source, tmp_path):
    write(
        tmp_path / "camchain.yaml",
        "cam0:",
        "  camera_model: pinhole",
        "  intrinsics: [20, 21, 15.5, 11.5]",
        "  distortion_model: equidistant",
        "  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]",
        "  resolution: [32, 24]",
    )
    camera = plan(source, calibration=(tmp_path / "camchain.yaml",)).sensors[0].calibration
    assert (camera["fy"], camera["model"], camera["distortion"]) == (21.0, "pinhole-equidistant", (0.1, 0.2, 0.3, 0.4))


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (remove("depth.txt"), r"depth\.txt does not exist"),
        (rewrite("rgb.txt", r" rgb/\S+", ""), r"rgb\.txt, line 3: 1 columns, not 2; expected timestamp filename"),
        (rewrite("rgb.txt", r"\n13", "\nsoon13"), r"rgb\.txt, line 3: timestamp 'soon1305031102.175304' is not a num"),
        (rewrite("rgb.txt", r"\n13", "\n23"), r"rgb\.txt, line 3: timestamp 23.*out of range"),
        (rewrite("rgb.txt", r"\n1305031102.1", "\n1305031109.1"), r"rgb\.txt, line 4: timestamp .* comes after"),
        (rewrite("rgb.txt", r" rgb/", " /etc/"), r"line 3: '/etc/1305031102.175304.png' is no file in the folder"),
        (lambda s: [p.write_bytes(p.read_bytes()[:-9]) for p in (s / "rgb").iterdir()], "png is truncated"),
        (make_depth_shallow, "has 1 channels of 8 bits; a depth image has"),
        (rewrite("groundtruth.txt", " 0.8\n", "\n"), r"groundtruth\.txt, line 2: 7 columns instead of 8"),
        (lambda s: write(s / "groundtruth.txt", *(tum_pose(t, t) for t in (1, 2))), "the clocks do not meet"),
        (rewrite("../camera.yaml", "fx: 20.5, ", ""), "sensor cam0 lacks calibration fx"),
        (rewrite("../camera.yaml", "kind: camera", "kind: imu"), "has no camera; give Kalibr"),
        (rewrite("../camera.yaml", "width: 32", "width: 640"), "is 32x24 pixels, the calibration of cam0 says 640x24"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(source, tmp_path, damage, problem):
    options = with_calibration(source)
    damage(source)
    data = tmp_path / "data"
    with pytest.raises(InvalidInput, match=problem) as caught:
        convert(source, data / "fr9", "tum-rgbd", **options)
    assert "\n" not in str(caught.value)
    assert not data.exists() or list(data.iterdir()) == []


def test_published_intrinsics_are_for_images_of_one_size(source):
    with pytest.raises(InvalidInput, match=r"is 32x24 pixels, .* are for 640x480; .*--calibration"):
        plan(source)
