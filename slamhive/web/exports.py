"""All runs of a search, or their configurations, as one file that is sent while it is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from flask import Response, send_file
from werkzeug.datastructures import MultiDict

from slamhive.base.files import temporary_folder
from slamhive.domain.metrics import CATALOGUE
from slamhive.services.exports import RUNS_AT_ONCE, ExportFormat, GroupExport, Page, Record, RunExport, TableExport
from slamhive.store.records import GroupRecord
from slamhive.web.columns import exported
from slamhive.web.context import hive
from slamhive.web.queries import EXPORT_LIMIT, RunListQuery


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
