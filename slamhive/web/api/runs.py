"""Runs: lists, metrics, files, comparison and exports."""

from __future__ import annotations

from flask import Response, request, send_file, url_for
from werkzeug.exceptions import RequestedRangeNotSatisfiable

from slamhive.base.bounds import whole_number
from slamhive.base.errors import InvalidInput
from slamhive.documents.api import (
    ActedOn,
    DeletedRunDocument,
    DeletionRequest,
    DownloadDocument,
    EvaluationRequest,
    FilterField,
    FilterFields,
    FoundEvaluation,
    FoundRuns,
    FoundSharing,
    FoundTags,
    FoundThings,
    NotesRequest,
    ProgressDocument,
    ProtocolMetrics,
    Queued,
    Removal,
    Removed,
    RunFilesDocument,
    RunNumbers,
    RunPage,
    RunsDocument,
    RunSelection,
    SavedSearchDocument,
    SavedSearches,
    SearchRequest,
    SharingRequest,
    ShownProtocolRequest,
    TagsRequest,
    TrashedRuns,
)
from slamhive.documents.catalogue import FoundThing, MatchDocument
from slamhive.documents.protocol import ComparisonDocument, ProtocolSearchDocument
from slamhive.documents.run import RunDocument, RunMoment, RunWith
from slamhive.documents.submission import OPTIONS, Submission
from slamhive.domain.finding import FoundAction
from slamhive.domain.run import NotesChange
from slamhive.services.exports import ExportFormat, RunExport
from slamhive.services.finding import LONGEST_TEXT, change_found, find
from slamhive.services.run_comparison import read_run_ids
from slamhive.services.runs import list_downloads, open_download
from slamhive.services.search_actions import as_expected
from slamhive.services.sharing import SharingChange
from slamhive.store.records import RunSort, SavedSearchRecord
from slamhive.web.api.operation import (
    COMPARISON_ARGUMENTS,
    EXPORT_ARGUMENTS,
    FIND_ARGUMENTS,
    LOG_ARGUMENTS,
    PRINTED_ARGUMENTS,
    RUN_ARGUMENTS,
    TABLE,
    TIMESTAMP_ARGUMENTS,
    Section,
)
from slamhive.web.context import hive
from slamhive.web.figures import figure_csv
from slamhive.web.presenters.search import fields_of_filters
from slamhive.web.queries import EXPORT_LIMIT, RunListQuery
from slamhive.web.views.run_plots import asked_timestamp_s
from slamhive.web.views.search import export_file

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
    query = RunListQuery.from_args(request.args, services.searches.vocabulary(), EXPORT_LIMIT)
    page = services.runs.page(query.search, query.sort, query.after, query.limit)
    following = None if page.next_key is None else url_for("api.runs", **query.at(page.next_key).args())
    return RunPage(runs=tuple(map(RunDocument.of, page.records)), total=page.total, next=following)


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


@TABLE.get(Section.RUNS, "/runs/{run_id}/progress", ProgressDocument)
def run_progress(run_id: int) -> ProgressDocument:
    """The progress of one run."""
    services = hive()
    state = services.runs.get(run_id).state
    progress = services.runs.progress(run_id)
    return (
        ProgressDocument(state=state, text=state.value)
        if progress is None
        else ProgressDocument.of(progress, state=state)
    )


@TABLE.get(Section.RUNS, "/runs/{run_id}/log", ("text/plain",), LOG_ARGUMENTS)
def run_log(run_id: int) -> Response:
    """The end of the output of one run, so far."""
    wanted = whole_number(request.args.get("bytes", str(MOST_LOG_BYTES)), "bytes", 1, MOST_LOG_BYTES)
    return Response(hive().runs.log(run_id, wanted), mimetype="text/plain")


@TABLE.get(Section.RUNS, "/runs/{run_id}/files", RunFilesDocument)
def run_files(run_id: int) -> RunFilesDocument:
    """The files of one run. `traj.txt` is its trajectory (TUM), `FINGERPRINT-traj.tum` the aligned one."""
    services = hive()
    found = list_downloads(services.runs.folder(run_id), _fingerprints(run_id))
    return RunFilesDocument(
        files=tuple(
            DownloadDocument.of(file, address=url_for("api.run_file", run_id=run_id, key=file.key)) for file in found
        )
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
    """One run at a timestamp: the position error, and whether the frame was dropped."""
    return RunMoment.of(hive().runs.moment(run_id, asked_timestamp_s()))


@TABLE.get(Section.RUNS, "/comparison", ComparisonDocument, COMPARISON_ARGUMENTS)
def comparison() -> ComparisonDocument:
    """A few runs side by side under one protocol, as `slamhive compare --json` prints them."""
    group = request.args.get("group", "")
    if group not in {"", "configuration"}:
        raise InvalidInput(f"group {group[:40]!r} is not allowed", "use configuration, or leave it out")
    numbers = read_run_ids(request.args.getlist("runs"))
    compared = hive().run_comparisons.of(numbers, request.args.get("protocol") or None, grouped=bool(group))
    return compared.document


@TABLE.get(Section.RUNS, "/exports/runs.{format}", tuple(kind.media_type for kind in ExportFormat), EXPORT_ARGUMENTS)
def export_runs(format: str) -> Response:  # noqa: A002 - the name in the address
    """All matching runs as one table: CSV, JSON, NDJSON (a JSON object in each line) or Parquet.

    The rows are sent while they are read, so a table of any length takes little memory. Parquet needs pyarrow.
    """
    return export_file(ExportFormat(format), request.args)


def _fingerprints(run_id: int) -> list[str]:
    """The protocols of a run; raises NotFound for an unknown run."""
    services = hive()
    services.runs.get(run_id)
    return list(dict.fromkeys(entry.protocol.fingerprint for entry in services.evaluations.of_run(run_id)))


# -- changes of runs: start, cancel, evaluate, tag, delete and restore -------------------------------------------------


@TABLE.post(Section.RUN_CHANGES, "/runs", RunsDocument, body=Submission, status=201)
def submit(body: Submission) -> RunsDocument:
    """Queue runs of one configuration; answers with them."""
    return RunsDocument(runs=tuple(map(RunDocument.of, hive().runs.submit(body))))


@TABLE.post(Section.RUN_CHANGES, "/runs/preview", MatchDocument, body=Submission)
def preview(body: Submission) -> MatchDocument:
    """Check a submission without queueing it; answers with the sensors and what is taken from them."""
    return MatchDocument.of_match(hive().configurations.check(body).match)


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/cancel", RunDocument, status=202)
def cancel(run_id: int) -> RunDocument:
    """Cancel a queued run, or ask for the end of an active one."""
    return RunDocument.of(hive().runs.cancel(run_id))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/retry", RunDocument, status=201)
def retry(run_id: int) -> RunDocument:
    """Queue the same again as a new run."""
    return RunDocument.of(hive().runs.retry(run_id))


@TABLE.post(Section.RUN_CHANGES, "/evaluations", Queued, body=EvaluationRequest, status=202)
def evaluate(body: EvaluationRequest) -> Queued:
    """Queue evaluations."""
    if body.alignment is not None and body.protocol is not None:
        raise InvalidInput("alignment and protocol exclude each other", "give one of them")
    OPTIONS["alignment"].check(body.alignment)
    return Queued(queued=len(hive().evaluations.queue(body.runs, body.protocol or body.alignment)))


@TABLE.get(Section.RUNS, "/runs/{run_id}/protocol-search", ProtocolSearchDocument, PRINTED_ARGUMENTS)
def search_protocols(run_id: int) -> ProtocolSearchDocument:
    """The protocols under which one run gives a number that a paper prints, the most usual first."""
    asked = request.args
    value, metric = asked.get("value"), asked.get("metric", "ate")
    if not value:
        raise InvalidInput("value is missing", "give the number as the paper prints it: ?value=0.016&metric=ate")
    return hive().protocol_searches.search(run_id, value, metric, asked.get("unit") or None)


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/tools", Queued, status=202)
def evaluate_as_tools(run_id: int) -> Queued:
    """Queue an evaluation of one run as each published tool does it."""
    services = hive()
    services.check_writable()
    return Queued(queued=len(services.comparisons.queue(run_id)))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/protocol", RunDocument, body=ShownProtocolRequest)
def show_protocol(run_id: int, body: ShownProtocolRequest) -> RunDocument:
    """Choose the protocol whose metrics lists and searches show for one run."""
    services = hive()
    services.check_writable()
    services.current_protocols.use([run_id], body.protocol)
    return RunDocument.of(services.runs.get(run_id))


@TABLE.post(Section.RUN_CHANGES, "/runs/{run_id}/notes", RunDocument, body=NotesRequest)
def annotate(run_id: int, body: NotesRequest) -> RunDocument:
    """Replace the note or the tags of one run."""
    services = hive()
    services.notes.replace(run_id, body.note, body.tags)
    return RunDocument.of(services.runs.get(run_id))


@TABLE.post(Section.RUN_CHANGES, "/runs/tags", RunsDocument, body=TagsRequest)
def tag(body: TagsRequest) -> RunsDocument:
    """Add and remove tags of some runs."""
    hive().notes.change(body.runs, NotesChange(add=body.add, remove=body.remove))
    records = hive().store.read(lambda t: t.runs.get_many(body.runs, with_metrics=True))
    return RunsDocument(runs=tuple(map(RunDocument.of, records)))


@TABLE.post(Section.RUN_CHANGES, "/runs/share", RunsDocument, body=SharingRequest)
def share(body: SharingRequest) -> RunsDocument:
    """Choose who may see some runs; their owner may, and admins."""
    return RunsDocument(
        runs=tuple(map(RunDocument.of, hive().sharings.runs(body.runs, SharingChange(body.visibility))))
    )


@TABLE.post(Section.RUN_CHANGES, "/runs/delete", RunNumbers, body=RunSelection)
def delete(body: RunSelection) -> RunNumbers:
    """Move runs that have ended to the trash, with their files."""
    return RunNumbers(runs=tuple(run.id for run in hive().trash.delete(body.runs)))


@TABLE.get(Section.RUN_CHANGES, "/trash", TrashedRuns)
def trash() -> TrashedRuns:
    """The runs in the trash, the last deleted first."""
    return TrashedRuns(runs=tuple(map(DeletedRunDocument.of, hive().trash.listed())))


@TABLE.post(Section.RUN_CHANGES, "/trash/restore", RunNumbers, body=RunSelection)
def restore(body: RunSelection) -> RunNumbers:
    """Take runs out of the trash, under their old numbers."""
    return RunNumbers(runs=tuple(hive().trash.restore(body.runs)))


@TABLE.post(Section.RUN_CHANGES, "/trash/empty", Removed)
def empty_trash() -> Removed:
    """Remove the files of all deleted runs for good."""
    return Removed(removed=hive().trash.empty())


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.EVALUATE}", ActedOn, body=FoundEvaluation, status=202)
def evaluate_found(body: FoundEvaluation) -> ActedOn:
    """Queue an evaluation of each run of a search that succeeded."""
    return _change_found(FoundAction.EVALUATE, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.RETRY}", ActedOn, body=FoundRuns, status=201)
def retry_found(body: FoundRuns) -> ActedOn:
    """Queue a new run for each run of a search that has ended."""
    return _change_found(FoundAction.RETRY, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.TAGS}", ActedOn, body=FoundTags)
def tag_found(body: FoundTags) -> ActedOn:
    """Add and remove tags of all runs of a search."""
    return _change_found(FoundAction.TAGS, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.SHARE}", ActedOn, body=FoundSharing)
def share_found(body: FoundSharing) -> ActedOn:
    """Choose who may see all runs of a search; their owner may, and admins."""
    return _change_found(FoundAction.SHARE, body)


@TABLE.post(Section.RUN_CHANGES, f"/runs/search/{FoundAction.DELETE}", ActedOn, body=FoundRuns)
def delete_found(body: FoundRuns) -> ActedOn:
    """Move all runs of a search that have ended to the trash."""
    return _change_found(FoundAction.DELETE, body)


@TABLE.post(Section.RUN_CHANGES, "/trash/restore-together", RunNumbers, body=DeletionRequest)
def restore_together(body: DeletionRequest) -> RunNumbers:
    """Take out of the trash what was deleted together."""
    trash = hive().trash
    return RunNumbers(runs=tuple(trash.restore(trash.deleted_together(body.deleted_at))))


def _change_found(action: FoundAction, body: FoundRuns) -> ActedOn:
    services = hive()
    run_ids = as_expected(services.searches.find(body.where), body.count)
    return ActedOn.of(change_found(services, action, run_ids, body))


# -- saved searches, and the names that a filter may use ---------------------------------------------------------------


@TABLE.get(Section.SEARCHES, "/fields", FilterFields)
def filter_fields() -> FilterFields:
    """The names that a filter may use, with unit and values to choose from."""
    return FilterFields(fields=tuple(map(FilterField.model_validate, fields_of_filters(hive()))))


@TABLE.get(Section.SEARCHES, "/find", FoundThings, FIND_ARGUMENTS)
def find_anything() -> FoundThings:
    """Everything with these words in its name or description, of each kind the best 8."""
    text = request.args.get("q", "").strip()[:LONGEST_TEXT]
    if not text:
        raise InvalidInput("q is empty", "say what to find, for example ?q=kiss")
    groups = find(hive(), text)
    return FoundThings(found=tuple(FoundThing.of(entry) for entries in groups.values() for entry in entries))


@TABLE.get(Section.SEARCHES, "/searches", SavedSearches)
def searches() -> SavedSearches:
    """All saved searches."""
    return SavedSearches(searches=tuple(map(SavedSearchDocument.of, hive().searches.saved())))


@TABLE.post(Section.SEARCHES, "/searches", SavedSearchDocument, body=SearchRequest, status=201)
def save_search(body: SearchRequest) -> SavedSearchDocument:
    """Save a search, in place of one of the same name."""
    services = hive()
    services.check_writable()
    RunExport(body.columns, services.searches.vocabulary())  # refuses unknown columns
    sort = RunSort(body.sort, descending=body.descending)
    look = body.pinned, body.colours, body.sparks
    record = SavedSearchRecord(body.name, body.where, body.columns, sort, body.group, *look)
    services.searches.save(record)
    return SavedSearchDocument.of(services.searches.saved_named(body.name))


@TABLE.post(Section.SEARCHES, "/searches/{name}/delete", Removal)
def delete_search(name: str) -> Removal:
    """Delete a saved search."""
    hive().searches.delete(name)
    return Removal(removed=name)
