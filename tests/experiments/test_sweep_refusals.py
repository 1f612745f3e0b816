"""Everything that an experiment can get wrong is told in one line with file and line, before anything is stored."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.configuration import PlaybackMode
from slamhive.experiments.expansion import count, expand
from slamhive.experiments.file import parse_experiment
from tests.experiments.sweep_world import CAMERA, algorithm, dataset, view

HEAD = "name: t\nalgorithms: mono | stereo\ndatasets: room\n"
RATE = "steps:\n  r:\n    step: rate\n    sensors: camera\n    hz: 20 | 10\n"


def refusal(text: str, **options) -> str:
    with pytest.raises(SlamHiveError) as caught:
        expand(parse_experiment(text, "e.yaml"), view(), **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + RATE.replace("20 | 10", "20 | | 10"), "e.yaml line 8: steps.r.hz: '20 | | 10' holds an empty value"),
        (HEAD + RATE.replace("20 | 10", "[]"), "e.yaml line 8: steps.r.hz: [] holds no value"),
        (HEAD + RATE.replace("20 | 10", "10 | 10"), "e.yaml line 8: steps.r.hz: the value 10 is given twice"),
        (HEAD + RATE.replace("20 | 10", "40"), "e.yaml line 8: step r on dataset room: step rate: 40 Hz is above"),
        (HEAD + RATE.replace("camera", "cam7"), "e.yaml line 5: unknown sensor or topic of dataset room 'cam7'"),
        (HEAD + RATE.replace("camera", "/cam"), "did you mean '/cam1'?"),
        (HEAD + RATE.replace("camera", "lidar"), "e.yaml line 5: step r treats no sensor"),
        (HEAD + RATE.replace("camera", "3"), "e.yaml line 7: steps.r.sensors: expected names, found 3"),
        (HEAD + RATE.replace("step: rate", "step: rat"), "unknown pre-processing step 'rat'; did you mean 'rate'?"),
        (HEAD + RATE.replace("hz:", "herz:"), "e.yaml line 8: unknown option of step rate 'herz'; did you mean 'hz'?"),
        (HEAD + RATE.replace("    step: rate\n", ""), "e.yaml line 5: steps.r.step is missing"),
        (HEAD + RATE.replace("r:\n", "algorithm:\n"), "e.yaml line 8: the name 'algorithm' is taken"),
        (HEAD + "steps:\n  r: {step: resolution, sensors: imu0, scale: .5}\n", "imu0 is not an image"),
        (HEAD + "steps:\n  r: {step: resolution, sensors: left, scale: 1.5}\n", "scale 1.5 is outside (0, 1]"),
        (HEAD + "steps:\n  r: {step: resolution, sensors: left, scale: 0}\n", "scale 0 is outside (0, 1]"),
        (HEAD.replace("mono |", "mno |"), "e.yaml line 2: unknown algorithm 'mno'; did you mean 'mono'?"),
        (HEAD.replace("room", "rom"), "e.yaml line 3: unknown dataset 'rom'; did you mean 'room'?"),
        (HEAD.replace("room", "[1]"), "e.yaml line 3: datasets: expected names"),
        (HEAD.replace("room", "room | room"), "e.yaml line 3: datasets: a name is given twice"),
        (HEAD + "parameters:\n  nFeatues: 500\n", "e.yaml line 5: unknown parameter of mono, stereo 'nFeatues'; did"),
        (HEAD + "parameters:\n  features: 5 | 500\n", "e.yaml line 5: parameter nFeatures=5 is not allowed"),
        (HEAD + "parameters:\n  features: 500\n  nFeatures: 600\n", "e.yaml line 6: features and nFeatures both set"),
        (HEAD + "parameters:\n  mono:\n    features: x\n", "e.yaml line 6: parameter nFeatures='x' is not allowed"),
        (HEAD + "parameters:\n  mno: {features: 500}\n", "unknown algorithm of this experiment 'mno'"),
        (HEAD + "parameters:\n  features: 500 | 500.0\n", "e.yaml line 5: the value 500 is given twice"),
        (HEAD + RATE + "parameters:\n  r: 3\n", "e.yaml line 10: the name 'r' is already that of e.yaml line 8"),
        (HEAD + RATE.replace("  r:", "  features:") + "parameters:\n  features: 500\n",
         "e.yaml line 10: the name 'features' is already that of e.yaml line 8"),
        (HEAD + RATE + "parameters:\n  features: 1:3\nlinked:\n  - [r, features]\n",
         "e.yaml line 12: linked axes need equally many values; r has 2, features has 3"),
        (HEAD + RATE + "parameters:\n  features: 1:3\ntied:\n  - [r, features]\n",
         "e.yaml line 12: tied axes need equally many values"),
        (HEAD + RATE + "parameters:\n  features: 500 | 600\ntied:\n  - [r, features]\n", "tied axes need the same"),
        (HEAD + RATE + "linked:\n  - [r]\n", "e.yaml line 10: linked needs two axes or more"),
        (HEAD + RATE + "linked:\n  - [r, rr]\n", "e.yaml line 10: unknown axis 'rr'; did you mean 'r'?"),
        (HEAD + RATE + "linked: [[r, r]]\n", "e.yaml line 9: r is linked or tied more than once"),
        (HEAD + RATE + "where: r >= 30\n", "e.yaml line 9: the condition (r >= 30) removes every combination"),
        (HEAD + "where: dataset == nowhere\n", "e.yaml line 4: the condition (dataset == nowhere) removes every"),
        (HEAD + RATE + "where:\n  - r > 5\n  - rr >= 3\n", "e.yaml line 11: unknown name in the condition 'rr'; did"),
        (HEAD + "where: dataset > 5\n", "e.yaml line 4: 'room' > 5 compares text with a number"),
        (HEAD + "where: r >=\n", "e.yaml line 4: where: the condition 'r >=' has its end where"),
        (HEAD + "where: 5\n", "e.yaml line 4: where: expected a condition"),
        (HEAD + "seeds: -1\n", "e.yaml line 4: seeds: seeds are integers from 0"),
        (HEAD + "repeats: 0\n", "e.yaml line 4: repeats: must be greater than or equal to 1 (found 0)"),
        (HEAD + "stopwhen: 1\n", "e.yaml line 4: unknown key 'stopwhen'; did you mean 'stop_when'?"),
        (HEAD + "stop_when:\n  memory: 1\n", "e.yaml line 5: unknown key 'stop_when.memory'; did you mean 'memory_m"),
        (HEAD + "playback: {mode: fast}\n", "e.yaml line 4: playback.mode: 'fast' is none of realtime, sequential"),
        (HEAD + "playback: {rate: 0}\n", "playback rates are numbers from 0.01 to 100"),
        (HEAD + "evaluate: {alignment: x}\n", "e.yaml line 4: evaluate.alignment: must be 'none', 'first_pose', 'se3'"),
        ("algorithms: mono\ndatasets: room\n", "e.yaml: name is missing"),
        (HEAD.replace("name: t", "name: ../t"), "e.yaml line 1: name: experiment name '../t' is not"),
        (HEAD.replace("name: t", "name: a..b"), "e.yaml line 1: name: experiment name 'a..b' is not allowed"),
        (HEAD + RATE.replace("20 | 10", "[[20, 10]]"), "e.yaml line 8: r holds a list within a list"),
        (HEAD + RATE.replace("20 | 10", "fast"), "e.yaml line 8: step r on dataset room"),
        (HEAD + "parameters:\n  ' x': 3\n", "' x' is not a name"),
        (HEAD + "repeats: 1000\nseeds: 0:1999\n", "1000 repeats are 4,000,000 runs, more than the limit of 1,000,000"),
        (HEAD + "  bad\n: x", "e.yaml line"),
    ],
)  # fmt: skip
def test_mistakes_name_the_place_and_the_remedy(text, message):
    assert message in refusal(text)


def test_an_algorithm_that_lacks_a_sensor_is_told_with_the_place():
    text = "name: t\nalgorithms: stereo\ndatasets: one-eyed\n"
    catalogue = view(datasets=[dataset("one-eyed", ("cam0", CAMERA, 20))])
    with pytest.raises(InvalidInput, match=r"e\.yaml line 3: stereo needs 2 camera sensors, dataset one-eyed has 1"):
        count(parse_experiment(text, "e.yaml"), catalogue)


def test_an_offline_algorithm_needs_sequential_playback():
    offline = algorithm("offline", {"left": CAMERA})
    offline = replace(offline, package=replace(offline.package, playback=(PlaybackMode.SEQUENTIAL,)))
    text = "name: t\nalgorithms: offline\ndatasets: room\nplayback: {mode: sequential | realtime}\n"
    with pytest.raises(InvalidInput, match="takes sequential playback only, not realtime"):
        list(expand(parse_experiment(text, "e.yaml"), view([offline])))
    assert count(parse_experiment(text.replace(" | realtime", ""), "e.yaml"), view([offline]))


def test_a_thousand_million_combinations_are_refused_at_once_with_what_makes_them():
    text = (
        HEAD.replace("mono | stereo", "mono")
        + RATE.replace("20 | 10", "0.01:10:0.01")
        + ("parameters:\n  nFeatures: 1000:1999\n  scaleFactor: lin(1.1, 1.9, 1000)\n")
    )
    assert refusal(text).startswith(
        "e.yaml line 1: 1,000,000,000 combinations (r 1,000, nFeatures 1,000, scaleFactor 1,000) are more than the "
        "limit of 1,000,000"
    )


@pytest.mark.integration
def test_values_are_not_even_looked_at_for_too_many_combinations():
    text = (
        HEAD.replace("mono | stereo", "mono") + "parameters:\n  nFeatures: 1:99999\n  scaleFactor: lin(9, 99, 99999)\n"
    )
    assert "9,999,800,001 combinations" in refusal(text)


def test_the_limit_is_the_callers():
    assert "6 combinations" in refusal(HEAD + "parameters:\n  features: 500:700:100\n", limit=5)
    assert "8 runs, more than the limit of 7" in refusal(HEAD + "repeats: 4\n", limit=7)
