"""Experiments that choose their datasets by a filter."""

from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.experiments.expansion import name_datasets
from slamhive.experiments.file import parse_experiment
from slamhive.filters.datasets import matching_datasets
from tests.filters.test_dataset_filters import DATASETS

REST = "name: x\nalgorithms: kiss-icp\n"


def choose(where: str) -> list[str]:
    return [dataset.name for dataset in matching_datasets(where, DATASETS)]


def named(text: str) -> str:
    return name_datasets(text, "x.yaml", choose)


@pytest.mark.parametrize(
    "datasets",
    [
        "datasets: {where: indoor and sensor = stereo}",
        "datasets: {where: 'indoor and sensor = stereo'} # a comment",
        "datasets:\n  # a comment\n  where: indoor and sensor = stereo",
        "datasets:\n  where: >-\n    indoor and\n    sensor = stereo",
        "datasets: {\n  where: indoor and sensor = stereo\n}",
    ],
)
def test_names_replace_the_filter_and_nothing_else(datasets: str) -> None:
    text = f"{REST}{datasets}\nrepeats: 0\n"
    found = named(text)
    assert named(found) == found
    assert "# chosen by: indoor and sensor = stereo" in found
    assert text.count("# a comment") == found.count("# a comment")
    assert parse_experiment(found.replace("repeats: 0", "repeats: 7")).datasets.values == ("hall",)
    line = text.splitlines().index("repeats: 0") + 1
    with pytest.raises(InvalidInput, match=f"x.yaml line {line}: repeats"):
        parse_experiment(found, "x.yaml")


def test_files_without_a_filter_stay_as_they_are() -> None:
    for text in (f"{REST}datasets: a | b\n", f"{REST}datasets: [a, b] # c", REST):
        assert named(text) == text


@pytest.mark.parametrize(
    ("datasets", "problem"),
    [
        ("{where: indor}", r"x\.yaml line 3: the filter has its end where one of"),
        ("{where: attribute = indor}", r"x\.yaml line 3: attribute is never 'indor'.*did you mean 'indoor'"),
        ("{where: indoor and not indoor}", r"x\.yaml line 3: no dataset fits 'indoor and not indoor'"),
        ("{were: indoor}", r"x\.yaml line 3: datasets\.unknown key 'were'; did you mean 'where'"),
        ("{}", r"datasets\.where is missing"),
        ("{where: [indoor]}", r"datasets\.where: must be text"),
        ("{where: ''}", r"datasets\.where"),
    ],
)
def test_mistakes_name_their_line(datasets: str, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem):
        named(f"{REST}datasets: {datasets}\n")


def test_a_filter_that_nobody_replaced_has_no_names() -> None:
    assert parse_experiment(f"{REST}datasets: {{where: indoor}}\n").datasets.values == ()
