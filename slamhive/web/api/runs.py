"""Runs: lists, metrics, files, comparison and exports."""

from __future__ import annotations

from flask import Response, request, send_file, url_for
from werkzeug.exceptions import RequestedRangeNotSatisfiable

from slamhive.errors import InvalidInput
from slamhive.input_bounds import whole_number
from slamhive.schema.api_answers import Download, Progress, ProtocolMetrics, RunFiles, RunPage
from slamhive.schema.comparison import Comparison
from slamhive.schema.looks import RunMoment
from slamhive.schema.run import Run, RunWith
from slamhive.services.exports import Format
from slamhive.services.run_comparison import read_run_ids
from slamhive.services.runs import list_downloads, open_download
from slamhive.web.api.arguments import (
    COMPARISON_ARGUMENTS,
    EXPORT_ARGUMENTS,
    LOG_ARGUMENTS,
    RUN_ARGUMENTS,
    TIMESTAMP_ARGUMENTS,
)
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive
from slamhive.web.exports import export_file
from slamhive.web.figures import figure_csv
from slamhive.web.run_query import EXPORT_LIMIT, RunQuery
from slamhive.web.views.run_plots import asked_timestamp_s

MOST_LOG_BYTES = 200_000
FILE_TYPES = (
    "application/json",
    "application/octet-stream",
    "application/yaml",
    "application/zip",
    "image/png",
    "text/csv",
    "text/plain",
)


@TABLE.get(Section.RUNS, "/runs", RunPage, RUN_ARGUMENTS)
def runs() -> RunPage:
    """A page of the runs that match a filter.

    Arguments are those of the page of runs, `min.METRIC` and `max.METRIC` included. `next` leads to the next page. It
    contains the sort key of the last run, so that new runs neither repeat nor hide others.
    """
    services = hive()
    query = RunQuery.from_args(request.args, services.searches.vocabulary(), EXPORT_LIMIT)
    page = services.runs.page(query.search, query.sort, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.runs", **query.at(page.next_key).args())
    return RunPage(runs=tuple(map(Run.of, page.records)), total=page.total, next=following)


@TABLE.get(Section.RUNS, "/runs/{run_id}", RunWith)
def run(run_id: int) -> RunWith:
    """One run with its metrics, evaluations and events."""
    return hive().runs.in_full(run_id)


@TABLE.get(Section.RUNS, "/runs/{run_id}/metrics", ProtocolMetrics)
def run_metrics(run_id: int) -> ProtocolMetrics:
    """The metrics of one run under each protocol that it was evaluated under."""
    services = hive()
    services.runs.get(run_id)
    return ProtocolMetrics(protocols=services.current_protocols.figures(run_id))


@TABLE.get(Section.RUNS, "/runs/{run_id}/progress", Progress)
def run_progress(run_id: int) -> Progress:
    """How far one run is."""
    services = hive()
    state = services.runs.get(run_id).state
    progress = services.runs.progress(run_id)
    return Progress(state=state, text=state.value) if progress is None else Progress.of(progress, state=state)


@TABLE.get(Section.RUNS, "/runs/{run_id}/log", ("text/plain",), LOG_ARGUMENTS)
def run_log(run_id: int) -> Response:
    """The end of the output of one run, so far."""
    wanted = whole_number(request.args.get("bytes", str(MOST_LOG_BYTES)), "bytes", 1, MOST_LOG_BYTES)
    return Response(hive().runs.log(run_id, wanted), mimetype="text/plain")


@TABLE.get(Section.RUNS, "/runs/{run_id}/files", RunFiles)
def run_files(run_id: int) -> RunFiles:
    """The files of one run. `traj.txt` is its trajectory (TUM), `FINGERPRINT-traj.tum` the aligned one."""
    services = hive()
    found = list_downloads(services.runs.folder(run_id), _fingerprints(run_id))
    return RunFiles(
        files=tuple(Download.of(file, address=url_for("api.run_file", run_id=run_id, key=file.key)) for file in found)
    )


@TABLE.get(Section.RUNS, "/runs/{run_id}/files/{key}", FILE_TYPES)
def run_file(run_id: int, key: str) -> Response:
    """One file of one run. Parts of it can be requested (`Range`)."""
    found, stream = open_download(hive().runs.folder(run_id), _fingerprints(run_id), key)
    status = found.path.stat()
    response = send_file(
        stream,
        mimetype=found.media_type,
        as_attachment=True,
        download_name=f"run-{run_id}-{found.name}",
        last_modified=status.st_mtime,
        etag=f"{status.st_mtime_ns:x}-{status.st_size:x}",
        conditional=False,
    )
    response.content_length = status.st_size
    try:
        response.make_conditional(request, accept_ranges=True, complete_length=status.st_size)
    except RequestedRangeNotSatisfiable:
        response.close()  # Flask makes another answer, and would leave the file open
        raise
    return response


@TABLE.get(Section.RUNS, "/runs/{run_id}/plots/{plot}", ("text/csv",))
def run_plot(run_id: int, plot: str) -> Response:
    """The data of one plot of one run, as CSV with units in its header."""
    services = hive()
    services.runs.get(run_id)
    return Response(figure_csv(services.runs.series(run_id), plot), mimetype="text/csv")


@TABLE.get(Section.RUNS, "/runs/{run_id}/moment", RunMoment, TIMESTAMP_ARGUMENTS)
def run_moment(run_id: int) -> RunMoment:
    """What is known of one run at a timestamp: the position error, and whether the frame was dropped."""
    return RunMoment.of(hive().runs.moment(run_id, asked_timestamp_s()))


@TABLE.get(Section.RUNS, "/comparison", Comparison, COMPARISON_ARGUMENTS)
def comparison() -> Comparison:
    """A few runs side by side under one protocol, as `slamhive compare --json` prints them."""
    group = request.args.get("group", "")
    if group not in {"", "configuration"}:
        raise InvalidInput(f"group {group[:40]!r} is not allowed", "use configuration, or leave it out")
    numbers = read_run_ids(request.args.getlist("runs"))
    compared = hive().run_comparisons.of(numbers, request.args.get("protocol") or None, grouped=bool(group))
    return compared.document


@TABLE.get(Section.RUNS, "/exports/runs.{format}", tuple(kind.media_type for kind in Format), EXPORT_ARGUMENTS)
def export_runs(format: str) -> Response:  # noqa: A002 - the name in the address
    """All matching runs as one table: CSV, JSON, NDJSON (a JSON object in each line) or Parquet.

    The rows are sent while they are read, so a table of any length takes little memory. Parquet needs pyarrow.
    """
    return export_file(Format(format), request.args)


def _fingerprints(run_id: int) -> list[str]:
    """The protocols of a run; raises NotFound for an unknown run."""
    services = hive()
    services.runs.get(run_id)
    return list(dict.fromkeys(entry.protocol.fingerprint for entry in services.evaluations.of_run(run_id)))
