"""What packages for GPUs do before and after the network: configuration, images, calibration, trajectory, errors.

There is no GPU here. Behind the packages are libraries with the signatures of upstream that track nothing, so this says
that the packages call them as documented, and nothing about the algorithms.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.parameters import parse_settings
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.recordings.writers import BagWriter
from slamhive.runtime.config import RunConfig, to_yaml
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import weights_file
from slamhive.runtime.trajectory import Poses, quaternions_xyzw
from tests.runtime.runtime_samples import LEFT, START_NS

pytestmark = pytest.mark.quick

PACKAGES = project_root() / "algorithms"
LIBRARIES = Path(__file__).parent / "gpu_libraries"
MINE = ("torch", "dpvo", "dpvo.config", "dpvo.dpvo", "droid", "cuvslam")
INPUTS = ("dpvo_input", "droid_input", "cuvslam_input", "mapping")
BODY = np.eye(4).ravel().tolist()
RIGHT = np.array([[1, 0, 0, 0.25], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]).ravel().tolist()
LENS = [-0.28, 0.07, 0.0002, 0.00002]
LEFT_CAMERA = {"width": 70, "height": 50, "fx": 60.0, "fy": 61.0, "cx": 34.0, "cy": 26.0, "T_body_sensor": BODY}
NOISE = dict.fromkeys(
    (
        "gyroscope_noise_density",
        "gyroscope_random_walk",
        "accelerometer_noise_density",
        "accelerometer_random_walk",
    ),
    0.01,
)
WEIGHTS = {
    "dpvo": ("dpvo.pth",),
    "droid-slam": ("droid.pth",),
    "mast3r-slam": tuple(
        f"MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric{end}"
        for end in (".pth", "_retrieval_trainingfree.pth", "_retrieval_codebook.pkl")
    ),
    "cuvslam": (),
}
MAIN = """
import json, pathlib, sys
folder = pathlib.Path(sys.argv[sys.argv.index("--dataset") + 1])
names = sorted(path.name for path in folder.glob("*.png"))
checkpoints = sorted(path.name for path in pathlib.Path("checkpoints").iterdir())
calibration = pathlib.Path("intrinsics.yaml")
told = {"arguments": sys.argv[1:], "names": names, "checkpoints": checkpoints, "calibration": calibration.read_text()}
(pathlib.Path(__file__).parent / "told.json").write_text(json.dumps(told))
if len(names) < 3:
    sys.exit("CUDA out of memory\\n")
pathlib.Path("logs").mkdir()
keyframes = (0, 2, len(names) - 1)
lines = "".join(f"{number / 30:.9g} {number} 0 0 0 0 1 0\\n" for number in keyframes)
(pathlib.Path("logs") / f"{folder.stem}.txt").write_text(lines)
"""


@dataclass
class Package:
    """A package for GPUs, with libraries that track nothing behind it."""

    name: str
    module: ModuleType

    def config(self, mode: str, roles: dict[str, dict[str, Any]], **settings: Any) -> RunConfig:
        return config(self.name, mode, roles, **settings)


def config(name: str, mode: str, roles: dict[str, dict[str, Any]], **settings: Any) -> RunConfig:
    """``config.yaml`` of a run; ``roles`` has the calibration of each sensor."""
    algorithm = next(entry for entry in load_algorithms(PACKAGES / name) if entry.mode == mode)
    sensors = {f"{role}_{key}": value for role, content in roles.items() for key, value in content.items()}
    return RunConfig(
        algorithm.name,
        "track",
        algorithm_parameters=parse_settings(name, algorithm.parameters, settings),
        dataset_parameters=sensors,
        algorithm_remap={role: f"/{role}" for role in roles},
        seed=7,
    )


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a file for each of the weights."""
    folder = tmp_path / "weights"
    folder.mkdir()
    for name in (entry for names in WEIGHTS.values() for entry in names):
        (folder / name).write_bytes(b"numbers")
    monkeypatch.setenv("SLAMHIVE_WEIGHTS", str(folder))
    return folder


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch, weights: Path):
    """Imports a package's ``mapping.py`` with those libraries."""
    before = {name: sys.modules.pop(name) for name in (*MINE, *INPUTS) if name in sys.modules}
    monkeypatch.syspath_prepend(str(LIBRARIES))

    def load_package(name: str) -> Package:
        monkeypatch.syspath_prepend(str(PACKAGES / name / "slamhive"))
        return Package(name, import_module("mapping"))

    yield load_package
    for name in (*MINE, *INPUTS):
        sys.modules.pop(name, None)
    sys.modules.update(before)


def frame(number: int, imu: np.ndarray | None = None, **data: np.ndarray) -> Frame:
    return Frame(number, 1000 + number / 10, 0.0, 0.0, dict(data), np.empty((0, 7)) if imu is None else imu)


def coloured(height: int = 50, width: int = 70) -> np.ndarray:
    """Red first; red grows to the right, blue downwards."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.arange(width)
    image[..., 2] = 3 * np.arange(height)[:, None]
    return image


def test_dpvo_gets_undistorted_images_with_blue_first_and_its_poses_keep_their_stamps(load) -> None:
    package = load("dpvo")
    settings = package.config("mono", {"left": {**LEFT_CAMERA, "distortion": LENS}}, patches=48)
    slam = package.module.Dpvo(settings)
    for number in range(5):
        slam.process(frame(number, left=coloured()))
    (network,) = import_module("dpvo.dpvo").made
    assert import_module("torch").seeds == [7]
    assert (network.size, network.viz) == ((48, 64), False)
    assert (network.cfg["PATCHES_PER_FRAME"], network.cfg["KEYFRAME_THRESH"]) == (48, 15.0)
    tstamp, image, intrinsics = network.taken[3]
    assert tstamp == pytest.approx(0.3)
    assert intrinsics.array.tolist() == [60, 61, 34, 26]
    assert image.on_gpu
    K = np.array([[60, 0, 34], [0, 61, 26], [0, 0, 1.0]])
    expected = cv2.undistort(np.ascontiguousarray(coloured()[..., ::-1]), K, np.array(LENS))[:48, :64]
    assert np.array_equal(image.array, expected.transpose(2, 0, 1))
    poses = slam.finish()
    check_turning(poses)
    assert slam.about()["package"] == "dpvo"


def check_turning(poses: Poses) -> None:
    """Five poses, 1 m and 0.1 rad about z apart."""
    assert poses.stamps_s.tolist() == [1000, 1000.1, 1000.2, 1000.3, 1000.4]
    assert poses.T_world_sensor[:, 0, 3].tolist() == [0, 1, 2, 3, 4]
    quaternions = quaternions_xyzw(poses.T_world_sensor[:, :3, :3])
    assert np.allclose(quaternions[3], [0, 0, np.sin(0.15), np.cos(0.15)])


def test_droid_slam_gets_a_pair_in_its_size_and_scales_by_the_real_baseline(load) -> None:
    package = load("droid-slam")
    pair = {"left": LEFT_CAMERA, "right": {**LEFT_CAMERA, "T_body_sensor": RIGHT}}
    slam = package.module.DroidSlam(package.config("stereo", pair, pixels=20000, warmup=4))
    grey = coloured()[..., 2]
    for number in range(5):
        slam.process(frame(number, left=coloured(), right=grey))
    (network,) = import_module("droid").made
    assert network.args.image_size == [112, 160]
    assert (network.args.stereo, network.args.upsample, network.args.backend_nms) == (True, False, 3)
    tstamp, images, intrinsics = network.taken[2]
    assert tstamp == 2
    assert np.allclose(intrinsics.array, [60 * 160 / 70, 61 * 112 / 50, 34 * 160 / 70, 26 * 112 / 50])
    assert images.array.dtype == np.uint8
    left, right = images.array
    assert left[2, 50, -1] > left[2, 50, 0]  # red is last, and grows to the right
    assert left[0, -1, 50] > left[0, 0, 50]  # blue is first, and grows downwards
    assert np.array_equal(right[0], right[2])
    poses = slam.finish()
    assert [entry[1].array.shape for entry in network.stream] == [(1, 3, 112, 160)] * 5
    assert np.allclose(poses.T_world_sensor[:, 0, 3], 2.5 * np.arange(5))
    assert poses.stamps_s[3] == 1000.3


def test_droid_slam_undistorts_one_camera_and_refuses_a_pair_that_is_not_rectified(load) -> None:
    package = load("droid-slam")
    bent = {**LEFT_CAMERA, "distortion": LENS}
    slam = package.module.DroidSlam(package.config("mono", {"left": bent}, pixels=20000))
    slam.process(frame(0, left=coloured()))
    (network,) = import_module("droid").made
    assert not network.args.stereo
    flat = load("droid-slam").module.DroidSlam(package.config("mono", {"left": LEFT_CAMERA}, pixels=20000))
    flat.process(frame(0, left=coloured()))
    assert not np.array_equal(network.taken[0][1].array, import_module("droid").made[1].taken[0][1].array)
    assert len(slam.finish().stamps_s) == 0
    pair = package.config("stereo", {"left": bent, "right": {**bent, "T_body_sensor": RIGHT}})
    with pytest.raises(InvalidInput, match="needs rectified images of a stereo pair; rectify the images"):
        package.module.DroidSlam(pair)
    fisheye = package.config("mono", {"left": {**bent, "model": "pinhole-equidistant"}})
    with pytest.raises(InvalidInput, match="DROID-SLAM has no camera model for the images of left"):
        package.module.DroidSlam(fisheye)


def imu_rows(*times: float) -> np.ndarray:
    return np.array([[time, 1, 2, 3, 4, 5, 6] for time in times]).reshape(-1, 7)


def test_cuvslam_gets_lenses_extrinsics_and_imu_samples_in_order(load) -> None:
    package = load("cuvslam")
    lens = {**LEFT_CAMERA, "distortion": [*LENS, 0.5]}
    fisheye = {**LEFT_CAMERA, "model": "fisheye-kb", "distortion": LENS, "T_body_sensor": RIGHT}
    imu = {**NOISE, "rate_hz": 200.0, "T_body_sensor": BODY}
    settings = package.config("stereo-inertial", {"left": lens, "right": fisheye, "imu": imu})
    slam = package.module.CuVslam(settings)
    found = [
        slam.process(frame(number, imu_rows(1000 + number / 10 - 0.05, 1000 + number / 10 + 0.02), **stereo()))
        for number in range(3)
    ]
    assert found == [False, True, True]
    (tracker,) = import_module("cuvslam").made
    modes = import_module("cuvslam").Odometry.OdometryMode
    assert (tracker.odometry.mode, tracker.odometry.rectified, tracker.slam) == (modes.Inertial, False, None)
    left, right = tracker.rig.cameras
    assert (left.size, left.focal, left.principal) == ([70, 50], [60, 61], [34, 26])
    assert left.distortion.parameters == [-0.28, 0.07, 0.5, 0.0002, 0.00002]
    assert right.distortion.model.name == "Fisheye"
    assert right.rig_from_camera.translation.tolist() == [0.25, 0, 0]
    assert (tracker.rig.imus[0].frequency, tracker.rig.imus[0].gyroscope_noise_density) == (200, 0.01)
    times = [entry.timestamp_ns for entry in tracker.taken]
    assert times == sorted(times)
    assert len(times) == 3 + 5  # the last sample is later than the last image
    poses = slam.finish()
    assert np.allclose(poses.stamps_s, [1000.1, 1000.2])
    assert np.allclose(poses.T_world_sensor[:, 0, 3], [0.1, 0.2], atol=1e-6)
    assert np.allclose(quaternions_xyzw(poses.T_world_sensor[:, :3, :3])[0], [0, 0, 0.6, 0.8], atol=1e-6)
    assert slam.about() == {"package": "cuvslam", "version": "17.0.0+cu12"}


def stereo() -> dict[str, np.ndarray]:
    return {"left": coloured(), "right": coloured()[..., 0]}


def test_cuvslam_takes_depth_of_16_bits_and_gives_the_poses_of_its_slam(load) -> None:
    package = load("cuvslam")
    roles = {"left": LEFT_CAMERA, "depth": {**LEFT_CAMERA, "units_per_m": 5000.0}}
    slam = package.module.CuVslam(package.config("rgbd", roles, slam=True))
    for number in range(2):
        slam.process(frame(number, left=coloured(), depth=np.full((50, 70), 5000, np.uint16)))
    (tracker,) = import_module("cuvslam").made
    assert (tracker.odometry.rgbd.scale, tracker.odometry.rgbd.camera, tracker.slam.sync_mode) == (5000, 0, True)
    assert slam.finish().T_world_sensor[0, :3, 3].tolist() == [7, 7, 7]
    with pytest.raises(InvalidInput, match="needs 16-bit depth, this one is float32"):
        slam.process(frame(2, left=coloured(), depth=np.ones((50, 70), np.float32)))


def test_another_cuvslam_and_an_imu_without_noise_are_refused(load, monkeypatch) -> None:
    package = load("cuvslam")
    roles = {"left": LEFT_CAMERA, "right": LEFT_CAMERA, "imu": {"rate_hz": 200.0, "T_body_sensor": BODY}}
    settings = package.config("stereo-inertial", roles)
    with pytest.raises(InvalidInput, match=r"cuVSLAM needs gyroscope_noise_density, .* of the IMU; add them"):
        package.module.CuVslam(settings)
    monkeypatch.setattr(import_module("cuvslam"), "VERSION", ["18.0.0", 18, 0, 0])
    with pytest.raises(InvalidInput, match=r"this image has cuVSLAM 18\.0\.0, version 17 is needed"):
        package.module.CuVslam(settings)


def test_mast3r_slam_writes_a_folder_and_reads_the_keyframes_back(load, tmp_path, monkeypatch) -> None:
    project = tmp_path / "project"
    (project / "config").mkdir(parents=True)
    (project / "main.py").write_text(MAIN)
    package = load("mast3r-slam")
    monkeypatch.setattr(package.module, "PROJECT", project)
    settings = package.config("mono", {"left": {**LEFT_CAMERA, "distortion": LENS}}, every=2)
    slam = package.module.Mast3rSlam(settings)
    for number in range(9):
        slam.process(frame(number, left=coloured()))
    first = cv2.imread(str(slam._folder / "images" / "00000000.png"))
    assert first is not None
    assert np.array_equal(first[..., ::-1], coloured())
    poses = slam.finish()
    told = (project / "told.json").read_text()
    assert '"arguments": ["--no-viz", "--dataset", "images", "--config", "config/calib.yaml", "--calib"' in told
    assert "calibration: [60.0, 61.0, 34.0, 26.0, -0.28, 0.07, 0.0002, 2e-05]" in told
    assert all(name in told for name in WEIGHTS["mast3r-slam"])
    assert np.allclose(poses.stamps_s, [1000, 1000.4, 1000.8])
    assert poses.T_world_sensor[1, :3, 3].tolist() == [2, 0, 0]
    assert np.allclose(poses.T_world_sensor[1, :3, :3], np.diag([-1, -1, 1]))
    short = package.module.Mast3rSlam(settings)
    short.process(frame(0, left=coloured()))
    with pytest.raises(InvalidInput, match=r"^MASt3R-SLAM failed: CUDA out of memory$"):
        short.finish()
    strange = tmp_path / "strange.txt"
    for line in ("0.1 1 2\n", "9 0 0 0 0 0 0 1\n", "-1 0 0 0 0 0 0 1\n", "x 0 0 0 0 0 0 1\n"):
        strange.write_text(line)
        with pytest.raises(InvalidInput, match="does not fit the images"):
            package.module.poses_in(strange, [1.0, 2.0])


@pytest.mark.parametrize(
    ("name", "made"), [("dpvo", "Dpvo"), ("droid-slam", "DroidSlam"), ("mast3r-slam", "Mast3rSlam")]
)
def test_missing_weights_and_a_missing_gpu_are_one_line(load, weights: Path, monkeypatch, name: str, made: str) -> None:
    package = load(name)
    settings = package.config("mono", {"left": LEFT_CAMERA})
    missing = weights / WEIGHTS[name][-1]
    missing.unlink()
    with pytest.raises(InvalidInput) as refused:
        getattr(package.module, made)(settings)
    assert str(refused.value) == (
        f"the weights {missing} are missing; add them: slamhive algorithm weights PACKAGE --file FILE"
    )
    if name == "mast3r-slam":
        return
    missing.touch()
    monkeypatch.setenv("NO_GPU", "1")
    with pytest.raises(InvalidInput, match="needs a GPU, and PyTorch finds none"):
        getattr(package.module, made)(settings)


def test_the_weights_of_algorithm_yaml_are_those_that_the_program_opens() -> None:
    for name, names in WEIGHTS.items():
        package = load_algorithms(PACKAGES / name)[0].package
        assert tuple(entry.name for entry in package.weights) == names
    assert weights_file("mapping.py", {"SLAMHIVE_WEIGHTS": str(PACKAGES / "dpvo" / "slamhive")}).is_file()


@pytest.mark.integration
@pytest.mark.integration
def test_a_run_writes_trajectory_and_latency(weights: Path, tmp_path: Path) -> None:
    """The whole program, as its container starts it."""
    dataset, result = tmp_path / "dataset", tmp_path / "result"
    dataset.mkdir()
    result.mkdir()
    with BagWriter(dataset / "track.bag") as bag:
        for number in range(5):
            bag.image(LEFT, START_NS + number * 100_000_000, coloured(), "rgb8")
    settings = config("dpvo", "mono", {"left": LEFT_CAMERA})
    remapped = {**vars(settings), "dataset_remap": {"/left": LEFT.topic}, "playback_mode": "sequential"}
    (tmp_path / "config.yaml").write_text(to_yaml(RunConfig(**remapped)))
    environment = {
        **os.environ,
        "PYTHONPATH": f"{LIBRARIES}{os.pathsep}{PACKAGES.parent}",
        "SLAMHIVE_CONFIG": str(tmp_path / "config.yaml"),
        "SLAMHIVE_DATASET": str(dataset),
        "SLAMHIVE_RESULT": str(result),
    }
    command = [sys.executable, str(PACKAGES / "dpvo" / "slamhive" / "mapping.py")]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    rows = [line.split() for line in (result / "traj.txt").read_text().splitlines() if not line.startswith("#")]
    assert [row[0] for row in rows] == [f"{1000 + number / 10:.9f}" for number in range(5)]
    assert rows[3][1:4] == ["3.000000000", "0.000000000", "0.000000000"]
    assert np.allclose(np.array(rows[3][4:], dtype=float), [0, 0, np.sin(0.15), np.cos(0.15)])
    times = list(csv.DictReader((result / "frames.csv").read_text().splitlines()))
    assert len(times) == 5
    assert all(float(row["done"]) >= float(row["received"]) for row in times)
    assert (result / "finished").is_file()
    environment["NO_GPU"] = "1"
    failed = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert failed.returncode != 0
    (line,) = failed.stderr.splitlines()
    assert "DPVO needs a GPU, and PyTorch finds none; check the driver" in line
