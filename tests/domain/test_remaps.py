"""Topics of published packages: bags are played under the names that the algorithm listens to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.documents.submission import Submission
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import match_of
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.run_config import build_run_config

HEAD = """
format: 1
package: vins
title: VINS
version: "1"
upstream: unknown
licence: unknown
citation: unknown
parameters:
  image0_topic: {type: string, default: /left, help: Topic of the camera.}
  imu_topic: {type: string, default: /imu, help: Topic of the IMU.}
  max_cnt: {type: int, required: true, help: Features.}
modes:
  inertial:
    title: VINS
    setup: mono-inertial
    inputs: {left: camera, imu: imu}
    trajectory_role: imu
"""
BY_PARAMETER = "    topics: {left: {parameter: image0_topic}, imu: {parameter: imu_topic}}\n"


def dataset(tmp_path: Path) -> Dataset:
    camera: dict[str, Any] = {"width": 752, "height": 480, "fx": 458.0, "fy": 457.0, "cx": 367.0, "cy": 248.0}
    sensors = (
        Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", 20.0, calibration=camera),
        Sensor("imu0", SensorKind.IMU, "/imu0", 200.0),
    )
    return Dataset("euroc", tmp_path, "euroc.bag", 10.0, sensors, None, "sha256:0")


def config(tmp_path: Path, text: str, **parameters: str):
    (tmp_path / "slamhive").mkdir(exist_ok=True)
    (tmp_path / "slamhive" / "mapping.py").touch()
    (tmp_path / "algorithm.yaml").write_text(HEAD + text)
    (algorithm,) = load_algorithms(tmp_path)
    submission = Submission(algorithm="vins", dataset="euroc", parameters={"max_cnt": 150, **parameters})
    configuration = submission.configuration(algorithm)
    return build_run_config(algorithm, dataset(tmp_path), configuration, None, 0)


def test_without_topics_roles_are_topics(tmp_path):
    made = config(tmp_path, "")
    assert made.algorithm_remap == {"left": "/left", "imu": "/imu"}
    assert made.dataset_remap == {"/left": "/cam0/image_raw", "/imu": "/imu0"}


def test_parameters_that_name_topics_and_the_recording_agree(tmp_path):
    made = config(tmp_path, BY_PARAMETER)
    assert made.algorithm_parameters["image0_topic"] == "/left"
    assert made.dataset_remap == {"/left": "/cam0/image_raw", "/imu": "/imu0"}
    assert made.algorithm_remap == {}


def test_a_published_topic_name_renames_the_recording_instead(tmp_path):
    made = config(tmp_path, BY_PARAMETER, image0_topic="/cam0/image_raw")
    assert made.algorithm_parameters["image0_topic"] == "/cam0/image_raw"
    assert made.dataset_remap == {"/cam0/image_raw": "/cam0/image_raw", "/imu": "/imu0"}


def test_only_launch_arguments_that_exist_are_passed_on(tmp_path):
    made = config(tmp_path, "    topics: {left: {argument: mono_topic}, imu: {fixed: /imu_raw}}\n")
    assert made.algorithm_remap == {"mono_topic": "/left"}
    assert made.dataset_remap == {"/left": "/cam0/image_raw", "/imu_raw": "/imu0"}


def test_remaps_are_said(tmp_path):
    config(tmp_path, "    topics: {left: {argument: mono_topic}, imu: {fixed: /imu_raw}}\n")
    (algorithm,) = load_algorithms(tmp_path)
    words = [entry.words for entry in match_of(algorithm, dataset(tmp_path), {"max_cnt": 1}).remaps]
    assert words == [
        "/cam0/image_raw is played as /left (launch argument mono_topic)",
        "/imu0 is played as /imu_raw (fixed in the package)",
    ]


@pytest.mark.parametrize(
    ("topics", "problem"),
    [
        ("{left: {fixed: /a}, imu: {fixed: /a}}", "left and imu on one topic, /a"),
        ("{left: {parameter: nothing}}", "names parameter 'nothing'"),
        ("{left: {fixed: /a, argument: b}}", "one of fixed, argument and parameter"),
        ("{right: {fixed: /a}}", "'right' is none of the inputs"),
        ("{left: {fixed: 'a; rm -rf /'}}", "topics"),
    ],
)
def test_topics_that_make_no_sense_are_refused(tmp_path, topics, problem):
    with pytest.raises(InvalidInput, match=problem):
        config(tmp_path, f"    topics: {topics}\n")


def test_a_value_that_nobody_knows_has_to_be_given(tmp_path):
    with pytest.raises(InvalidInput, match=r"vins needs max_cnt: no default is known; --set max_cnt=VALUE, or add"):
        config(tmp_path, "", max_cnt="")
    (algorithm,) = load_algorithms(tmp_path)
    assert algorithm.parameters[2].must_be_given
