"""Importing ROS 1 bags, ROS 2 bags and MCAP files: sensors, calibration, ground truth, and what is refused."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import SensorKind
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers.recording import SourceTopic, match_topics, open_source
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, KeptRecording, perform
from slamhive.recordings.staging import checksum
from slamhive.runtime.recording import Recording
from slamhive.trajectory.pose_file import read_uncertainties
from tests.cases import case
from tests.recordings.storages import FRAMES, PERIOD_NS, ROS1, START_NS, STORAGES, convert_to, dataset_of, write_ros1

pytestmark = pytest.mark.quick

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
STORE = get_typestore(Stores.ROS1_NOETIC)
STORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
CALIBRATION = """
cam0:
  camera_model: pinhole
  intrinsics: [60.0, 61.0, 31.5, 23.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.02, 0.001, 0.002]
  resolution: [64, 48]
  rostopic: /cam0/image_raw
  T_cam_imu: [[0.0, 1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
cam1:
  camera_model: {model}
  intrinsics: {intrinsics}
  distortion_model: {distortion}
  distortion_coeffs: {coefficients}
  resolution: [64, 48]
  rostopic: /cam1/image_raw
  T_cn_cnm1: [[1.0, 0.0, 0.0, -0.11], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
"""
EQUIDISTANT = {
    "model": "pinhole",
    "intrinsics": "[60.0, 61.0, 31.5, 23.5]",
    "distortion": "equidistant",
    "coefficients": "[0.01, 0.02, 0.03, 0.04]",
}
DOUBLE_SPHERE = {
    "model": "ds",
    "intrinsics": "[-0.2, 0.6, 60.0, 61.0, 31.5, 23.5]",
    "distortion": "none",
    "coefficients": "[]",
}
IMU = """
accelerometer_noise_density: 0.002
accelerometer_random_walk: 0.003
gyroscope_noise_density: 0.0001
gyroscope_random_walk: 2.0e-05
rostopic: /imu0
update_rate: 100.0
"""


def silent(_fraction: float, _text: str) -> None:
    pass


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ros1") / "take.bag"
    write_ros1(path)
    return path


@pytest.fixture(scope="module")
def recording(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The recording in a storage, made once."""
    folder = tmp_path_factory.mktemp("storages")
    made: dict[str, Path] = {ROS1: bag}

    def find(storage: str) -> Path:
        if storage not in made:
            made[storage] = convert_to(dataset_of(bag.parent, bag.name), folder / storage, storage).bag_path
        return made[storage]

    return find


def convert(source: Path, folder: Path, **options: Any) -> Dataset:
    return perform(plan_import(source, ImportOptions(**options))[1], folder, silent)


def truth_file(folder: Path, start_ns: int = START_NS, columns: int = 8) -> Path:
    path = folder / f"truth{columns}.txt"
    times_s = [(start_ns + number * PERIOD_NS) / 1e9 for number in range(FRAMES)]
    rows = ([time_s, number * 0.1, 0, 0, 0, 0, 0, 1][:columns] for number, time_s in enumerate(times_s))
    path.write_text("\n".join(" ".join(f"{value:.9f}" for value in row) for row in rows) + "\n")
    return path


@pytest.mark.integration
@pytest.mark.parametrize("storage", [ROS1, *STORAGES])
def test_every_storage_is_kept_and_can_be_played(recording, tmp_path, storage):
    source = recording(storage)
    name, plan = plan_import(source, ImportOptions(groundtruth=truth_file(tmp_path)))
    assert name == {"bag": "ros1", "mcap": "mcap"}.get(source.suffix[1:], "ros2")
    assert plan.counts == {
        "cam0": FRAMES,
        "cam1": FRAMES,
        "depth0": FRAMES,
        "imu0": 5 * FRAMES,
        "lidar0": FRAMES,
    }
    dataset = perform(plan, tmp_path / "made", silent)
    assert load_dataset(dataset.folder) == dataset
    assert dataset.checksum == checksum(source)
    assert dataset.sensor("cam0").rate_hz == pytest.approx(20)
    assert dataset.sensor("imu0").rate_hz == pytest.approx(100)
    assert dataset.sensor("depth0").calibration["units_per_m"] == 1000
    lidar = dataset.sensor("lidar0").calibration
    assert (lidar["point_time_field"], lidar["point_time_unit"], lidar["ring_field"]) == ("t", "ns", "ring")
    assert lidar["point_time_reference"] == "timestamp"
    with Recording(dataset.bag_path, {sensor.name: sensor.topic for sensor in dataset.sensors}) as played:
        assert {role: played.count(role) for role in plan.counts} == plan.counts


def test_camera_info_gives_intrinsics_and_the_baseline(bag, tmp_path):
    dataset = convert(bag, tmp_path / "made")
    left, right = dataset.sensor("cam0"), dataset.sensor("cam1")
    for key in ("fx", "fy", "cx", "cy", "width", "height"):
        assert left.calibration[key] == right.calibration[key] == dataset.sensor("depth0").calibration[key]
    difference = np.array(right.T_body_sensor).reshape(4, 4)[:3, 3] - np.array(left.T_body_sensor).reshape(4, 4)[:3, 3]
    assert difference == pytest.approx([0.1, 0, 0])


@pytest.mark.parametrize(("second", "model"), [(EQUIDISTANT, "pinhole-equidistant"), (DOUBLE_SPHERE, "double-sphere")])
def test_kalibr_files_win_over_camera_info(bag, tmp_path, second, model):
    cameras, imu = tmp_path / "camchain.yaml", tmp_path / "imu.yaml"
    cameras.write_text(CALIBRATION.format(**second))
    imu.write_text(IMU)
    dataset = convert(bag, tmp_path / "made", calibration=(cameras, imu))
    left, right = dataset.sensor("cam0"), dataset.sensor("cam1")
    assert (left.calibration["model"], right.calibration["model"]) == ("pinhole-radtan", model)
    assert left.calibration["distortion"] == (0.1, -0.02, 0.001, 0.002)
    assert right.calibration["fx"] == 60.0
    T_imu_cam0, T_imu_cam1 = (np.array(sensor.T_body_sensor).reshape(4, 4) for sensor in (left, right))
    # p_cam = R p_imu + (0.5, 0, 0), so the camera is at -R^T (0.5, 0, 0) in the frame of the IMU
    assert T_imu_cam0[:3, 3] == pytest.approx([0, -0.5, 0])
    assert (np.linalg.inv(T_imu_cam0) @ T_imu_cam1)[:3, 3] == pytest.approx([0.11, 0, 0])
    assert dataset.sensor("imu0").calibration == {
        "gyroscope_noise_density": 0.0001,
        "accelerometer_noise_density": 0.002,
        "gyroscope_random_walk": 2e-5,
        "accelerometer_random_walk": 0.003,
    }


def test_time_offsets_of_kalibr_are_kept_and_unread_keys_named(bag, tmp_path):
    cameras, imu = tmp_path / "camchain.yaml", tmp_path / "imu.yaml"
    text = CALIBRATION.format(**EQUIDISTANT)
    shifted = text.replace("cam1:", "  timeshift_cam_imu: 0.0814\n  line_delay: 1.0e-5\ncam1:")
    cameras.write_text(shifted + "T_imu_body: []\n")
    imu.write_text(IMU + "time_offset: 0.0\n")
    found = plan_import(bag, ImportOptions(calibration=(cameras, imu)))[1]
    offsets_s = [sensor.calibration.get("time_offset_s") for sensor in found.sensors if sensor.name in {"cam0", "cam1"}]
    assert offsets_s == [0.0814, None]
    assert any(note.startswith("cam0 needs 0.0814 s added to its timestamps") for note in found.notes)
    assert [note for note in found.notes if "not read" in note] == [
        "line_delay of cam0 in camchain.yaml is not read",
        "T_imu_body of camchain.yaml is not read",
    ]
    made = convert(bag, tmp_path / "made", calibration=(cameras,))
    again = convert(bag, tmp_path / "again", calibration=(made.folder / "dataset.yaml",))
    assert again.sensor("cam0").calibration["time_offset_s"] == 0.0814
    cameras.write_text(cameras.read_text().replace("0.0814", "81.4"))
    with pytest.raises(InvalidInput, match=r"cam0: timeshift_cam_imu is 81\.4 s; expected seconds"):
        plan_import(bag, ImportOptions(calibration=(cameras,)))


def test_a_real_time_offset_between_cameras_and_imu_is_kept():
    source = case("kalibr_timeshift")
    options = ImportOptions(calibration=(source / "camchain-imucam.yaml",))
    found = plan_import(source / "take.bag", options)[1]
    cameras = [sensor for sensor in found.sensors if sensor.name.startswith("cam")]
    assert cameras[0].calibration["time_offset_s"] == 0.08140089931412792
    assert any("0.08140089931412792 s added" in note for note in found.notes)
    assert "T_imu_body of camchain-imucam.yaml is not read" in found.notes


@pytest.mark.integration
def test_a_dataset_file_is_a_calibration_too(bag, tmp_path):
    cameras = tmp_path / "camchain.yaml"
    cameras.write_text(CALIBRATION.format(**EQUIDISTANT))
    first = convert(bag, tmp_path / "first", calibration=(cameras,))
    again = convert(bag, tmp_path / "again", calibration=(first.folder / "dataset.yaml",))
    assert again.sensors == first.sensors


def test_topics_can_be_chosen_and_left_out(bag, tmp_path):
    chosen = {"cam0": "/cam1/image_raw", "depth0": "none", "lidar0": "none"}
    dataset = convert(bag, tmp_path / "made", topics=chosen)
    assert [(sensor.name, sensor.topic) for sensor in dataset.sensors] == [
        ("cam0", "/cam1/image_raw"),
        ("imu0", "/imu0"),
    ]


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"topics": {"cam0": "/cam0/image"}}, "has no topic '/cam0/image' for sensor cam0; did you mean"),
        ({"topics": {"cam0": "/imu0"}}, "'/imu0' for sensor cam0 holds sensor_msgs/msg/Imu; expected sensor_msgs"),
        ({"topics": {"cam0": "/cam0/image_raw", "cam1": "/cam0/image_raw"}}, "named for cam0 and for cam1"),
        ({"topics": {"camera": "/cam0/image_raw"}}, "'camera' is no name of a sensor; use cam0"),
        ({"topics": {"gnss0": "none"}}, "there is no such sensor"),
        ({"groundtruth_topic": "/truth"}, "has no topic '/truth' for the ground truth"),
        ({"groundtruth_topic": "/imu0"}, "'/imu0' for the ground truth holds sensor_msgs/msg/Imu; expected one of"),
        ({"groundtruth_topic": "/x", "groundtruth": Path("t.txt")}, "there are two ground truths: t.txt and topic /x"),
        ({"typestore": "ros2_humbel"}, "typestore 'ros2_humbel' is unknown; did you mean 'ros2_humble'"),
        ({"message_definitions": Path("/nowhere")}, "/nowhere holds no .msg file"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_one_line(bag, options, problem):
    with pytest.raises(InvalidInput, match=problem) as caught:
        plan_import(bag, ImportOptions(**options))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            ("[64, 48]", "[752, 480]"),
            "images of cam0 on /cam0/image_raw are 64x48 pixels, its calibration is of",
        ),
        (("radtan", "fov"), "camera model pinhole with distortion fov is not read; known: pinhole with radtan"),
        (("  resolution: [64, 48]\n", ""), "camchain.yaml: cam0 lacks resolution"),
        (("[60.0, 61.0, 31.5, 23.5]", "[60.0]"), "cam0: intrinsics has 1 numbers; expected 4 finite"),
        (("[-1.0, 0.0, 0.0, 0.0]", "[-2.0, 0.0, 0.0, 0.0]"), "cam0: T_cam_imu is no rigid transform"),
        (("cam", "sensor"), "is no calibration that is read; expected Kalibr's"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(bag, tmp_path, change, problem):
    cameras = tmp_path / "camchain.yaml"
    text = CALIBRATION.format(**EQUIDISTANT)
    cameras.write_text(text.replace(*change, *(() if change[0] == "cam" else (1,))))
    with pytest.raises(InvalidInput, match=problem):
        plan_import(bag, ImportOptions(calibration=(cameras,)))


def test_one_file_for_each_camera_may_call_both_cam0(bag, tmp_path):
    """Kalibr numbers the cameras of a file from 0; the files of Hilti 2022 are such."""
    first = CALIBRATION.format(**EQUIDISTANT).split("cam1:")[0]
    (tmp_path / "left.yaml").write_text(first)
    (tmp_path / "right.yaml").write_text(first.replace("/cam0/", "/cam1/").replace("0.5]", "0.7]"))
    dataset = convert(bag, tmp_path / "made", calibration=(tmp_path / "left.yaml", tmp_path / "right.yaml"))
    places_m = [np.array(dataset.sensor(name).T_body_sensor).reshape(4, 4)[:3, 3] for name in ("cam0", "cam1")]
    assert places_m[0] == pytest.approx([0, -0.5, 0])
    assert places_m[1] == pytest.approx([0, -0.7, 0])


def test_two_files_that_calibrate_one_camera_are_refused(bag, tmp_path):
    for name in ("a.yaml", "b.yaml"):
        (tmp_path / name).write_text(CALIBRATION.format(**EQUIDISTANT))
    with pytest.raises(InvalidInput, match=r"a.yaml and .*b.yaml both calibrate cam0"):
        plan_import(bag, ImportOptions(calibration=(tmp_path / "a.yaml", tmp_path / "b.yaml")))


def test_ground_truth_of_another_clock_is_refused_with_both_spans(bag, tmp_path):
    spans = r"from 2000.000 s to 2000.550 s, the recording from 1000.000 s to 1000.5.. s"
    with pytest.raises(InvalidInput, match=spans):
        plan_import(bag, ImportOptions(groundtruth=truth_file(tmp_path, 2 * 10**12)))


def test_positions_alone_are_a_ground_truth(bag, tmp_path):
    dataset = convert(bag, tmp_path / "made", groundtruth=truth_file(tmp_path, columns=4))
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.positions_only


def message(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(stamp_ns: int, frame: str) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/msg/Header", seq=0, stamp=stamp, frame_id=frame)


def pose_messages(kind: str, number: int) -> Any:
    """Number ``number`` of a straight path, in the message type ``kind``."""
    head = header(START_NS + number * PERIOD_NS, "map")
    p = message("geometry_msgs/msg/Point", x=0.1 * number, y=0.0, z=0.0)
    v = message("geometry_msgs/msg/Vector3", x=0.1 * number, y=0.0, z=0.0)
    q = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    pose = message("geometry_msgs/msg/Pose", position=p, orientation=q)
    with_covariance = message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    transform = message("geometry_msgs/msg/Transform", translation=v, rotation=q)
    moved = message("geometry_msgs/msg/TransformStamped", header=head, child_frame_id="base", transform=transform)
    twist = message("geometry_msgs/msg/Twist", linear=v, angular=v)
    made = {
        "geometry_msgs/msg/PoseStamped": lambda: {"header": head, "pose": pose},
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda: {"header": head, "pose": with_covariance},
        "geometry_msgs/msg/TransformStamped": lambda: {
            "header": head,
            "child_frame_id": "base",
            "transform": transform,
        },
        "tf2_msgs/msg/TFMessage": lambda: {"transforms": [moved]},
        "nav_msgs/msg/Odometry": lambda: {
            "header": head,
            "child_frame_id": "base",
            "pose": with_covariance,
            "twist": message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        },
        "sensor_msgs/msg/NavSatFix": lambda: {
            "header": head,
            "status": message("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            "latitude": 48.0,
            "longitude": 11.0 + number * 1e-6,
            "altitude": 500.0,
            "position_covariance": np.zeros(9),
            "position_covariance_type": 0,
        },
    }
    return message(kind, **made[kind]())


def stating(kind, number, variances_m2):
    """The same with variances of x, y and z in its covariance."""
    made = pose_messages(kind, number)
    covariance = np.zeros(9 if kind.endswith("NavSatFix") else 36)
    covariance[:: 4 if kind.endswith("NavSatFix") else 7][:3] = variances_m2
    if kind.endswith("NavSatFix"):
        made.position_covariance, made.position_covariance_type = covariance, 2
    else:
        made.pose.covariance = covariance
    return made


@pytest.mark.parametrize(
    "kind", ["geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry", "sensor_msgs/msg/NavSatFix"]
)
def test_covariances_on_a_topic_are_the_uncertainty_of_the_ground_truth(tmp_path, kind):
    write_with_truth(tmp_path / "take.bag", kind, make=lambda kind, n: stating(kind, n, (0.01, 0.04, 0.0001 * (n + 1))))
    _, plan = plan_import(tmp_path / "take.bag", ImportOptions(groundtruth_topic="/truth"))
    assert plan.truth is not None
    assert plan.truth.sigmas_m is not None
    assert plan.truth.sigmas_m[:, :2] == pytest.approx(np.tile([0.1, 0.2], (FRAMES, 1)))
    assert plan.truth.sigmas_m[:, 2] == pytest.approx(0.01 * np.sqrt(np.arange(1, FRAMES + 1)))
    assert "the covariances of topic /truth are the uncertainty of the ground truth: 0.1 m (median)" in plan.notes
    dataset = convert(tmp_path / "take.bag", tmp_path / "made", groundtruth_topic="/truth")
    found = read_uncertainties(dataset.folder / "uncertainties.txt", plan.truth.times_s)
    assert found == pytest.approx(plan.truth.sigmas_m)
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.uncertainties == "uncertainties.txt"


@pytest.mark.parametrize(
    ("variances_m2", "said"),
    [((0.0, 0.0, 0.0), False), ((-1.0, 0.0, 0.0), False), ((0.01, 0.01, 1e6), True), ((0.01, np.nan, 0.01), True)],
)
def test_covariances_that_state_nothing_are_no_uncertainty(tmp_path, variances_m2, said):
    source = tmp_path / "take.bag"
    write_with_truth(source, "nav_msgs/msg/Odometry", make=lambda kind, n: stating(kind, n, variances_m2))
    _, plan = plan_import(source, ImportOptions(groundtruth_topic="/truth"))
    assert plan.truth is not None
    assert plan.truth.sigmas_m is None
    note = f"{FRAMES} of the {FRAMES} covariances of topic /truth do not state the variance of x, y and z"
    assert any(entry.startswith(note) for entry in plan.notes) is said


def test_users_state_the_uncertainty_of_a_ground_truth(tmp_path):
    source = tmp_path / "take.bag"
    write_with_truth(source, "geometry_msgs/msg/PoseStamped")
    _, plan = plan_import(source, ImportOptions(groundtruth_topic="/truth", uncertainty_m=0.02))
    assert plan.truth is not None
    assert (plan.truth.definition.uncertainty_m, plan.truth.definition.uncertainties) == (0.02, None)
    with pytest.raises(InvalidInput, match=r"an uncertainty of -1 m is none; give a standard deviation in metres"):
        plan_import(source, ImportOptions(groundtruth_topic="/truth", uncertainty_m=-1.0))
    with pytest.raises(InvalidInput, match=r"the uncertainty of 0\.02 m belongs to no ground truth"):
        plan_import(source, ImportOptions(uncertainty_m=0.02))


def write_with_truth(path: Path, kind: str, topic: str = "/truth", make=pose_messages, *, placed: bool = True) -> None:
    """A bag with an IMU, ground truth on a topic, and unless ``placed`` says no, the IMU's place in /tf_static."""
    with Ros1Writer(path) as writer:
        truth = writer.add_connection(topic, kind, typestore=STORE)
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=STORE)
        static = writer.add_connection("/tf_static", "tf2_msgs/msg/TFMessage", typestore=STORE)
        q = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        place = message("geometry_msgs/msg/Vector3", x=0.3, y=0.0, z=0.2)
        fixed = message(
            "geometry_msgs/msg/TransformStamped",
            header=header(START_NS, "base"),
            child_frame_id="imu_link",
            transform=message("geometry_msgs/msg/Transform", translation=place, rotation=q),
        )
        tree = message("tf2_msgs/msg/TFMessage", transforms=[fixed] * placed)
        writer.write(static, START_NS, STORE.serialize_ros1(tree, "tf2_msgs/msg/TFMessage"))
        zero = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=9.81)
        for number in range(FRAMES):
            stamp_ns = START_NS + number * PERIOD_NS
            sample = message(
                "sensor_msgs/msg/Imu",
                header=header(stamp_ns, "imu_link"),
                orientation=q,
                orientation_covariance=np.zeros(9),
                angular_velocity=zero,
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=zero,
                linear_acceleration_covariance=np.zeros(9),
            )
            writer.write(imu, stamp_ns, STORE.serialize_ros1(sample, "sensor_msgs/msg/Imu"))
            writer.write(truth, stamp_ns, STORE.serialize_ros1(make(kind, number), kind))


@pytest.mark.parametrize(
    ("kind", "with_frame"),
    [
        ("geometry_msgs/msg/PoseStamped", False),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", False),
        ("geometry_msgs/msg/TransformStamped", True),
        ("tf2_msgs/msg/TFMessage", True),
        ("nav_msgs/msg/Odometry", True),
        ("sensor_msgs/msg/NavSatFix", False),
    ],
)
def test_ground_truth_on_a_topic(tmp_path, kind, with_frame):
    source = tmp_path / "take.bag"
    write_with_truth(source, kind)
    _, plan = plan_import(source, ImportOptions(groundtruth_topic="/truth"))
    assert [sensor.name for sensor in plan.sensors] == ["imu0"]
    assert plan.truth is not None
    assert plan.truth.source == "topic /truth"
    assert len(plan.truth.times_s) == FRAMES
    step_m = 0.1 * (FRAMES - 1)
    if kind.endswith("NavSatFix"):
        # one degree of longitude at 48 degrees north: 74.63 km
        step_m = 0.07463 * (FRAMES - 1)
        assert plan.truth.quats_xyzw is None
        assert plan.truth.gravity_aligned
    assert plan.truth.positions_m[-1] == pytest.approx([step_m, 0, 0], abs=2e-3)
    # a ground truth that names its frame makes it the body: /tf_static knows where the IMU is on it
    T_body_imu = np.array(plan.sensors[0].T_body_sensor).reshape(4, 4)
    assert T_body_imu[:3, 3] == pytest.approx([0.3, 0, 0.2] if with_frame else [0, 0, 0])
    assert plan.truth.lever_arm_m is None


@pytest.mark.parametrize(("frame", "arm_m"), [("base", [-0.3, 0, -0.2]), ("antenna", None)])
def test_the_antenna_has_a_lever_arm_where_its_place_is_known(tmp_path, frame, arm_m):
    def fixes(kind, number):
        made = pose_messages(kind, number)
        made.header.frame_id = frame
        return made

    source = tmp_path / "take.bag"
    write_with_truth(source, "sensor_msgs/msg/NavSatFix", make=fixes)
    plan = plan_import(source, ImportOptions(groundtruth_topic="/truth"))[1]
    assert plan.truth is not None
    assert plan.truth.lever_arm_m == (None if arm_m is None else pytest.approx(arm_m))
    said = "is known on the body" if arm_m else "is not known on the body: 0 0 0 is assumed"
    assert f"the antenna ({frame}) {said} (lever_arm_m in dataset.yaml)" in plan.notes


def test_a_camera_without_calibration_is_refused(tmp_path):
    source = tmp_path / "take.bag"
    with Ros1Writer(source) as writer:
        connection = writer.add_connection("/left", "sensor_msgs/msg/Image", typestore=STORE)
        for number in range(3):
            image = message(
                "sensor_msgs/msg/Image",
                header=header(START_NS + number * PERIOD_NS, ""),
                height=4,
                width=6,
                encoding="mono8",
                is_bigendian=0,
                step=6,
                data=np.zeros(24, np.uint8),
            )
            writer.write(connection, START_NS + number, STORE.serialize_ros1(image, "sensor_msgs/msg/Image"))
    with pytest.raises(InvalidInput, match="camera cam0 on /left has no calibration; give --calibration FILE"):
        plan_import(source, ImportOptions())


def names_of(*topics: tuple[str, str]) -> dict[str, str]:
    """How topics of images are matched: name of the sensor to topic."""

    class Bag:
        path = Path("take.bag")

        def __init__(self) -> None:
            self.topics = {name: SourceTopic(name, "sensor_msgs/msg/Image", 9) for name, _ in topics}

        def of_type(self, *kinds: str) -> list[Any]:
            return list(self.topics.values()) if "sensor_msgs/msg/Image" in kinds else []

        def first(self, topic: str) -> Any:
            class Image:
                encoding = dict(topics)[topic]

            return Image

    bag: Any = Bag()
    return {name: topic.name for name, topic in match_topics(bag, {}).topics.items()}


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["/stereo/right/image_raw", "/stereo/left/image_raw"], {"cam0": "/stereo/left/image_raw"}),
        (["/camera/color/image_raw", "/camera/infra2/image_rect_raw", "/camera/infra1/image_rect_raw"],
         {"cam0": "/camera/infra1/image_rect_raw", "cam1": "/camera/infra2/image_rect_raw",
          "cam2": "/camera/color/image_raw"}),
        (["/cam10/image_raw", "/cam2/image_raw"], {"cam0": "/cam2/image_raw", "cam1": "/cam10/image_raw"}),
        (["/cam0/image_rect", "/cam0/image_raw"], {"cam0": "/cam0/image_raw"}),
    ],
)  # fmt: skip
def test_cameras_are_numbered_left_before_right_and_by_value(topics, names):
    found = names_of(*((topic, "mono8") for topic in topics))
    assert {name: found[name] for name in names} == names


def test_encodings_tell_depth_and_what_cannot_be_read():
    found = names_of(("/a/image_raw", "bgr8"), ("/b/image_raw", "16UC1"), ("/c/image_raw", "nv24"))
    assert found == {"cam0": "/a/image_raw", "depth0": "/b/image_raw"}


def test_plain_images_of_a_camera_are_preferred_to_those_that_have_to_be_converted():
    assert names_of(("/a/image_raw", "bayer_rggb8"), ("/a/image_color", "rgb8")) == {"cam0": "/a/image_color"}
    assert names_of(("/a/image_raw", "bayer_rggb8")) == {"cam0": "/a/image_raw"}


IMU_DEFINITION = """
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


def test_a_file_of_the_mcap_library_is_imported(tmp_path):
    source = tmp_path / "take.mcap"
    with source.open("wb") as file, McapWriter(file) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", IMU_DEFINITION)
        for number in range(FRAMES):
            stamp_ns = START_NS + number * PERIOD_NS
            vector = {"x": 0.0, "y": 0.1, "z": 9.81}
            writer.write_message(
                "/imu",
                schema,
                {
                    "header": {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": "imu"},
                    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    "orientation_covariance": [0.0] * 9,
                    "angular_velocity": vector,
                    "angular_velocity_covariance": [0.0] * 9,
                    "linear_acceleration": vector,
                    "linear_acceleration_covariance": [0.0] * 9,
                },
                log_time=stamp_ns,
                publish_time=stamp_ns,
            )
    dataset = convert(source, tmp_path / "made", groundtruth=truth_file(tmp_path))
    assert dataset.sensor("imu0").rate_hz == pytest.approx(20)
    assert dataset.duration_s == pytest.approx(0.55)


@pytest.mark.integration
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
def test_the_recorded_turtlebot(tmp_path):
    source = SHARED / "evo_trajectories" / "nav2_turtlebot.mcap"
    dataset = convert(source, tmp_path / "made", groundtruth_topic="/amcl_pose")
    odom = dataset.sensor("odom0")
    assert (odom.kind, odom.topic) == (SensorKind.ODOMETRY, "/odom")
    assert odom.rate_hz == pytest.approx(27.28, abs=0.01)  # by the headers: the simulation ran slower than real time
    assert dataset.checksum == checksum(source)
    truth = (dataset.folder / "groundtruth.txt").read_text().splitlines()
    assert len(truth) == 136
    (clock,) = [note for note in plan_import(source, ImportOptions())[1].notes if note.startswith("headers are")]
    assert clock == "headers are 1778233425 s before the clock of the recording; the time of headers counts"
    with pytest.raises(InvalidInput, match=r"'/tf' has the poses of \d frames: .*--groundtruth-topic /tf:FRAME"):
        plan_import(source, ImportOptions(groundtruth_topic="/tf"))


@pytest.mark.integration
def test_a_type_without_definition_names_the_remedy(recording, tmp_path):
    """SQLite bags of ROS 2 before Iron hold no definitions."""
    source = tmp_path / "old.db3"
    with_custom_truth(source, recording("plain-db3"))
    with (
        open_source([source], ImportOptions()) as opened,
        pytest.raises(InvalidInput, match=r"type my_msgs/msg/State of topic /truth is not defined.*--msgs DIR"),
    ):
        opened.first("/truth")
    folder = tmp_path / "definitions" / "my_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "State.msg").write_text("uint32 value\n")
    with open_source([source], ImportOptions(message_definitions=tmp_path / "definitions")) as opened:
        assert opened.first("/truth").value == 7


def with_custom_truth(path: Path, source: Path) -> None:
    """A copy of an SQLite recording without definitions, as older versions wrote it, and a topic of an own type."""
    shutil.copyfile(source, path)
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
        database.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
        database.execute("INSERT INTO topics VALUES (99, '/truth', 'my_msgs/msg/State', 'cdr', '')")
        database.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (99, ?, ?)",
            (START_NS, b"\0\1\0\0\7\0\0\0"),
        )


def test_a_full_disk_is_refused_before_anything_is_written(bag, tmp_path, monkeypatch):
    plan = plan_import(bag, ImportOptions())[1]
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: type("Usage", (), {"free": 1000}))
    with pytest.raises(Unavailable, match="0 MB free"):
        perform(plan, tmp_path / "data" / "made", silent)
    assert list((tmp_path / "data").iterdir()) == []


@pytest.mark.parametrize("storage", [ROS1, "plain-mcap-zstd", "sqlite3-message-zstd"])
def test_damage_inside_is_found_and_leaves_nothing(recording, tmp_path, storage):
    source = tmp_path / recording(storage).name
    original = recording(storage)
    if original.is_dir():
        source.mkdir()
        for file in original.iterdir():
            (source / file.name).write_bytes(file.read_bytes())
        damaged = next(file for file in source.iterdir() if file.suffix == ".db3")
    else:
        source.write_bytes(original.read_bytes())
        damaged = source
    data = bytearray(damaged.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 30_000] = b"\xee" * 30_000
    damaged.write_bytes(data)
    with pytest.raises(InvalidInput, match=r"cannot be read as a recording|[0-9]+ messages") as caught:
        convert(source, tmp_path / "data" / "made")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "data").exists() or list((tmp_path / "data").iterdir()) == []


def test_kept_recordings_are_planned_without_reading_them_whole(bag):
    recording = plan_import(bag, ImportOptions())[1].recording
    assert isinstance(recording, KeptRecording)
    assert recording.check is not None
