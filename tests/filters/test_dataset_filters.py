"""Filters over datasets, and attributes of datasets in filters over runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.filters.binding import read_search
from slamhive.filters.datasets import attributes_of, matching_datasets
from slamhive.filters.fields import FieldKind, ParameterKind, Source, vocabulary_of
from slamhive.filters.syntax import FilterError
from slamhive.filters.words import in_words

CAMERAS = (SensorKind.CAMERA, SensorKind.CAMERA)


def dataset(
    name: str, kinds: tuple[SensorKind, ...], *attributes: str, seconds: float = 10.0, true: bool = True
) -> Dataset:
    sensors = tuple(Sensor(f"s{number}", kind, f"/s{number}", 10.0) for number, kind in enumerate(kinds))
    truth = GroundTruth("groundtruth.txt", gravity_aligned=True) if true else None
    return Dataset(name, Path(name), f"{name}.bag", seconds, sensors, truth, "", attributes=attributes)


DATASETS = (
    dataset("hall", (*CAMERAS, SensorKind.IMU), "indoor", "dark", "easy"),
    dataset("street", (*CAMERAS, SensorKind.LIDAR), "outdoor", "loops", seconds=100.0),
    dataset("campus", (SensorKind.LIDAR, SensorKind.IMU), "indoor", "outdoor", true=False),
    dataset("desk", (SensorKind.CAMERA, SensorKind.DEPTH)),
)


def names(text: str) -> list[str]:
    return [entry.name for entry in matching_datasets(text, DATASETS)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["hall", "street", "campus", "desk"]),
        ("indoor", ["hall", "campus"]),
        ("indoor and sensor = stereo", ["hall"]),
        ("attribute = indoor or loops", ["hall", "street", "campus"]),
        ("not indoor", ["street", "desk"]),
        ("attribute != indoor", ["street"]),
        ("place = outdoor", ["street", "campus"]),
        ("place != outdoor", ["hall"]),
        ("has difficulty", ["hall"]),
        ("missing attribute", ["desk"]),
        ("attribute in (dark, loops)", ["hall", "street"]),
        ("attribute ~ *door and not dark", ["street", "campus"]),
        ("sensor in (rgbd, lidar-inertial)", ["campus", "desk"]),
        ("sensor != stereo", ["campus", "desk"]),
        ("duration > 1 min", ["street"]),
        ("duration between 5 and 20 and groundtruth = yes", ["hall", "desk"]),
        ("dataset ~ ?a* and recording = yes", ["hall", "campus"]),
        ("dataset in (desk, street) and not sensor = lidar", ["desk"]),
    ],
)
def test_what_fits(text: str, expected: list[str]) -> None:
    assert names(text) == expected


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("indor", "the filter has its end where one of = !="),
        ("attribute = indor", "attribute is never 'indor' .*did you mean 'indoor'"),
        ("place = moon", "place is never 'moon'"),
        ("sensor = sterio", "sensor is never 'sterio' .*did you mean 'stereo'"),
        ("ate.rmse < 1", "unknown name 'ate.rmse'"),
        ("algorithm = x", "unknown name 'algorithm'"),
        ("duration = long", "duration is a number"),
        ("protocol = x", "no metric has been computed under protocol"),
        ("(indoor", "has its end where one of = !="),
    ],
)
def test_mistakes_point_at_their_place(text: str, problem: str) -> None:
    with pytest.raises(FilterError, match=problem):
        names(text)


def test_attributes_in_filters_over_runs() -> None:
    vocabulary = vocabulary_of([], attributes=attributes_of(DATASETS))
    search = read_search("indoor and difficulty = easy and ate.rmse < 0.1", vocabulary)
    assert search.text == "attribute = indoor and difficulty = easy and ate.rmse < 0.1"
    assert in_words(search) == "attribute indoor and difficulty easy and ATE RMSE below 0.1 m"
    assert read_search(search.text, vocabulary) == search


@pytest.mark.parametrize("text", ["ate.rmse", "state = failed and nFeatures", "(nothing)"])
def test_other_words_alone_are_mistakes(text: str) -> None:
    for attributes in ({}, attributes_of(DATASETS)):
        with pytest.raises(FilterError, match="where one of = != < <= > >= ~ !~ in between belongs"):
            read_search(text, vocabulary_of([], attributes=attributes))


def test_a_parameter_of_the_same_name_comes_first() -> None:
    vocabulary = vocabulary_of([ParameterKind("motion", FieldKind.NUMBER)], attributes=attributes_of(DATASETS))
    assert [field.source for field in vocabulary.fields("motion")] == [Source.PARAMETER, Source.ATTRIBUTE]
    assert read_search("motion > 2", vocabulary).tree.field.source is Source.PARAMETER  # type: ignore[union-attr]
