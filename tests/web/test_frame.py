"""The frame: who sees which sections and what New offers, and where a page belongs."""

from __future__ import annotations

import pytest

from slamhive.domain.accounts import EVERYTHING, MAY, VISITOR_MAY, Action, Caller, Role
from slamhive.web import pages
from tests.web.web_world import Web


def titles(caller: Caller) -> list[str]:
    return [section.title for section in pages.sections(caller, challenges=False, claims=False)]


def test_only_visitors_of_a_view_only_server_see_no_machines() -> None:
    assert "Machines" not in titles(Caller(VISITOR_MAY))
    assert "Machines" in titles(Caller(EVERYTHING))
    assert "Machines" in titles(Caller(MAY[Role.READER], "rita", Role.READER))


def test_visitors_may_make_a_report_at_most() -> None:
    assert pages.new_things(Caller(VISITOR_MAY)) == []
    assert [entry.title for entry in pages.new_things(Caller(VISITOR_MAY | {Action.ANALYSE}))] == ["Report"]
    assert {"Run", "Experiment", "Report", "Import"} <= {entry.title for entry in pages.new_things(Caller(EVERYTHING))}


def test_challenges_and_claims_have_an_entry_once_there_are_some() -> None:
    everything = pages.sections(Caller(EVERYTHING), challenges=True, claims=True)
    assert {"Challenges", "Claims"} <= {section.title for section in everything}
    assert not {"Challenges", "Claims"} & set(titles(Caller(EVERYTHING)))


@pytest.mark.parametrize(
    ("endpoint", "title"),
    [
        ("start.form", "Runs"),
        ("experiment_builder.new", "Experiments"),
        ("public_datasets.index_of_public", "Datasets"),
    ],
)
def test_a_page_belongs_to_a_section(endpoint: str, title: str) -> None:
    section = pages.section_of(endpoint)
    assert section is not None
    assert section.title == title


def test_help_and_unknown_pages_belong_to_none() -> None:
    assert pages.section_of("help.page") is None
    assert pages.section_of(None) is None


@pytest.mark.quick
def test_the_palette_finds_what_the_page_finds(shown: Web) -> None:
    found = shown.client.get("/find.json?q=eye-slam-mono").get_json()["found"]
    assert {"group": "Algorithms", "title": "eye-slam-mono", "url": "/algorithms/eye-slam-mono"}.items() <= found[
        0
    ].items()
    assert shown.client.get("/find.json?q=").get_json() == {"found": []}
