"""Saved searches, and the runs that a search finds as files."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from flask import Blueprint, Response, flash, make_response, redirect, request, send_file
from flask import url_for as address
from werkzeug.datastructures import MultiDict

from slamhive.errors import InvalidInput, unknown
from slamhive.services.hive import Hive
from slamhive.services.run_export import Format, Page, RunExport
from slamhive.store.records import RunRecord, SavedSearchRecord
from slamhive.web.context import hive
from slamhive.web.run_query import EXPORT_LIMIT, RunQuery

blueprint = Blueprint("searches", __name__, url_prefix="/searches")


@blueprint.get("/export.<name>")
def export(name: str) -> Response:
    """All runs of a search as a file; the arguments are those of the runs page."""
    if name not in list(Format):
        raise unknown("format", name, list(Format))
    kind = Format(name)
    services = hive()
    vocabulary = services.searches.vocabulary()
    query = RunQuery.from_args(request.args, vocabulary)
    content = RunExport(query.columns, vocabulary)
    pages = _Pages(services, query)
    first = pages(None)  # what can be refused is refused before the answer begins

    def page(after: str | None) -> tuple[Sequence[RunRecord], str | None]:
        return first if after is None else pages(after)

    if kind is Format.PARQUET:
        response = _parquet(content, page)
    else:
        pieces = content.csv(page) if kind is Format.CSV else content.json(page)
        response = Response(pieces, mimetype=kind.media_type)
    response.headers["Content-Disposition"] = f'attachment; filename="runs.{kind.value}"'
    return response


@blueprint.post("")
def save() -> Response:
    """Save the search that the form carries under a name."""
    name = request.form.get("name", "").strip()
    args = MultiDict([(key, value) for key, value in request.form.items(multi=True) if key != "name"])
    services = hive()
    query = RunQuery.from_args(args, services.searches.vocabulary())
    if not name:
        raise InvalidInput("the search has no name", "write one beside the button")
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


class _Pages:
    """The pages of a search, one after the other."""

    def __init__(self, services: Hive, query: RunQuery) -> None:
        self._services = services
        self._query = query

    def __call__(self, after: str | None) -> tuple[Sequence[RunRecord], str | None]:
        """The page after a key, and the key of the next."""
        page = self._services.runs(self._query.search, self._query.sort, after, EXPORT_LIMIT)
        return page.records, page.next_key


def _parquet(content: RunExport, page: Page) -> Response:
    """A Parquet file is written whole, since its table of contents is at the end; it goes with the answer."""
    with tempfile.TemporaryDirectory(prefix="slamhive-export-") as folder:
        path = Path(folder) / "runs.parquet"
        content.parquet(page, path)
        stream = path.open("rb")  # outlives the folder: the file goes when it is closed
    response = send_file(stream, mimetype=Format.PARQUET.media_type)
    response.call_on_close(stream.close)
    return response
