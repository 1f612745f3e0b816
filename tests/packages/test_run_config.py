"""config.yaml of a run: what the algorithm is told of its sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode, VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter, ParameterType, parse_settings
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.run_config import build_run_config
from slamhive.runtime.config import from_yaml, to_yaml

PACKAGES = ("kiss-icp", "orb-slam3", "rko-lio")
INTRINSICS: dict[str, float | int | str | tuple[float, ...]] = {
    "width": 640,
    "height": 480,
    "fx": 420.0,
    "encoding": "mono8",
}


def algorithm(name: str) -> Algorithm:
    found = {
        entry.name: entry for package in PACKAGES for entry in load_algorithms(project_root() / "algorithms" / package)
    }
    return found[name]


def dataset(*sensors: Sensor) -> Dataset:
    return Dataset("room", Path("room"), "room.bag", 1.0, sensors, None, "sha256:" + "0" * 64, attributes=("indoor",))


def configuration(entry: Algorithm) -> Configuration:
    values = parse_settings(entry.name, entry.parameters, {})
    return Configuration(entry.name, "room", values, Playback(PlaybackMode.SEQUENTIAL, 2.0))


def test_every_sensor_is_described_under_its_role() -> None:
    entry = algorithm("orb-slam3-stereo")
    left = Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", 20.0, calibration=INTRINSICS)
    right = Sensor("cam1", SensorKind.CAMERA, "/cam1/image_raw", 20.0, calibration=INTRINSICS)
    config = build_run_config(entry, dataset(left, right), configuration(entry), run_id=7, seed=3)
    assert config.parameters["left_fx"] == 420.0
    assert config.parameters["right_rate_hz"] == 20.0
    assert len(config.parameters["left_T_body_sensor"]) == 16
    assert config.parameters["nFeatures"] == 1200
    assert list(config.algorithm_remap) == ["left", "right"]
    assert config.topic_in_bag("right") == "/cam1/image_raw"
    assert (config.run_id, config.seed, config.playback_mode, config.playback_rate) == (7, 3, "sequential", 2.0)


def test_a_variant_is_told_by_its_own_calibration_and_by_its_factors() -> None:
    entry = algorithm("orb-slam3-stereo")
    left, right = (
        Sensor(f"cam{number}", SensorKind.CAMERA, f"/cam{number}", 20.0, calibration=INTRINSICS) for number in (0, 1)
    )
    smaller = {**INTRINSICS, "width": 512, "height": 384, "fx": 336.0}
    variant = (
        VariantStep("resolution", ("cam0",), {"scale": 0.8, "interpolation": "area"}),
        VariantStep("rate", ("cam0",), {"hz": 7.0}),
        VariantStep("gaussian_noise", ("cam0", "cam1"), {"sigma": 3.0, "seed": 1}),
    )
    seen = dataset(replace(left, rate_hz=7.0, calibration=smaller), right)
    asked = replace(configuration(entry), variant=variant)
    config = build_run_config(entry, seen, asked, 7, 3, dataset(left, right))
    assert config.dataset_frequency == {"/cam0": 3, "/cam1": 1}
    assert config.dataset_resolution == {"/cam0": 0.8, "/cam1": 1.0}
    assert (config.parameters["left_fx"], config.parameters["left_rate_hz"]) == (336.0, 7.0)
    assert config.parameters["right_fx"] == 420.0


def test_it_survives_being_written_and_read() -> None:
    entry = algorithm("rko-lio")
    sensors = (
        Sensor("l", SensorKind.LIDAR, "/points", 10.0, calibration={"stamp": "start", "point_time_field": "t"}),
        Sensor("i", SensorKind.IMU, "/imu", 200.0),
    )
    config = build_run_config(entry, dataset(*sensors), configuration(entry), run_id=1, seed=1)
    back = from_yaml(to_yaml(config))
    assert to_yaml(back) == to_yaml(config)
    assert back.parameters["points_stamp"] == "start"


def test_general_names_stand_in_their_section_beside_the_own_keys() -> None:
    entry = algorithm("kiss-icp")
    saving = Parameter("store_the_map", ParameterType.BOOL, False, "", general="save_map")
    entry = replace(entry, parameters=(*entry.parameters, saving))
    sensor = Sensor("l", SensorKind.LIDAR, "/points", 10.0)
    asked = replace(configuration(entry), parameters={**configuration(entry).parameters, "store_the_map": True})
    config = build_run_config(entry, dataset(sensor), asked, run_id=1, seed=1)
    assert config.general_parameter["voxel_size"] == config.algorithm_parameters["voxel_size"]
    assert config.general_parameter["save_map"] is True
    without = build_run_config(algorithm("kiss-icp"), dataset(sensor), configuration(algorithm("kiss-icp")), 1, 1)
    assert without.general_parameter["save_map"] == 0
    assert from_yaml(to_yaml(config)).general_parameter == config.general_parameter


def test_a_missing_sensor_is_named_before_anything_starts() -> None:
    entry = algorithm("kiss-icp")
    with pytest.raises(InvalidInput, match="kiss-icp needs 1 lidar sensor, dataset room has 0"):
        build_run_config(entry, dataset(), configuration(entry), run_id=1, seed=1)


def test_the_shipped_packages_list_every_mode_as_an_algorithm() -> None:
    names = {entry.name for package in PACKAGES for entry in load_algorithms(project_root() / "algorithms" / package)}
    modes = {f"orb-slam3-{mode}" for mode in ("mono", "stereo", "rgbd", "mono-inertial", "stereo-inertial")}
    assert names == modes | {"kiss-icp", "rko-lio"}
