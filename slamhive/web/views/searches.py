"""Saved searches, and the export of search results."""

from __future__ import annotations

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, request
from flask import url_for as address
from werkzeug.datastructures import MultiDict

from slamhive.errors import InvalidInput, unknown
from slamhive.services.exports import Format
from slamhive.store.records import SavedSearchRecord
from slamhive.web.context import hive
from slamhive.web.exports import export_file
from slamhive.web.presenters.search import fields_of_filters
from slamhive.web.run_query import RunQuery

blueprint = Blueprint("searches", __name__, url_prefix="/searches")


@blueprint.get("/export.<name>")
def export(name: str) -> Response:
    """Export all matching runs, or their configurations; takes the arguments of the runs page."""
    if name not in list(Format):
        raise unknown("format", name, list(Format))
    return export_file(Format(name), request.args)


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
    query = RunQuery.from_args(args, services.searches.vocabulary())
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
