"""Runs: the list, the page of a run with its plots and files, and the actions on runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from typing import Any
from urllib.parse import urlencode

from flask import (
    Blueprint,
    Response,
    flash,
    jsonify,
    make_response,
    redirect,
    render_template,
    request,
    send_file,
)
from flask import url_for as address

from slamhive.base.errors import NotFound
from slamhive.documents.api import LARGEST_RUN_ID
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import with_trajectory
from slamhive.domain.run import NotesChange, RunState, split_tags
from slamhive.domain.verdict import DEFAULT_RULE
from slamhive.filters.fields import Vocabulary
from slamhive.filters.syntax import FilterError
from slamhive.services.evaluations import ToolFigures, evaluation_notes
from slamhive.services.hive import Hive
from slamhive.services.run_comparison import MOST_RUNS
from slamhive.services.run_differences import odd_stretch
from slamhive.services.runs import list_downloads, open_download
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord, group_uses, protocol_uses
from slamhive.web.columns import SPARK_AFTER, column, settings_of
from slamhive.web.context import hive
from slamhive.web.errors import status_of, wants_json
from slamhive.web.formatting import display_unit, metric_cell, plural
from slamhive.web.presenters import catalogue, scripts, search
from slamhive.web.presenters import runs as presenter
from slamhive.web.presenters.experiments import progress_json
from slamhive.web.presenters.search import column_groups
from slamhive.web.queries import RunListQuery, added, filled, summary
from slamhive.web.request_input import form_text

blueprint = Blueprint("runs", __name__, url_prefix="/runs")

LOG_TAIL_BYTES = 32_000
RUN_ID = f"<int(max={LARGEST_RUN_ID}):run_id>"
"""Run numbers up to what JSON and every database can store."""


@blueprint.get("")
def index() -> Response:
    """List the runs that match the query in the address. An address with empty fields redirects to one without."""
    kept = filled(request.args)
    if kept != request.args.to_dict(flat=False):
        return make_response(redirect(list_address(kept), 302))
    if "add" in kept:
        return make_response(redirect(list_address(added(request.args)), 302))
    services = hive()
    vocabulary = services.searches.vocabulary()
    try:
        query = RunListQuery.from_args(request.args, vocabulary)
    except FilterError as error:
        if wants_json():
            raise
        return make_response(
            _search_page(services, RunListQuery.unread(request.args), vocabulary, error=error), status_of(error)
        )
    if query.grouped:
        figures = search.group_columns(query.columns)
        metrics = [entry.metric.key for entry in figures]
        groups = services.searches.groups(query.search, query.sort, query.after, query.limit, metrics)
        left_out = services.searches.left_out(query.search, groups.runs)
        shown = search.group_rows(groups.records, figures)
        if query.look.sparks:
            repeats = services.searches.repeats(query.search, groups.records, metrics)
            shown = search.with_repeats(shown, figures, repeats)
        content: dict[str, Any] = {
            "groups": search.coloured_groups(shown, figures) if query.look.colours else shown,
            "group_columns": figures,
            "columns": [column(key, vocabulary) for key in query.columns],
            "next_key": groups.next_key,
            "summary": summary(query, len(groups.records), groups.runs, left_out),
            "mixed": services.searches.mixed(query.search, group_uses(groups.records), groups.runs),
        }
    else:
        columns = [column(key, vocabulary) for key in query.columns]
        page = services.runs.page(query.search, query.sort, query.after, query.limit)
        left_out = services.searches.left_out(query.search, page.count)
        rows = search.with_differences(presenter.rows(page.records, columns, services.catalogue.algorithms()))
        content = {
            "rows": search.coloured_runs(rows) if query.look.colours else rows,
            "columns": columns,
            "next_key": page.next_key,
            "summary": summary(query, len(page.records), page.count, left_out),
            "mixed": services.searches.mixed(query.search, protocol_uses(page.records), page.count),
        }
    return make_response(_search_page(services, query, vocabulary, total=left_out.total, **content))


def _search_page(services: Hive, query: RunListQuery, vocabulary: Vocabulary, **content: Any) -> str:
    """Render the search page. Without rows it shows why the query is invalid."""
    saved, algorithms = services.searches.saved(), services.catalogue.algorithms()
    base = list_address({**query.args(), "open": "columns", "columns": [], "pinned": []})
    # The caption of the LaTeX table says what the table lists, and the protocols of its errors.
    groups = content.get("groups", ())
    labels = [row.protocol for row in groups] + [row.run.protocol for row in content.get("rows", ())]
    protocols = sorted({label.label for label in labels if label is not None})
    what = "Mean and standard deviation over the good runs of each configuration." if groups else "Single runs."
    return render_template(
        "runs/index.html",
        query=query,
        rule=DEFAULT_RULE.words,
        protocol_groups=presenter.protocol_groups(),
        column_groups=column_groups(query.columns, algorithms, vocabulary, services.searches.parameters()),
        saved=[(entry, search.saved_args(entry)) for entry in saved],
        current_view=search.place_of(query, saved),
        arranged=search.arranged(base, content.get("columns", ()), query.look.pinned),
        unevaluated=services.searches.unevaluated(),
        chips=search.chips(query),
        spark_after=SPARK_AFTER if SPARK_AFTER in query.columns else query.columns[-1],
        analysis_url=address("analyses.new", where=query.search.text),
        scripts=scripts.search_scripts(query.search.text, query.sort, services.settings),
        parquet=find_spec("pyarrow") is not None,
        latex_caption=f"{what} Protocol: {'; '.join(protocols)}." if protocols else what,
        **content,
    )


@blueprint.get(f"/{RUN_ID}/peek")
def peek(run_id: int) -> str:
    """The part of a page that shows one run beside a list: its outcome, its first metrics, its error, its settings."""
    services = hive()
    run = services.runs.get(run_id)
    found = run.metrics or {}
    figures = [(CATALOGUE[key], metric_cell(CATALOGUE[key], found[key])) for key in PEEKED if key in found]
    return render_template(
        "runs/_peek.html",
        run=run,
        figures=[(metric, cell, display_unit(metric).unit) for metric, cell in figures],
        settings=settings_of(run),
    )


PEEKED = ("ate.rmse", "rpe.rmse", "tracked_fraction", "frames.dropped_fraction", "latency.p95", "cpu.mean", "ram.max")
"""Metrics of a run beside a list, as far as they are known."""


@blueprint.get(f"/{RUN_ID}")
def show(run_id: int) -> str:
    """Show everything about one run."""
    services = hive()
    run = services.runs.get(run_id)
    evaluations = services.evaluations.of_run(run_id)
    algorithm = next((entry for entry in services.catalogue.algorithms() if entry.name == run.algorithm), None)
    choices = presenter.protocol_choices(run, evaluations, request.args.get("protocol"))
    chosen = next((entry for entry in choices if entry.chosen), None)
    tools = _tools(services, run)
    notes = evaluation_notes(services.runs.folder(run_id), None if chosen is None else chosen.fingerprint)
    record = services.runs.record(run_id)
    standing = services.run_comparisons.standing(run, MOST_RUNS)
    match = catalogue.match_of_run(services, record, run.configuration_id)
    downloads = list_downloads(services.runs.folder(run_id), _fingerprints(evaluations))
    return render_template(
        "runs/show.html",
        run=run,
        algorithm=algorithm,
        outcome=presenter.outcome(run),
        verdict=presenter.verdict(run, evaluations),
        rule=DEFAULT_RULE.words,
        remedy=presenter.remedy(run),
        trust_words=presenter.trust_words(run),
        machine=presenter.machine(run),
        wall_time_s=presenter.wall_time_s(run),
        progress=progress_json(services.runs.progress(run_id)) if run.state.active else None,
        parameters=presenter.parameter_rows(run, algorithm, match),
        match=match,
        protocols=choices,
        chosen=chosen,
        accuracy=presenter.accuracy_rows(run, choices, services.current_protocols.figures(run_id)),
        hints=notes.hints,
        missing=presenter.missing_by_reason(notes.missing),
        standing=standing,
        tiles=presenter.tiles(run, standing),
        odd=odd_stretch(services.runs.series(run_id)) if run.state is RunState.SUCCEEDED else None,
        tools=presenter.tool_rows(tools),
        tools_waiting=presenter.waiting(tools),
        measured=presenter.metric_rows(run, needs_protocol=False),
        protections=presenter.protections(record),
        gpu=presenter.gpu(record),
        noted=bool(record),
        provenance=presenter.flatten(record),
        events=services.runs.events(run_id),
        evaluations=evaluations,
        with_trajectory=with_trajectory,
        evaluating=any(entry.state in (EvaluationState.QUEUED, EvaluationState.RUNNING) for entry in evaluations),
        log=services.runs.log_of(run, LOG_TAIL_BYTES),
        downloads=downloads,
        stills=presenter.stills(
            {file.key for file in downloads}, None if run.protocol is None else run.protocol.fingerprint
        ),
        protocol_groups=presenter.protocol_groups(),
        scripts=scripts.run_scripts(run_id, services.settings),
    )


@blueprint.get(f"/{RUN_ID}/files/<key>")
def download(run_id: int, key: str) -> Response:
    """Download one of the known files in the run folder."""
    services = hive()
    services.runs.get(run_id)
    found, stream = open_download(
        services.runs.folder(run_id),
        _fingerprints(services.evaluations.of_run(run_id)),
        key,
    )
    return send_file(
        stream, mimetype=found.media_type, as_attachment=True, download_name=f"run-{run_id}-{found.name}", max_age=0
    )


@blueprint.post(f"/{RUN_ID}/cancel")
def cancel(run_id: int) -> Response:
    """Request the cancellation of a run."""
    run = hive().runs.cancel(run_id)
    flash(f"Run {run_id} is {'cancelled' if run.state is RunState.CANCELLED else 'being cancelled'}.", "info")
    return _to_run(run_id)


@blueprint.post(f"/{RUN_ID}/retry")
def retry(run_id: int) -> Response:
    """Queue a new run with the same configuration."""
    again = hive().runs.retry(run_id)
    flash(f"Run {again.id} repeats run {run_id}.", "success")
    return _to_run(again.id)


@blueprint.post(f"/{RUN_ID}/evaluate")
def evaluate(run_id: int) -> Response:
    """Evaluate one run under the selected protocol, or the default for its sensors."""
    queued = hive().evaluations.queue([run_id], request.form.get("protocol") or None)
    flash("The evaluation is queued." if queued else "This evaluation is already queued or finished.", "info")
    return _to_run(run_id)


@blueprint.post(f"/{RUN_ID}/notes")
def annotate(run_id: int) -> Response:
    """Replace the note and the tags of one run; a field that is not sent stays as it is."""
    services = hive()
    note = form_text("note") if "note" in request.form else None
    old = services.runs.get(run_id).tags
    kept = split_tags(request.form["tags"]) if "tags" in request.form else old
    change = NotesChange(note, kept, tuple(tag for tag in old if tag not in kept))
    stored = services.notes.change([run_id], change)[run_id]
    if wants_json():
        return jsonify(stored.content)
    flash("Note and tags are stored.", "success")
    return _to_run(run_id)


@blueprint.post(f"/{RUN_ID}/compare")
def compare(run_id: int) -> Response:
    """Evaluate one run under the protocols of all published tools."""
    services = hive()
    services.check_writable()
    queued = len(services.comparisons.queue(run_id))
    flash(f"{plural(queued, 'evaluation')} queued." if queued else "The metrics of every tool exist already.", "info")
    return _to_run(run_id)


@blueprint.post(f"/{RUN_ID}/protocol")
def use_protocol(run_id: int) -> Response:
    """Make lists and searches show the metrics of another protocol."""
    services = hive()
    services.check_writable()
    services.current_protocols.use([run_id], request.form.get("fingerprint", ""))
    flash(f"Lists now show run {run_id} under this protocol.", "success")
    return _to_run(run_id)


def _tools(services: Hive, run: RunRecord) -> list[ToolFigures]:
    """The metrics under each tool's protocol; none if the dataset or algorithm no longer exists."""
    if run.state is not RunState.SUCCEEDED:
        return []
    try:
        return services.comparisons.of_run(run)
    except NotFound:
        return []


def list_address(args: Mapping[str, str | list[str]]) -> str:
    """The address of the list with these arguments, whatever their names are."""
    query = urlencode(args, doseq=True)
    return address("runs.index") + (f"?{query}" if query else "")


def _to_run(run_id: int) -> Response:
    return make_response(redirect(address("runs.show", run_id=run_id), 303))


def _fingerprints(evaluations: Iterable[EvaluationRecord]) -> list[str]:
    return list(dict.fromkeys(entry.protocol.fingerprint for entry in evaluations))
