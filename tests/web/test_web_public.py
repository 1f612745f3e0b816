"""The page of public datasets, and what the page of datasets says of them."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.base.errors import Unavailable
from slamhive.base.project import project_root
from slamhive.services.fetching import Fetching, FetchPlan, Progress
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.quick


@pytest.fixture
def public(tmp_path: Path) -> Iterator[Web]:
    hive = world.make_hive(tmp_path, empty=True)
    (tmp_path / "project" / "datasets").symlink_to(project_root() / "datasets")
    web = make_web(hive)
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
    assert "2 sequences of 1 collection" in text
    assert '<code title="slamhive dataset fetch euroc/MH_04_difficult">' in text
    assert "12,684 MB, shared" in text
    assert "addresses unverified" in text
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


def token_of(public: Web) -> str:
    return public.client.get("/public-datasets").text.partition('name="csrf_token" value="')[2].partition('"')[0]


@pytest.mark.integration
def test_a_sequence_is_fetched_by_one_button_with_its_progress(public: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    """Downloads have tests of their own; here: what the button starts, and what the page says meanwhile and after."""
    ended = threading.Event()

    def perform(
        _fetching: Fetching, plans: tuple[FetchPlan, ...], _request: object, progress: Progress
    ) -> Iterator[None]:
        progress(0.5, f"{plans[0].sequence.full_name}: 12 of 24 MB")
        ended.wait(30)
        yield None

    monkeypatch.setattr(Fetching, "perform", perform)
    token = token_of(public)
    assert public.client.post("/public-datasets/fetch", data={"sequence": "tum-rgbd/fr1_xyz"}).status_code == 400
    wanted = {"csrf_token": token, "sequence": "tum-rgbd/fr1_xyz"}
    assert public.client.post("/public-datasets/fetch", data=wanted).status_code == 303
    eventually(lambda: "12 of 24 MB" in public.client.get("/public-datasets").text, "the download to begin")
    text = public.client.get("/public-datasets").text
    assert 'aria-valuenow="50"' in text
    assert "Fetching tum-rgbd/fr1_xyz" in text
    assert public.client.post("/public-datasets/fetch", data=wanted).status_code == 409
    ended.set()
    eventually(lambda: "<b>tum-rgbd/fr1_xyz</b> is here." in public.client.get("/public-datasets").text, "its end")


@pytest.mark.integration
def test_a_download_that_fails_says_why_and_leaves_no_dataset(public: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    def perform(*_: object) -> Iterator[None]:
        raise Unavailable("cvg.cit.tum.de does not answer", "try again later")

    monkeypatch.setattr(Fetching, "perform", perform)
    wanted = {"csrf_token": token_of(public), "sequence": "tum-rgbd/fr1_xyz"}
    public.client.post("/public-datasets/fetch", data=wanted)
    eventually(lambda: "was not fetched" in public.client.get("/public-datasets").text, "the download to fail")
    assert "cvg.cit.tum.de does not answer" in public.client.get("/public-datasets").text


@pytest.mark.integration
def test_what_only_a_person_can_get_has_a_command_and_no_button(public: Web) -> None:
    text = public.client.get("/public-datasets?words=newer-college").text
    assert "needs form" in text
    assert "<button" not in text.partition('class="collection"')[2].partition("</details>")[0]
    wanted = {"csrf_token": token_of(public), "sequence": "newer-college/quad_easy"}
    answer = public.client.post("/public-datasets/fetch", data=wanted)
    assert answer.status_code == 400
    assert "cannot be downloaded by a program" in answer.text
