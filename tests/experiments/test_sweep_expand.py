from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from slamhive.domain.configuration import Configuration, Playback, PlaybackMode, VariantStep
from slamhive.experiments.binding import Filter
from slamhive.experiments.expansion import count, expand
from slamhive.experiments.file import parse_experiment
from tests.experiments.sweep_world import CAMERA, EUROC, FEATURES, IMU, MONO, ROOM, STEREO, algorithm, dataset, view

STEREO_ON_ROOM = "name: t\nalgorithms: stereo\ndatasets: room\n"
CONDITIONS = [
    "image_rate >= 2",
    "image_rate > 4 or features > 500",
    "not image_resolution == 1 or algorithm == icp",
]
RATES = "steps:\n  image_rate: {step: rate, sensors: camera, hz: 20 | 10 | 5}\n"


def plan(text, catalogue=None):
    return list(expand(parse_experiment(text), catalogue or view()))


def test_the_product_comes_in_a_fixed_order_with_fixed_names():
    text = STEREO_ON_ROOM + RATES + "parameters:\n  features: 500 | 1000\n"
    runs = plan(text)
    assert [(run.name, run.values["image_rate"], run.values["features"]) for run in runs] == [
        ("t-0001", 20, 500),
        ("t-0002", 20, 1000),
        ("t-0003", 10, 500),
        ("t-0004", 10, 1000),
        ("t-0005", 5, 500),
        ("t-0006", 5, 1000),
    ]
    assert runs == plan(text)


def test_a_configuration_holds_every_parameter_typed_and_the_variant():
    run = plan(STEREO_ON_ROOM + RATES + "parameters:\n  scaleFactor: 2\n")[1]
    assert run.configuration == Configuration(
        "stereo",
        "room",
        {"nFeatures": 1200, "scaleFactor": 2.0},
        Playback(PlaybackMode.REALTIME, 1.0),
        (VariantStep("rate", ("cam0", "cam1"), {"hz": 10.0}),),
    )
    assert type(run.configuration.parameters["scaleFactor"]) is float
    assert run.content_hash == run.configuration.content_hash


def test_all_configurations_of_an_expansion_have_the_hash_of_their_content():
    varied = "parameters:\n  features: 500 | 1000\n  scaleFactor: 1.1 | 1.5 | 2\nplayback: {rate: 1 | 0.5}\n"
    runs = plan(STEREO_ON_ROOM + RATES + varied)
    assert len({run.content_hash for run in runs}) == len(runs) == 36
    assert [run.content_hash for run in runs] == [run.configuration.content_hash for run in runs]


def test_conditions_are_asked_once_for_each_combination_that_they_read(monkeypatch):
    asked = []
    excludes = Filter.excludes

    def note(conditions, context):
        asked.append(context.get("image_rate"))
        return excludes(conditions, context)

    monkeypatch.setattr(Filter, "excludes", note)
    varied = "parameters:\n  features: 500 | 1000\n  scaleFactor: 1.1 | 1.5 | 2\nwhere: image_rate >= 10\n"
    runs = plan(STEREO_ON_ROOM + RATES + varied)
    assert [run.values["image_rate"] for run in runs] == [20] * 6 + [10] * 6
    assert asked[1:] == [20, 10, 5] * 2, "once for the pair, then for the count and for the runs"


@pytest.mark.parametrize(
    ("text", "flags"), [("[yes, no]", [True, False]), ("off", [False]), ("On | false", [True, False])]
)
def test_the_declared_type_reads_yes_and_no_as_truth_values(text, flags):
    runs = plan(f"name: t\nalgorithms: icp\ndatasets: room\nparameters:\n  deskew: {text}\nevaluate: no\n")
    assert [run.configuration.parameters["deskew"] for run in runs] == flags


def test_an_experiment_that_was_stored_when_no_meant_false_is_still_the_same():
    text = "name: t\nalgorithms: icp\ndatasets: room\nparameters:\n  deskew: [{}, {}]\n"
    stored = parse_experiment(text.format("true", "false")).content_hash
    assert parse_experiment(text.format("yes", "Off")).has_hash(stored)
    assert not parse_experiment(text.format("no", "yes")).has_hash(stored)


def test_the_identity_is_the_dataset_itself():
    runs = plan(
        STEREO_ON_ROOM + "steps:\n  r: {step: rate, sensors: camera, every: 1}\n"
        "  s: {step: resolution, sensors: camera, scale: 1.0}\n  n: {step: noise_gaussian, sensors: left, stddev: 0}\n"
    )
    assert [run.configuration.variant for run in runs] == [()]
    assert count(parse_experiment(STEREO_ON_ROOM + RATES), view()).variants == 2


def test_identical_configurations_come_once_and_are_counted():
    text = STEREO_ON_ROOM + "steps:\n  n: {step: noise_gaussian, sensors: camera, stddev: 0 | 5, seed: 1 | 2}\n"
    expansion = expand(parse_experiment(text), view())
    runs = list(expansion)
    assert expansion.size.configurations == 4
    assert len(runs) == 3
    assert expansion.merged == 1
    assert [run.name for run in runs] == ["t-0001", "t-0002", "t-0003"]


def test_steps_keep_their_order():
    first = "  a: {step: rate, sensors: camera, hz: 10}\n"
    second = "  b: {step: resolution, sensors: camera, scale: 0.5}\n"
    one = plan(STEREO_ON_ROOM + "steps:\n" + first + second)[0].configuration
    other = plan(STEREO_ON_ROOM + "steps:\n" + second + first)[0].configuration
    assert [step.kind for step in one.variant] == ["rate", "resolution"]
    assert [step.kind for step in other.variant] == ["resolution", "rate"]
    assert one.content_hash != other.content_hash


def test_a_step_sees_what_the_one_before_has_left():
    text = STEREO_ON_ROOM + (
        "steps:\n  a: {step: rate, sensors: camera, hz: 10}\n  b: {step: rate, sensors: camera, hz: 10}\n"
    )
    assert len(plan(text)[0].configuration.variant) == 1


def test_one_general_name_sets_each_algorithms_own_key():
    other = algorithm("vins", MONO, replace(FEATURES, key="max_cnt"))
    catalogue = view([view().algorithms["mono"], other, view().algorithms["icp"]])
    text = "name: t\nalgorithms: mono | vins | icp\ndatasets: room\nparameters:\n  features: 500 | 700\n"
    runs = plan(text, catalogue)
    assert [(run.configuration.algorithm, run.values.get("features")) for run in runs] == [
        ("mono", 500),
        ("mono", 700),
        ("vins", 500),
        ("vins", 700),
        ("icp", None),
    ]


def test_values_below_an_algorithm_are_for_it_alone():
    text = (
        "name: t\nalgorithms: mono | stereo\ndatasets: room\n"
        "parameters:\n  stereo: {nFeatures: 500 | 700}\n  scaleFactor: 1.5\n"
    )
    runs = plan(text)
    assert [run.configuration.parameters for run in runs] == [
        {"nFeatures": 1200, "scaleFactor": 1.5},
        {"nFeatures": 500, "scaleFactor": 1.5},
        {"nFeatures": 700, "scaleFactor": 1.5},
    ]


def test_a_kind_means_the_sensors_that_the_algorithm_listens_to():
    steps = "steps:\n  r: {step: rate, sensors: [image, imu, lidar], every: 2}\n"
    text = "name: t\nalgorithms: mono | icp\ndatasets: room\n" + steps
    assert [run.configuration.variant[0].sensors for run in plan(text)] == [("cam0", "cam1"), ("lidar0",)]


@pytest.mark.parametrize(
    ("sensors", "treated"),
    [
        ("camera", ("cam0", "cam1")),
        ("left", ("cam0",)),
        ("right", ("cam1",)),
        ("left | right", ("cam0", "cam1")),
        ("cam1", ("cam1",)),
        ("/cam0", ("cam0",)),
        ("imu0", ("imu0",)),
    ],
)
def test_sensors_are_named_by_kind_role_name_or_topic(sensors, treated):
    text = STEREO_ON_ROOM + f"steps:\n  r: {{step: rate, sensors: {sensors}, every: 2}}\n"
    assert plan(text)[0].configuration.variant[0].sensors == treated


def test_left_and_right_apart_can_be_tied():
    apart = STEREO_ON_ROOM + (
        "steps:\n  left_rate: {step: rate, sensors: left, hz: 20 | 10}\n"
        "  right_rate: {step: rate, sensors: right, hz: 20 | 10}\n"
    )
    assert len(plan(apart)) == 4
    tied = plan(apart + "tied:\n  - [left_rate, right_rate]\n")
    assert [(run.values["left_rate"], run.values["right_rate"]) for run in tied] == [(20, 20), (10, 10)]


def test_linked_values_move_together():
    text = STEREO_ON_ROOM + RATES + "parameters:\n  features: 2000 | 1000 | 500\nlinked:\n  - [image_rate, features]\n"
    assert [(run.values["image_rate"], run.values["features"]) for run in plan(text)] == [
        (20, 2000),
        (10, 1000),
        (5, 500),
    ]


def test_options_that_both_vary_have_names_of_their_own_and_can_be_linked():
    text = STEREO_ON_ROOM + (
        "steps:\n  n: {step: noise_gaussian, sensors: camera, stddev: 5 | 9, seed: 1 | 2}\n"
        "linked: [[n.stddev, n.seed]]\n"
    )
    assert [run.configuration.variant[0].options for run in plan(text)] == [
        {"stddev": 5.0, "seed": 1.0},
        {"stddev": 9.0, "seed": 2.0},
    ]


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("image_rate >= 10", 4),
        ("image_rate.hz >= 10", 4),
        ("image_rate >= 10 or nFeatures == 500", 5),
        ("features == 500", 3),
        ("scaleFactor > 1", 6),
        ("playback_mode == realtime", 6),
        ("algorithm == stereo and dataset == room", 6),
    ],
)
def test_conditions_know_axes_parameters_and_defaults(where, expected):
    text = STEREO_ON_ROOM + RATES + f"parameters:\n  features: 500 | 1000\nwhere: {where}\n"
    assert count(parse_experiment(text), view()).configurations == expected
    assert len(plan(text)) == expected


def test_several_conditions_must_all_hold():
    text = STEREO_ON_ROOM + RATES + "where:\n  - image_rate > 5\n  - image_rate < 20\n"
    assert [run.values["image_rate"] for run in plan(text)] == [10]


def test_a_condition_about_other_algorithms_keeps_this_one():
    text = "name: t\nalgorithms: stereo | icp\ndatasets: room\n" + RATES + "where: image_rate > 5\n"
    assert [run.configuration.algorithm for run in plan(text)] == ["stereo", "stereo", "icp"]


def test_a_condition_can_keep_apart_what_does_not_fit():
    slow = dataset("slow", ("cam0", CAMERA, 10), ("imu0", IMU, 100))
    text = (
        "name: t\nalgorithms: mono | icp\ndatasets: room | slow\n" + RATES + "where:\n"
        "  - not (algorithm == icp and dataset == slow)\n  - dataset == room or image_rate <= 10\n"
    )
    runs = plan(text, view(datasets=[ROOM, slow]))
    assert [(run.configuration.algorithm, run.configuration.dataset) for run in runs].count(("mono", "slow")) == 2
    assert len(runs) == 6


def test_seeds_and_repeats_make_runs_of_one_configuration():
    runs = plan(STEREO_ON_ROOM + "seeds: 3 | 7\nrepeats: 2\n")
    assert [(run.number, run.name, run.seed, run.repeat) for run in runs] == [
        (1, "t-0001", 3, 1),
        (2, "t-0001", 3, 2),
        (3, "t-0001", 7, 1),
        (4, "t-0001", 7, 2),
    ]
    assert len({run.content_hash for run in runs}) == 1


def test_playback_can_vary():
    runs = plan(STEREO_ON_ROOM + "playback: {mode: realtime | sequential, rate: 1 | 2}\n")
    assert [(run.configuration.playback.mode.value, run.configuration.playback.rate) for run in runs] == list(
        itertools.product(["realtime", "sequential"], [1.0, 2.0])
    )


def test_the_count_says_what_varies():
    text = "name: t\nalgorithms: mono | stereo\ndatasets: room\n" + RATES + "where: image_rate < 20\nrepeats: 3\n"
    size = count(parse_experiment(text), view())
    assert (size.combinations, size.configurations, size.runs, size.variants) == (6, 4, 12, 2)
    assert size.axes == {"algorithm": 2, "image_rate": 3}


def test_variants_are_shared_by_algorithms():
    algorithms = [algorithm("one", STEREO), algorithm("two", MONO)]
    text = "name: t\nalgorithms: one | two\ndatasets: MH_01 | MH_02\n" + RATES
    assert count(parse_experiment(text), view(algorithms, EUROC)).variants == 4
