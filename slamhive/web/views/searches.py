"""Saved searches, and the export of search results."""

from __future__ import annotations

from collections.abc import Sequence

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, request, send_file
from flask import url_for as address
from werkzeug.datastructures import MultiDict

from slamhive.domain.metrics import CATALOGUE
from slamhive.errors import InvalidInput, unknown
from slamhive.files import temporary_folder
from slamhive.services.exports import Format, GroupExport, Page, Record, RunExport, TableExport
from slamhive.services.hive import Hive
from slamhive.store.records import GroupRecord, RunRecord, SavedSearchRecord
from slamhive.web.context import hive
from slamhive.web.presenters.search import filter_fields
from slamhive.web.run_query import EXPORT_LIMIT, RunQuery

blueprint = Blueprint("searches", __name__, url_prefix="/searches")


@blueprint.get("/export.<name>")
def export(name: str) -> Response:
    """Export all matching runs, or their configurations; takes the arguments of the runs page."""
    if name not in list(Format):
        raise unknown("format", name, list(Format))
    kind = Format(name)
    services = hive()
    vocabulary = services.searches.vocabulary()
    query = RunQuery.from_args(request.args, vocabulary)
    if query.grouped:
        metrics = [key for key in query.columns if key in CATALOGUE]
        return _file("configurations", kind, GroupExport(metrics), _group_pages(services, query, metrics))
    return _file("runs", kind, RunExport(query.columns, vocabulary), _run_pages(services, query))


@blueprint.get("/fields.json")
def fields() -> Response:
    """The names that a filter may use, for completion."""
    services = hive()
    algorithms, datasets = services.searches.names()
    experiments = [entry.name for entry in services.experiments.list()]
    vocabulary = services.searches.vocabulary()
    names = {"algorithm": algorithms, "dataset": datasets, "experiment": experiments, "tag": services.notes.tags()}
    names["protocol"] = list(dict.fromkeys(vocabulary.protocols.values()))
    return make_response(jsonify(fields=filter_fields(vocabulary, names)))


@blueprint.post("")
def save() -> Response:
    """Save the current search under a name."""
    name = request.form.get("name", "").strip()
    args = MultiDict([(key, value) for key, value in request.form.items(multi=True) if key != "name"])
    services = hive()
    query = RunQuery.from_args(args, services.searches.vocabulary())
    if not name:
        raise InvalidInput("the search has no name", "enter a name next to the button")
    record = SavedSearchRecord(name, query.search.text, query.columns, query.sort, query.grouped)
    new = services.searches.save(record)
    flash(f"Search {name} is {'saved' if new else 'replaced'}.", "success")
    return make_response(redirect(address("runs.index", **query.args()), 303))


@blueprint.post("/<name>/delete")
def delete(name: str) -> Response:
    """Delete a saved search."""
    hive().searches.delete(name)
    flash(f"Search {name} is deleted.", "info")
    return make_response(redirect(address("runs.index"), 303))


def _run_pages(services: Hive, query: RunQuery) -> Page[RunRecord]:
    def page(after: str | None) -> tuple[Sequence[RunRecord], str | None]:
        found = services.runs.page(query.search, query.sort, after, EXPORT_LIMIT)
        return found.records, found.next_key

    return page


def _group_pages(services: Hive, query: RunQuery, metrics: Sequence[str]) -> Page[GroupRecord]:
    def page(after: str | None) -> tuple[Sequence[GroupRecord], str | None]:
        found = services.searches.groups(query.search, query.sort, after, EXPORT_LIMIT, metrics)
        return found.records, found.next_key

    return page


def _file(name: str, kind: Format, content: TableExport[Record], pages: Page[Record]) -> Response:
    first = pages(None)  # raises errors before the response starts

    def page(after: str | None) -> tuple[Sequence[Record], str | None]:
        return first if after is None else pages(after)

    if kind is Format.PARQUET:
        response = _parquet(content, page)
    else:
        pieces = content.csv(page) if kind is Format.CSV else content.json(page)
        response = Response(pieces, mimetype=kind.media_type)
    response.headers["Content-Disposition"] = f'attachment; filename="{name}.{kind.value}"'
    return response


def _parquet(content: TableExport[Record], page: Page[Record]) -> Response:
    """Write the whole Parquet file first, because its index is at its end; it is deleted after the response."""
    with temporary_folder() as folder:
        path = folder / "table.parquet"
        content.parquet(page, path)
        stream = path.open("rb")  # stays readable after the folder is removed
    response = send_file(stream, mimetype=Format.PARQUET.media_type)
    response.call_on_close(stream.close)
    return response
