from __future__ import annotations

from dataclasses import replace

import pytest

from slamhive.base.errors import SlamHiveError
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode, VariantStep
from slamhive.experiments.configuration_file import configuration_from_yaml, configuration_to_yaml
from slamhive.packages.run_config import build_run_config
from slamhive.runtime.config import to_yaml
from tests.experiments.sweep_world import ROOM, view

CONFIGURATION = Configuration(
    "stereo",
    "room",
    {"nFeatures": 900, "scaleFactor": 1.5},
    Playback(PlaybackMode.SEQUENTIAL, 2.0),
    (
        VariantStep("rate", ("cam0", "cam1"), {"hz": 10.0}),
        VariantStep("noise_gaussian", ("cam0",), {"stddev": 5.0, "seed": 1.0}),
    ),
)

PUBLISHED = """slam-hive-algorithm: stereo
slam-hive-dataset: room
algorithm-parameters:
  nFeatures: 900
  viewer: 0
dataset-parameters:
  scaleFactor: 1.5
  fps: 10
  LEFT_K: [1, 0, 0]
algorithm-remap:
  stereo_left: /left
dataset-remap:
dataset-frequency:
  /cam0: 2
  /cam1: 2
  /imu0: 1
dataset-resolution:
  /cam0: 0.5
  /cam1: 1.0
general-parameter:
  save_map: 1
algorithm-attribute:
dataset-attribute:
"""


def test_what_is_exported_comes_back_equal():
    text = configuration_to_yaml(CONFIGURATION)
    imported = configuration_from_yaml(text, view())
    assert imported.configuration == CONFIGURATION
    assert imported.configuration.content_hash == CONFIGURATION.content_hash
    assert imported.notes == ()
    assert configuration_to_yaml(imported.configuration) == text


def test_what_is_left_out_has_its_default():
    imported = configuration_from_yaml("algorithm: icp\ndataset: room\n", view())
    assert imported.configuration == Configuration("icp", "room", {"voxel": 0.3, "deskew": True})


def test_steps_that_change_nothing_are_dropped():
    text = "algorithm: icp\ndataset: room\nvariant:\n  - {step: rate, sensors: [lidar0], every: 1}\n"
    assert configuration_from_yaml(text, view()).configuration.variant == ()


def test_a_published_configuration_becomes_steps_and_parameters():
    imported = configuration_from_yaml(PUBLISHED, view(), "config.yaml")
    assert imported.configuration == Configuration(
        "stereo",
        "room",
        {"nFeatures": 900, "scaleFactor": 1.5},
        variant=(
            VariantStep("rate", ("cam0", "cam1"), {"every": 2.0}),
            VariantStep("resolution", ("cam0",), {"scale": 0.5}),
        ),
    )


def test_a_depth_image_is_scaled_with_the_camera_whose_pixels_it_shares():
    shared = {"depth0": {"registered_to": "cam0"}}
    sensors = tuple(
        replace(sensor, calibration={**sensor.calibration, **shared.get(sensor.name, {})}) for sensor in ROOM.sensors
    )
    imported = configuration_from_yaml(PUBLISHED, view(datasets=[replace(ROOM, sensors=sensors)]))
    assert imported.configuration.variant[-1] == VariantStep("resolution", ("cam0", "depth0"), {"scale": 0.5})


def test_what_is_not_taken_over_is_told():
    notes = configuration_from_yaml(PUBLISHED, view()).notes
    assert notes == (
        "algorithm-parameters viewer=0 is not taken over: stereo has no such parameter",
        "dataset-parameters fps=10 is not taken over: the dataset describes itself",
        "dataset-parameters LEFT_K=[1, 0, 0] is not taken over: the dataset describes itself",
        "general-parameter save_map=1 is not taken over: stereo does not know it",
        "algorithm-remap stereo_left=/left is not taken over: sensors are assigned by role",
    )


def test_our_own_config_yaml_is_taken_over_whole():
    catalogue = view()
    stereo, room = catalogue.algorithms["stereo"], catalogue.datasets["room"]
    configuration = Configuration("stereo", "room", {"nFeatures": 900, "scaleFactor": 1.5})
    text = to_yaml(build_run_config(stereo, room, configuration, run_id=3, seed=7))
    imported = configuration_from_yaml(text, catalogue)
    assert imported.configuration == configuration
    assert imported.seed == 7
    assert imported.notes == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("algorithm: sterio\ndataset: room\n", "c.yaml: unknown algorithm 'sterio'; did you mean 'stereo'?"),
        ("algorithm: stereo\ndataset: rom\n", "c.yaml: unknown dataset 'rom'; did you mean 'room'?"),
        ("algorithm: stereo\n", "c.yaml: dataset"),
        ("algorithm: stereo\ndataset: room\nparameters: {feature: 900}\n", "did you mean 'features'?"),
        ("algorithm: stereo\ndataset: room\nparameters: {nFeatures: 1}\n", "c.yaml: parameter nFeatures=1 is not"),
        ("algorithm: stereo\ndataset: room\nspeed: 3\n", "speed"),
        ("algorithm: stereo\ndataset: room\nplayback: {rate: 0}\n", "c.yaml: playback.rate"),
        (
            "algorithm: stereo\ndataset: room\nvariant: [{step: rate, sensors: [cam9], every: 2}]\n",
            "did you mean 'cam1'?",
        ),
        (PUBLISHED.replace("/cam1: 2", "/cam9: 2"), "c.yaml: unknown topic of dataset room '/cam9'; did you mean"),
        (PUBLISHED.replace("/cam0: 0.5", "/cam0: 1.5"), "c.yaml: step resolution: scale 1.5 is outside (0, 1]"),
        (PUBLISHED.replace("nFeatures: 900", "nFeatures: many"), "c.yaml: parameter nFeatures='many' is not allowed"),
        (PUBLISHED.replace("slam-hive-dataset: room", ""), "c.yaml: slam-hive-dataset is missing"),
        (PUBLISHED + "slam-hive: {playback: {mode: fast}}\n", "c.yaml: playback mode 'fast' is not known"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(text, message):
    with pytest.raises(SlamHiveError) as caught:
        configuration_from_yaml(text, view(), "c.yaml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
