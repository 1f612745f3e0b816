"""The page of public datasets, and what the page of datasets says of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.base.project import project_root
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.quick


@pytest.fixture
def public(tmp_path: Path, compiled: Path) -> Iterator[Web]:
    hive = world.make_hive(tmp_path, empty=True)
    (tmp_path / "project" / "datasets").symlink_to(project_root() / "datasets")
    web = make_web(hive, compiled)
    yield web
    web.hive.close()


def test_the_page_of_datasets_shows_the_collections(public: Web) -> None:
    text = public.client.get("/datasets").text
    assert "<code>slamhive dataset fetch euroc/MH_01_easy</code>" in text
    assert "CC BY-NC-SA 3.0" in text
    assert re.search(r"<span title=\"[^\"]+\">form</span>", text)


@pytest.mark.integration
def test_sequences_are_found_by_words(public: Web) -> None:
    text = public.client.get("/public-datasets?words=euroc+dark").text
    assert "Showing 2 sequences" in text
    assert "<code>slamhive dataset fetch euroc/MH_04_difficult</code>" in text
    assert "12,684, shared" in text
    assert "The addresses are unverified" in text
    assert "MH_01_easy" not in text


@pytest.mark.integration
def test_words_that_fit_nothing(public: Web) -> None:
    assert (
        "no sequence fits &#39;indor&#39;; did you mean &#39;indoor&#39;?"
        in public.client.get("/public-datasets?words=indor").text
    )
    assert "No sequence fits all these words." in public.client.get("/public-datasets?words=indoor+car").text
    hostile = public.client.get("/public-datasets", query_string={"words": world.HOSTILE})
    assert hostile.status_code == 200
    assert world.HOSTILE not in hostile.text
