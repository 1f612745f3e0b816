from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.algorithm import Base, Bound
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.dataset import GroundTruth
from slamhive.domain.protocol import Alignment
from slamhive.domain.sensors import SensorKind
from slamhive.packages.algorithm_file import load_algorithms, package_hash
from slamhive.packages.dataset_file import dataset_to_yaml, load_dataset
from slamhive.packages.image_context import dockerfile_of
from slamhive.packages.run_config import build_run_config
from slamhive.runtime.config import from_yaml, to_yaml
from tests.services.tiny_project import make_dataset, make_project

ROOT = Path(__file__).resolve().parents[2]


BOUNDS = "bounds: {track: {lidar: {poses: 5, ate_rmse_m: 0.2, alignment: se3, parameters: {seconds: 1}}}}\n"


def tiny(tmp_path: Path) -> Path:
    return make_project(tmp_path / "project") / "algorithms" / "tiny"


def test_a_dataset_comes_back_equal(tmp_path):
    dataset = make_dataset(tmp_path)
    assert load_dataset(dataset.folder) == dataset
    assert dataset_to_yaml(load_dataset(dataset.folder)) == dataset_to_yaml(dataset)


def test_a_reference_map_and_relations_come_back(tmp_path):
    truth = GroundTruth("groundtruth.txt", gravity_aligned=True, kitti_poses="groundtruth_kitti.txt")
    files: dict[str, Any] = {"groundtruth": truth, "reference_map": "room.pcd", "relations": "aces.relations"}
    dataset = replace(make_dataset(tmp_path), **files)
    (dataset.folder / "dataset.yaml").write_text(dataset_to_yaml(dataset))
    assert load_dataset(dataset.folder) == dataset


def test_the_prism_and_the_uncertainty_of_a_ground_truth_come_back(tmp_path):
    truth = GroundTruth(
        "groundtruth.txt",
        gravity_aligned=True,
        positions_only=True,
        lever_arm_m=(0.1, 0.0, 1.2),
        uncertainty_m=0.02,
        uncertainties="sigmas.txt",
        image_times="image_times.txt",
    )
    assert truth.files == ("groundtruth.txt", "sigmas.txt", "image_times.txt")
    dataset = replace(make_dataset(tmp_path), groundtruth=truth)
    text = dataset_to_yaml(dataset)
    (dataset.folder / "dataset.yaml").write_text(text)
    assert load_dataset(dataset.folder) == dataset
    for old, new, message in (
        ("positions_only: true", "positions_only: false", "lever_arm_m is for positions"),
        ("0.0, 1.2]", "0.0, 1200.5]", "lever_arm_m is longer than 1000 m"),
        ("sigmas.txt", "../sigmas.txt", "must be a plain file name"),
    ):
        (dataset.folder / "dataset.yaml").write_text(text.replace(old, new))
        with pytest.raises(InvalidInput, match=message):
            load_dataset(dataset.folder)


@pytest.mark.parametrize("key", ["reference_map", "relations"])
def test_a_reference_map_and_relations_lie_in_the_folder(tmp_path, key):
    outside: dict[str, Any] = {key: "../secret"}
    dataset = replace(make_dataset(tmp_path), **outside)
    (dataset.folder / "dataset.yaml").write_text(dataset_to_yaml(dataset))
    with pytest.raises(InvalidInput, match=f"{key.replace('_', ' ')} file '../secret' must be a plain file name"):
        load_dataset(dataset.folder)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bag: track.bag", "bag: ../../etc/passwd", "bag: must be a path inside the dataset folder"),
        ("file: groundtruth.txt", "file: ../x", "must be a plain file name"),
        ("file: groundtruth.txt", "file: a\n  kitti_poses: ../x", "KITTI poses file '../x' must be a plain file name"),
        ("kind: lidar", "kind: sonar", "sensors.0.kind"),
        ("rate_hz: 10.0", "rate_hz: -1", "sensors.0.rate_hz"),
        ("format: 1", "format: 2", "format"),
        ("topic: /points", "topic: 'a b'", "sensors.0.topic"),
        ("checksum: sha256:", "checksum: md5:", "checksum: must be sha256: and 64 hexadecimal digits"),
        ("rate_hz: 10.0", "rate_hz: .inf", "sensors.0.rate_hz: inf is not a finite number"),
        ("duration_s: ", "duration_s: .inf #", "duration_s: inf is not a finite number"),
        ("T_body_sensor: [1.0", "T_body_sensor: [.nan", "sensors.0.T_body_sensor.0: nan is not a finite number"),
        ("T_body_sensor: [1.0", "T_body_sensor: [1.01", "sensors.0.T_body_sensor: must be a rigid transform"),
        ("T_body_sensor: [1.0", "T_body_sensor: [-1.0", "sensors.0.T_body_sensor: must be a rigid transform"),
        ("T_body_sensor: [1.0", "T_body_sensor: [1.0, 1.0", "must have at most 16 entries, not 17"),
        ("title: ", "title: 1.0 #", "title: must be text; put it in quotes (found 1.0)"),
        ("title: ", "titel: x #", "unknown key 'titel'; did you mean 'title'?"),
        ("rate_hz: 10.0", "rate_hz: 10.0\n  rat: 1", "unknown key 'sensors.0.rat'; did you mean 'rate_hz'?"),
        ("calibration: ", "calibration: {x: {y: 1}} #", "sensors.0.calibration.x: has a type that is not allowed here"),
        ("- name: lidar", "- name: 'a b'", "sensor name 'a b' is not allowed"),
    ],
)
def test_a_wrong_dataset_file_names_the_place(tmp_path, old, new, message):
    folder = make_dataset(tmp_path).folder
    path = folder / "dataset.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InvalidInput) as caught:
        load_dataset(folder)
    assert message in str(caught.value)
    assert "dataset.yaml" in str(caught.value)


def test_two_sensors_of_one_name_are_refused(tmp_path):
    folder = make_dataset(tmp_path).folder
    path = folder / "dataset.yaml"
    text = path.read_text()
    sensor = text[text.index("- name: lidar") : text.index("groundtruth:")]
    path.write_text(text.replace(sensor, sensor + sensor))
    with pytest.raises(InvalidInput, match="two sensors have the name 'lidar'"):
        load_dataset(folder)


def test_two_modes_of_one_name_are_refused(tmp_path):
    folder = tiny(tmp_path)
    path = folder / "algorithm.yaml"
    text = path.read_text()
    mode = text[text.index("  lidar:") : text.index("parameters:")] + "    name: same\n"
    path.write_text(text.replace(mode.removesuffix("    name: same\n"), mode + mode.replace("  lidar:", "  other:")))
    with pytest.raises(InvalidInput, match="two modes have the name 'same'"):
        load_algorithms(folder)


def test_an_algorithm_is_read_with_its_parameters(tmp_path):
    (algorithm,) = load_algorithms(tiny(tmp_path))
    assert algorithm.name == "tiny"
    assert [parameter.key for parameter in algorithm.parameters] == ["seconds", "behaviour"]
    assert algorithm.inputs[0].kind is SensorKind.LIDAR


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("default: good", "default: best", "default of parameter behaviour='best' is not allowed"),
        ("trajectory_role: points", "trajectory_role: left", "trajectory_role 'left' is none of the inputs"),
        ("setup: lidar", "setup: radar", "setup"),
        ("package: tiny", "package: ../x", "name '../x'"),
        ("unit: s", "unit: s, colour: red", "unknown key 'parameters.seconds.colour'; known: choices, default"),
        ("trajectory_role: points", "trajectory_rol: points", "did you mean 'trajectory_role'?"),
        ("version: ", "version: 1.0 #", "version: must be text; put it in quotes (found 1.0)"),
        ("minimum: 0, maximum: 60", "minimum: 5, maximum: 1", "minimum 5 is larger than maximum 1"),
        ("unit: s", "unit: s, general: 'a b'", "general parameter name 'a b' is not allowed"),
        ("unit: s", "unit: s, general: behaviour", "the general name 'behaviour' of seconds is also that of behaviour"),
        ("default: 0.3", "default: .inf", "parameters.seconds.default: inf is not a finite number"),
        ("type: float, default: 0.3", "type: int, default: .nan", "parameters.seconds.default: nan is not a finite"),
        ("parameters:\n", "parameters:\n  a/b: {type: bool, default: true, help: x}\n", "parameter name 'a/b'"),
        ("inputs: {points: lidar}", "inputs: {points: lidar, 'a b': imu}", "role name 'a b' is not allowed"),
        ("  lidar:\n", "  li dar:\n", "mode name 'li dar' is not allowed"),
        ("package: tiny", "package: .x", "algorithm.yaml: package name '.x'"),
        ("format: 1", "format: 1\nimage: standard", "image: standard, but there is a Dockerfile"),
        ("format: 1", f"format: 1\n{BOUNDS}".replace("lidar", "ldar"), "bounds.track: the package has no mode 'ldar'"),
        ("format: 1", f"format: 1\n{BOUNDS}".replace("poses: 5", "poses: 0"), "bounds.track.lidar.poses: "),
        (
            "format: 1",
            f"format: 1\n{BOUNDS}".replace(", alignment: se3", ""),
            "bounds.track.lidar.alignment is missing",
        ),
        (
            "format: 1",
            f"format: 1\n{BOUNDS}".replace("ate_rmse_m: 0.2, ", ""),
            "bounds.track.lidar: give ate_rmse_m, or relations_m for a dataset without ground truth",
        ),
        ("format: 1", f"format: 1\n{BOUNDS}".replace("{seconds: 1}", "{second: 1}"), "has no parameter 'second'; did"),
        ("format: 1", f"format: 1\n{BOUNDS}".replace("{seconds: 1}", "{seconds: 99}"), "parameter seconds=99"),
        ("format: 1", f"format: 1\n{BOUNDS}".replace("track", "../x"), "dataset name '../x' is not allowed"),
    ],
)
def test_a_wrong_algorithm_file_names_the_place(tmp_path, old, new, message):
    folder = tiny(tmp_path)
    path = folder / "algorithm.yaml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises((InvalidInput, NotFound)) as caught:
        load_algorithms(folder)
    assert message in str(caught.value)


def test_a_standard_image_of_ros_needs_the_stage_that_compiles(tmp_path):
    folder = tiny(tmp_path)
    path = folder / "algorithm.yaml"
    path.write_text("base: ros1\nimage: standard\n" + path.read_text())
    (folder / "Dockerfile").unlink()
    with pytest.raises(InvalidInput, match=r"image: standard with base: ros1, but there is no compile\.Dockerfile"):
        load_algorithms(folder)
    (folder / "compile.Dockerfile").write_text("ARG BUILD_IMAGE\nARG RUN_IMAGE\nFROM ${BUILD_IMAGE} AS build\n")
    dockerfile = dockerfile_of(load_algorithms(folder)[0].package, ROOT)
    assert dockerfile is not None
    assert [line for line in dockerfile.splitlines() if line.startswith(("FROM", "COPY --from"))] == [
        "FROM ${BUILD_IMAGE} AS build",
        "FROM ${RUN_IMAGE}",
        "COPY --from=build /opt/ros1 /opt/ros1",
    ]


def test_bounds_are_read_with_sequential_playback_unless_stated(tmp_path):
    folder = tiny(tmp_path)
    path = folder / "algorithm.yaml"
    path.write_text(f"{BOUNDS}{path.read_text()}")
    (algorithm,) = load_algorithms(folder)
    (bound,) = algorithm.bounds
    assert bound == Bound("track", 5, 0.2, Alignment.SE3, Playback(PlaybackMode.SEQUENTIAL), {"seconds": 1.0})
    path.write_text(path.read_text().replace("se3,", "se3, playback_mode: realtime, playback_rate: 0.5,"))
    (algorithm,) = load_algorithms(folder)
    assert algorithm.bounds[0].playback == Playback(PlaybackMode.REALTIME, 0.5)


def test_an_offline_package_refuses_playback_in_real_time(tmp_path):
    folder = tiny(tmp_path)
    path = folder / "algorithm.yaml"
    path.write_text(path.read_text() + "\nplayback: [sequential]\n")
    (algorithm,) = load_algorithms(folder)
    algorithm.package.check_playback(Playback(PlaybackMode.SEQUENTIAL))
    with pytest.raises(InvalidInput, match="takes sequential playback only, not realtime; choose sequential"):
        algorithm.package.check_playback(Playback(PlaybackMode.REALTIME))


def test_a_package_without_its_mapping_script_is_refused(tmp_path):
    folder = tiny(tmp_path)
    (folder / "slamhive" / "mapping.py").unlink()
    with pytest.raises(InvalidInput, match=r"lacks slamhive/mapping\.py"):
        load_algorithms(folder)


def test_the_package_hash_sees_every_file(tmp_path):
    folder = tiny(tmp_path)
    before = package_hash(folder)
    (folder / "slamhive" / "mapping.py").write_text("pass\n")
    assert package_hash(folder) != before


def test_a_missing_sensor_is_said_before_anything_starts(tmp_path):
    dataset = make_dataset(tmp_path)
    stereo = next(a for a in load_algorithms(ROOT / "algorithms" / "orb-slam3") if a.name == "orb-slam3-stereo")
    with pytest.raises(InvalidInput, match="orb-slam3-stereo needs 2 camera sensors, dataset track has 0"):
        stereo.assign(dataset)


def test_the_run_configuration_names_topics_through_both_remaps(tmp_path):
    dataset = make_dataset(tmp_path)
    (algorithm,) = load_algorithms(tiny(tmp_path))
    configuration = Configuration("tiny", "track", {"seconds": 1.0, "behaviour": "good"})
    config = build_run_config(algorithm, dataset, configuration, run_id=3, seed=5)
    back = from_yaml(to_yaml(config))
    assert back.topic_in_bag("points") == "/points"
    assert back.parameters["points_rate_hz"] == 10.0
    assert back.algorithm_parameters["seconds"] == 1.0
    assert (back.run_id, back.seed, back.playback_mode) == (3, 5, "realtime")


@pytest.mark.parametrize("folder", sorted((ROOT / "algorithms").glob("*/algorithm.yaml")), ids=lambda p: p.parent.name)
def test_what_ships_is_valid_and_whole(folder):
    for algorithm in load_algorithms(folder.parent):
        assert algorithm.package.licence
        assert algorithm.package.upstream.startswith("https://")
        assert algorithm.package.citation
        assert all(parameter.help for parameter in algorithm.parameters)
    assert (folder.parent / "README.md").is_file()
    assert (folder.parent / "requirements.txt").is_file() or algorithm.package.base is not Base.PYTHON
    assert dockerfile_of(algorithm.package, ROOT) is not None


@pytest.mark.parametrize(
    "path", sorted((ROOT / "algorithms").glob("*/algorithm.yaml")), ids=lambda path: path.parent.name
)
def test_every_mode_of_every_package_states_its_trajectory(path: Path):
    unstated = [entry.mode for entry in load_algorithms(path.parent) if entry.trajectory is None]
    assert unstated == [], "write trajectory: live, final or keyframes"
