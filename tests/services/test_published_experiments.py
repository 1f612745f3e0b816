"""Combination files of the published SLAM Hive become experiments that expand."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.settings import Settings
from slamhive.experiments.binding import CatalogueView
from slamhive.experiments.expansion import expand
from slamhive.experiments.file import parse_experiment
from slamhive.packages.published.experiment import Converted
from slamhive.recordings.variants.steps import RegisteredSteps
from slamhive.services.datasets import Catalogue
from slamhive.services.experiments.converting import convert_published
from slamhive.services.experiments.views import ExperimentSource
from tests.experiments.sweep_world import CAMERA, IMU, dataset

pytestmark = pytest.mark.quick

FILE = """\
Notes on what follows:
 - the numbers are templates

----------------------------------------------
orb-slam3-ros-stereo-inertial+MH_01_easy+exploration

-----
Algorithm: orb-slam3-ros-stereo-inertial
Dataset: MH_01_easy
Experiments to explore the parameter space.

image frequency: 20 | 10
image resolution: 1 | 0.5
imu frequency: 1 | 4
nFeatures: 1000 | 2000
mode: fast | slow
Totally: 2*2*2*2 = 16

Environment: Desktop (Memory: 32GB)
-----
588,602
591,603

-----
+++ the left camera first

588:
  1:
    350: 20
  2:
    350: 10
  4:
    350: 5
589:
  1:
    575: 200
  4:
    575: 50
591:
  1:
    351: 752
    352: 480
    436: 436.24
    449: 60
    454: [-0.28, 0.07, 0.0, 0.0]
    457: [436.24, 0.0 ,364.4, 0.0]
    999: 5
  0.5:
    351: 376
    352: 240
    436: 218.3
    449: 120
    454: [-0.28, 0.07,
   0.0, 0.0]
    457: [218.3, 0, 182.3, 0]
    999: 5
603:
  1:
    572: [457.587, 0.0]
  0.5:
    572: [228.7935, 0.0]
"""


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    """The packages of the project, and no dataset."""
    return Catalogue(Settings(data=tmp_path_factory.mktemp("data")), Path(__file__).resolve().parents[2])


def converted(catalogue: Catalogue, text: str = FILE, **meanings: str) -> Converted:
    (made,) = convert_published(catalogue, ExperimentSource(text, "file"), meanings)
    return made


def changed(old: str, new: str) -> str:
    assert old in FILE
    return FILE.replace(old, new, 1)


def test_a_combination_becomes_an_experiment_with_calibration_from_the_dataset(catalogue):
    made = converted(catalogue)
    content = strict_yaml.parse(made.text, "made")
    assert content["algorithms"] == "orb-slam3-stereo-inertial"
    assert content["datasets"] == ["MH_01_easy"]
    assert content["steps"] == {
        "image_rate": {"step": "rate", "sensors": "camera", "every": "1 | 2"},
        "imu_rate": {"step": "rate", "sensors": "imu", "every": "1 | 4"},
        "image_resolution": {"step": "resolution", "sensors": "camera", "scale": "1 | 0.5"},
    }
    assert content["parameters"] == {"nFeatures": "1000 | 2000", "thDepth": [60, 120]}
    assert content["linked"] == [["image_resolution", "thDepth"]]
    assert not {"fx", "image_width", "LEFT_D"} & set(content["parameters"])


def test_the_experiment_expands_to_the_runs_of_the_file(catalogue):
    experiment = parse_experiment(converted(catalogue).text)
    algorithms = {entry.name: entry for entry in catalogue.algorithms()}
    recorded = dataset("MH_01_easy", ("cam0", CAMERA, 20), ("cam1", CAMERA, 20), ("imu0", IMU, 200))
    runs = list(expand(experiment, CatalogueView(algorithms, {"MH_01_easy": recorded}, RegisteredSteps())))
    assert len({run.content_hash for run in runs}) == 16
    depths = {run.configuration.parameters["thDepth"] for run in runs}
    assert depths == {60.0, 120.0}


def test_nothing_is_dropped_without_a_word(catalogue):
    made = converted(catalogue)
    said = "\n".join(made.notes)
    for words in (
        "lines 1 to 2 stand before the first combination",
        "the algorithm orb-slam3-ros-stereo-inertial is orb-slam3-stereo-inertial here",
        "there is no dataset MH_01_easy here yet",
        "line 16: mode is not converted, orb-slam3-stereo-inertial has no such parameter",
        "template 999 (5, 5) is not converted; --id 999=PARAMETER",
        "image_frequency, imu_frequency, image_width, image_height, fx, LEFT_D, LEFT_P, RIGHT_K: not copied",
        "1 lines of other text are kept as comments",
    ):
        assert words in said
        assert words.startswith("1 lines") or words in made.text
    assert "# line 25: +++ the left camera first" in made.text
    assert not any("configurations, this experiment has" in note for note in made.notes)


def test_users_say_what_numbers_and_names_mean(catalogue):
    meanings = {"999": "nLevels", "orb-slam3-ros-stereo-inertial": "orb-slam3-stereo", "MH_01_easy": "other"}
    made = converted(catalogue, **meanings)
    content = strict_yaml.parse(made.text, "made")
    assert (content["algorithms"], content["datasets"]) == ("orb-slam3-stereo", ["other"])
    assert content["parameters"]["nLevels"] == [5]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "    350: 10\n",
            "    350: 15\n",
            "file line 27: the values of template 588 are not those of the rate of image 0",
        ),
        (
            "    351: 376\n",
            "    351: 700\n",
            "file line 39: the values of template 591 are not those of the resolution",
        ),
        ("Dataset: MH_01_easy", "Dataset: MH_02_easy", "file, line 9: the dataset is MH_02_easy, but the title"),
        ("    572: [228.7935, 0.0]", "    572: {a", "file"),
        ("603:\n  1:", "603:\n  0.8:", "has the factors 0.8 | 0.5, that of template 591 has 1 | 0.5"),
        ("589:\n  1:", "589:\n  x:", "expected a factor with new values, found x"),
        ("+exploration\n", "\n", "file holds no combination of the published SLAM Hive"),
    ],
)
def test_what_contradicts_itself_is_refused_with_the_line(catalogue, old, new, words):
    with pytest.raises(InvalidInput) as refusal:
        converted(catalogue, changed(old, new))
    assert words in str(refusal.value)


def test_an_algorithm_that_is_not_here_is_refused_with_the_remedy(catalogue):
    text = FILE.replace("orb-slam3-ros-stereo-inertial", "ndt-loam")
    with pytest.raises(NotFound, match=r"unknown algorithm 'ndt-loam'.*--id ndt-loam=NAME"):
        converted(catalogue, text)
    with pytest.raises(InvalidInput, match="--id 12=x: the file does not name 12"):
        converted(catalogue, **{"12": "x"})


def test_numbers_may_be_those_of_this_installation(catalogue):
    assert converted(catalogue, here="here") == converted(catalogue)


def test_a_combination_given_to_analyse_is_told_how_to_convert_it(hive):
    with pytest.raises(InvalidInput) as refusal:
        hive.analyses.read(FILE, "orb.txt")
    assert "orb.txt is a combination file of the published SLAM Hive, not an analysis" in refusal.value.message
    assert refusal.value.remedy == "make an experiment of it: slamhive experiment convert orb.txt"


def test_several_combinations_of_one_title_get_names_of_their_own(catalogue):
    second = FILE[FILE.index("-----") :]
    first, again = convert_published(catalogue, ExperimentSource(FILE + "\n" + second, "file"), {})
    assert again.name == f"{first.name}-2"
    assert parse_experiment(again.text).name == again.name


def test_another_total_is_said(catalogue):
    assert (
        "the file says 8 configurations, this experiment has 16" in converted(catalogue, changed("= 16", "= 8")).notes
    )


def test_cameras_that_are_not_tied_in_the_file_are_mentioned(catalogue):
    said = "591 and 603 are not tied in the file; here image_resolution treats all sensors alike"
    assert said in converted(catalogue, changed("591,603\n", "")).notes
    assert said not in converted(catalogue).notes


PACKAGE = """
format: 1
package: lens
title: Lens
version: "1"
upstream: https://example.org/lens
licence: MIT
citation: none
modes:
  mono: {title: Lens, setup: mono, inputs: {left: camera}, trajectory_role: left}
parameters:
  LEFT_D: {type: matrix, default: [0, 0, 0, 0], help: Distortion that the package does not take from the dataset.}
  LEFT_K: {type: matrix, default: [1, 1, 1, 1], help: The same for intrinsics.}
  fx: {type: float, from: left.fx, help: Focal length.}
"""


def test_calibration_that_a_package_does_not_take_from_the_dataset_is_linked_to_the_step(tmp_path):
    folder = tmp_path / "algorithms" / "lens"
    (folder / "slamhive").mkdir(parents=True)
    (folder / "slamhive" / "mapping.py").touch()
    (folder / "algorithm.yaml").write_text(PACKAGE)
    catalogue = Catalogue(Settings(data=tmp_path / "data"), tmp_path)
    text = FILE.replace("    457: [436.24, 0.0 ,364.4, 0.0]", "    455: [458.6, 0, 367.2, 0]")
    text = text.replace("    457: [218.3, 0, 182.3, 0]", "    455: [229.3, 0, 183.6, 0]")
    made = converted(catalogue, text.replace("orb-slam3-ros-stereo-inertial", "lens"))
    content = strict_yaml.parse(made.text, "made")
    assert content["parameters"] == {
        "LEFT_D": [[-0.28, 0.07, 0.0, 0.0]],
        "LEFT_K": [[458.6, 0, 367.2, 0], [229.3, 0, 183.6, 0]],
    }
    assert content["linked"] == [["image_resolution", "LEFT_K"]]
    recorded = dataset("MH_01_easy", ("cam0", CAMERA, 20))
    lens = {entry.name: entry for entry in catalogue.algorithms()}
    view = CatalogueView(lens, {"MH_01_easy": recorded}, RegisteredSteps())
    runs = list(expand(parse_experiment(made.text), view))
    assert {run.configuration.parameters["LEFT_D"] for run in runs} == {(-0.28, 0.07, 0.0, 0.0)}
    assert {run.configuration.parameters["LEFT_K"] for run in runs} == {(458.6, 0, 367.2, 0), (229.3, 0, 183.6, 0)}
    assert "file line 34: the imu rate is not converted, lens uses no imu" in made.notes
    assert all("fx" not in run.configuration.parameters for run in runs)
