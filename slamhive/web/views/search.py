"""Saved searches, the export of search results, and one search over everything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request, send_file
from flask import url_for as address
from werkzeug.datastructures import MultiDict

from slamhive.base.errors import InvalidInput, unknown
from slamhive.base.files import temporary_folder
from slamhive.domain.finding import Found, FoundKind, best
from slamhive.domain.metrics import CATALOGUE
from slamhive.services.exports import RUNS_AT_ONCE, ExportFormat, GroupExport, Page, Record, RunExport, TableExport
from slamhive.services.finding import LONGEST_TEXT, find
from slamhive.store.records import GroupRecord, SavedSearchRecord
from slamhive.web.columns import exported
from slamhive.web.context import hive
from slamhive.web.presenters import search
from slamhive.web.presenters.search import fields_of_filters
from slamhive.web.queries import EXPORT_LIMIT, RunListQuery
from slamhive.web.views import help as help_pages
from slamhive.web.views.runs import list_address

blueprint = Blueprint("searches", __name__, url_prefix="/searches")


@blueprint.get("/export.<name>")
def export(name: str) -> Response:
    """Export all matching runs, or their configurations; takes the arguments of the runs page."""
    if name not in list(ExportFormat):
        raise unknown("format", name, list(ExportFormat))
    return export_file(ExportFormat(name), request.args)


@blueprint.get("/fields.json")
def fields() -> Response:
    """The names that a filter may use, for completion."""
    return make_response(jsonify(fields=fields_of_filters(hive())))


@blueprint.post("")
def save() -> Response:
    """Save the current search under a name."""
    name = request.form.get("name", "").strip()
    args = MultiDict([(key, value) for key, value in request.form.items(multi=True) if key != "name"])
    services = hive()
    query = RunListQuery.from_args(args, services.searches.vocabulary())
    if not name:
        raise InvalidInput("the search has no name", "enter a name next to the button")
    look = query.look
    record = SavedSearchRecord(
        name, query.search.text, query.columns, query.sort, query.grouped, look.pinned, look.colours, look.sparks
    )
    new = services.searches.save(record)
    flash(f"Search {name} is {'saved' if new else 'replaced'}.", "success")
    return make_response(redirect(address("runs.index", **query.args()), 303))


@blueprint.post("/<name>/delete")
def delete(name: str) -> Response:
    """Delete a saved search."""
    hive().searches.delete(name)
    flash(f"Search {name} is deleted.", "info")
    return make_response(redirect(address("runs.index"), 303))


# -- one search over everything: the page behind the search box of every page ------------------------------------------

finding_blueprint = Blueprint("finding", __name__)

TITLES = {
    FoundKind.RUN: "Run",
    FoundKind.RUNS: "Runs that fit",
    FoundKind.EXPERIMENT: "Experiments",
    FoundKind.ALGORITHM: "Algorithms",
    FoundKind.DATASET: "Datasets",
    FoundKind.CONFIGURATION: "Configurations",
    FoundKind.ANALYSIS: "Reports",
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


@finding_blueprint.get("/find")
def index() -> str:
    """The meanings of the words in the address, by kind."""
    text = request.args.get("q", "").strip()[:LONGEST_TEXT]
    return render_template("finding/index.html", text=text, groups=_found(text), most=LONGEST_TEXT)


@finding_blueprint.get("/find.json")
def entries() -> Response:
    """The same for the palette: one list, in the order of display."""
    text = request.args.get("q", "").strip()[:LONGEST_TEXT]
    found = [
        {"group": title, "title": entry.name, "words": entry.words, "url": url}
        for title, group in _found(text).items()
        for entry, url in group
    ]
    return make_response(jsonify(found=found))


def _found(text: str) -> dict[str, list[tuple[Found, str]]]:
    """Things with a meaning, with their addresses, by the title of their kind."""
    found = dict(find(hive(), text))
    if pages := best(text, help_pages.entries()):
        found[FoundKind.HELP] = pages
    return {TITLES[kind]: [(entry, _ADDRESSES[kind](entry.key)) for entry in group] for kind, group in found.items()}


# -- all runs of a search, or their configurations, as one file that is sent while it is read --------------------------


def export_file(kind: ExportFormat, args: MultiDict[str, str]) -> Response:
    """The file that the arguments of the runs page ask for; raises InvalidInput or NotFound."""
    services = hive()
    vocabulary = services.searches.vocabulary()
    query = RunListQuery.from_args(args, vocabulary)
    metrics = [key for key in query.columns if key in CATALOGUE]

    def groups(after: str | None) -> tuple[Sequence[GroupRecord], str | None]:
        found = services.searches.groups(query.search, query.sort, after, EXPORT_LIMIT, metrics)
        return found.records, found.next_key

    if query.grouped:
        return _file("configurations", kind, GroupExport(metrics), groups)
    content = RunExport(exported(query.columns), vocabulary)
    runs = services.runs.cells(query.search, query.sort, content.wanted)
    return _file("runs", kind, content, lambda after: runs(after, RUNS_AT_ONCE))


def _file(name: str, kind: ExportFormat, content: TableExport[Record], pages: Page[Record]) -> Response:
    first = pages(None)  # raises errors before the response starts

    def page(after: str | None) -> tuple[Sequence[Record], str | None]:
        return first if after is None else pages(after)

    if kind is ExportFormat.PARQUET:
        with temporary_folder() as folder:
            path = folder / "table.parquet"
            content.parquet(page, path)  # as a whole, because the index of a Parquet file is at its end
            stream = path.open("rb")  # stays readable after the folder is removed
        response = send_file(stream, mimetype=kind.media_type)
        response.call_on_close(stream.close)
    else:
        response = Response(_pieces(content, kind, page), mimetype=kind.media_type)
    response.headers["Content-Disposition"] = f'attachment; filename="{name}.{kind.value}"'
    return response


def _pieces(content: TableExport[Record], kind: ExportFormat, page: Page[Record]) -> Iterator[str]:
    if kind is ExportFormat.CSV:
        return content.csv(page)
    return content.ndjson(page) if kind is ExportFormat.NDJSON else content.json(page)
