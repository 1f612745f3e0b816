"""The frame: who sees which sections and what New offers, and where a page belongs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from slamhive.analysis.chart import RUN_COLOURS, on_dark
from slamhive.domain.accounts import EVERYTHING, MAY, VISITOR_MAY, Action, Caller, Role
from slamhive.web import pages
from slamhive.web.columns import DEFAULT_COLUMNS, all_columns
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


def test_no_colour_of_an_outcome_is_that_of_a_series() -> None:
    tokens = (Path(__file__).resolve().parents[2] / "static" / "tokens.css").read_text(encoding="utf-8")
    pairs = re.findall(r"--(good|bad|going|doubt|idle): light-dark\((#\w+), (#\w+)\)", tokens)
    assert len(pairs) == 5
    outcomes = {colour.lower() for _, *shades in pairs for colour in shades}
    series = {colour.lower() for shade in RUN_COLOURS for colour in (shade, on_dark(shade))}
    assert outcomes & series == set()


def test_a_list_shows_first_what_tells_runs_apart_and_how_good_they_are() -> None:
    titles = [all_columns()[key].title for key in DEFAULT_COLUMNS]
    assert titles == ["Run", "Algorithm", "Dataset", "What differs", "Outcome", "ATE RMSE", "Tracked fraction"]
