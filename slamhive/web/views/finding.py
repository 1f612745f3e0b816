"""One search over everything: the page behind the search box of every page."""

from __future__ import annotations

from collections.abc import Callable

from flask import Blueprint, render_template, request
from flask import url_for as address

from slamhive.domain.finding import Found, FoundKind, best
from slamhive.services.finding import LONGEST_TEXT, find
from slamhive.web.context import hive
from slamhive.web.presenters import search
from slamhive.web.views import help as help_pages
from slamhive.web.views.runs import list_address

blueprint = Blueprint("finding", __name__)

TITLES = {
    FoundKind.RUN: "Run",
    FoundKind.RUNS: "Runs that fit",
    FoundKind.EXPERIMENT: "Experiments",
    FoundKind.ALGORITHM: "Algorithms",
    FoundKind.DATASET: "Datasets",
    FoundKind.CONFIGURATION: "Configurations",
    FoundKind.ANALYSIS: "Analyses",
    FoundKind.SEARCH: "Saved searches",
    FoundKind.METRIC: "Metrics",
    FoundKind.HELP: "Help",
}
_ADDRESSES: dict[FoundKind, Callable[[str], str]] = {
    FoundKind.RUN: lambda key: address("runs.show", run_id=int(key)),
    FoundKind.RUNS: lambda key: address("runs.index", where=key),
    FoundKind.EXPERIMENT: lambda key: address("experiments.show", name=key),
    FoundKind.ALGORITHM: lambda key: address("algorithms.show", name=key),
    FoundKind.DATASET: lambda key: address("datasets.show", name=key),
    FoundKind.CONFIGURATION: lambda key: address("configurations.show", configuration_id=int(key)),
    FoundKind.ANALYSIS: lambda key: address("analyses.show", token=key),
    FoundKind.SEARCH: lambda key: list_address(search.saved_args(hive().searches.saved_named(key))),
    FoundKind.METRIC: lambda _key: address("help.page", name="metrics"),
    FoundKind.HELP: lambda key: address("help.page", name=key),
}


@blueprint.get("/find")
def index() -> str:
    """What the words in the address may mean, by kind."""
    text = request.args.get("q", "").strip()[:LONGEST_TEXT]
    found = dict(find(hive(), text))
    if pages := best(text, help_pages.entries()):
        found[FoundKind.HELP] = pages
    groups = {TITLES[kind]: [(entry, _address(entry)) for entry in entries] for kind, entries in found.items()}
    return render_template("finding/index.html", text=text, groups=groups, most=LONGEST_TEXT)


def _address(entry: Found) -> str:
    return _ADDRESSES[entry.kind](entry.key)
