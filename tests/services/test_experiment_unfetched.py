"""An experiment with sequences of the catalogue that nobody has fetched is planned, and says what to fetch."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base.errors import NotFound
from slamhive.base.project import project_root
from slamhive.domain.matching import match_of
from slamhive.services.experiments import ExperimentSource
from slamhive.services.experiments.views import assumed_dataset, to_fetch, unfetched
from slamhive.services.fetching import Collections
from slamhive.services.hive import Hive, open_hive

pytestmark = pytest.mark.integration

PAPER = project_root() / "docs" / "examples" / "paper-euroc.yaml"


@pytest.fixture
def hive(tmp_path: Path) -> Hive:
    """An installation without datasets and runs, with the packages of the project."""
    return open_hive({"data": tmp_path / "data"})


def test_the_large_experiment_of_the_paper_is_planned_on_an_empty_installation(hive: Hive) -> None:
    found = hive.experiments.preview(ExperimentSource.read(PAPER))
    assert (found.combinations, found.cells, found.runs) == (1500, 1500, 1500)
    assert found.to_fetch is not None
    assert found.to_fetch.sequences[0] == "euroc/MH_01_easy"
    assert len(found.to_fetch.datasets) == 5
    assert found.to_fetch.download_bytes == 12_683_729_426, "one archive holds all five sequences"
    (refusal,) = [text for text in found.refusals if "not here yet" in text]
    assert refusal.startswith("5 datasets are not here yet, about 12.7 GB to download: slamhive dataset fetch euroc/")
    assert any("the plan assumes 120 s for each recording" in text for text in found.warnings)
    hive.close()


def test_starting_it_names_what_to_fetch_and_stores_nothing(hive: Hive) -> None:
    with pytest.raises(NotFound, match=r"line 17: 5 datasets are not here yet, about 12\.7 GB to download") as caught:
        hive.experiments.start(ExperimentSource.read(PAPER), "process")
    assert caught.value.remedy is not None
    assert caught.value.remedy.startswith("slamhive dataset fetch euroc/MH_01_easy ")
    assert hive.experiments.list() == ()
    hive.close()


def test_a_name_that_the_catalogue_lacks_is_unknown_as_before(hive: Hive) -> None:
    assert unfetched(["euroc_MH_99"], {}, hive.catalogue.project_root) == {}
    assert to_fetch({}) is None
    text = PAPER.read_text(encoding="utf-8").replace("euroc_MH_01_easy |", "euroc_MH_99 |")
    with pytest.raises(NotFound, match="euroc_MH_99"):
        hive.experiments.preview(ExperimentSource(text))
    hive.close()


def test_each_algorithm_is_planned_on_each_collection_that_serves_its_sensors(hive: Hive) -> None:
    planned = 0
    for collection in Collections(hive.catalogue.project_root).all:
        sequence = collection.sequences[0]
        (entry,) = unfetched([sequence.dataset_name], {}, hive.catalogue.project_root).values()
        dataset = assumed_dataset(entry, hive.settings.datasets_folder / entry.dataset)
        for algorithm in hive.catalogue.algorithms():
            if algorithm.setup in sequence.setups:
                match_of(algorithm, dataset, {}, {})
                planned += 1
    assert planned > 50
    hive.close()
