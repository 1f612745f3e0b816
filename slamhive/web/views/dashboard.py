"""The dashboard, and the events that keep open pages up to date."""

from __future__ import annotations

from flask import Blueprint, Response, jsonify, make_response, render_template

from slamhive.base.errors import Unavailable
from slamhive.domain.run import RunState
from slamhive.filters.words import matching
from slamhive.services.experiments import ConfigurationStanding
from slamhive.store.records import RunSort
from slamhive.web.columns import column
from slamhive.web.context import callers, hive, live_hub
from slamhive.web.presenters.experiments import active_runs, progress_json
from slamhive.web.presenters.runs import rows
from slamhive.web.views.experiments import with_time_left

blueprint = Blueprint("dashboard", __name__)

RESULT_COLUMNS = (
    "id",
    "algorithm",
    "dataset",
    "variant",
    "parameters",
    "outcome",
    "ended_at",
    "ate.rmse",
    "tracked_fraction",
)
QUEUE_COLUMNS = ("id", "algorithm", "dataset", "variant", "parameters", "created_at")
LIST_LENGTH = 10
GOING_ON = (ConfigurationStanding.STORING, ConfigurationStanding.ACTIVE, ConfigurationStanding.PAUSED)
ENDED_STATES = tuple(state for state in RunState if state.ended)


@blueprint.get("/")
def index() -> str:
    """Show the queue, active runs and the latest results."""
    services = hive()
    algorithms = services.catalogue.algorithms()
    ended = services.runs.page(matching(states=ENDED_STATES), RunSort("ended_at"), None, LIST_LENGTH)
    queued = services.runs.page(matching(states=(RunState.QUEUED,)), RunSort("id", descending=False), None, LIST_LENGTH)
    counts = services.runs.counts()
    return render_template(
        "dashboard/index.html",
        counts=counts,
        total=sum(counts.values()),
        unevaluated=services.searches.unevaluated(),
        worker_alive=services.worker_alive(),
        experiments=with_time_left(entry for entry in services.experiments.list() if entry.standing in GOING_ON),
        active=[(run, progress_json(services.runs.progress(run.id))) for run in active_runs(services)],
        queued=queued,
        queued_rows=rows(queued.records, map(column, QUEUE_COLUMNS), algorithms),
        queue_columns=[column(key) for key in QUEUE_COLUMNS],
        ended=ended,
        ended_rows=rows(ended.records, map(column, RESULT_COLUMNS), algorithms),
        result_columns=[column(key) for key in RESULT_COLUMNS],
        has_datasets=bool(services.catalogue.datasets()),
    )


@blueprint.get("/events")
def events() -> Response:
    """Server-sent events: a ``state`` event after every poll of the database.

    Where no more streams fit, the status is 204: browsers then stop asking, and the page polls instead. A reader who
    turns pages fast comes to that, because the server notices only after a moment that a page is left.
    """
    try:
        stream = live_hub().open()
    except Unavailable:
        return Response(status=204)
    response = Response(stream.events(callers().watch()), mimetype="text/event-stream")
    response.headers["Cache-Control"] = "no-store"
    response.headers["X-Accel-Buffering"] = "no"
    response.call_on_close(stream.close)
    return response


@blueprint.get("/live.json")
def live() -> Response:
    """The current state as JSON, for pages that could not open a stream."""
    return make_response(jsonify(live_hub().latest()))


@blueprint.get("/healthz")
def health() -> Response:
    """Answer 200 while the server and its database work."""
    hive().runs.counts()
    return make_response(jsonify(status="ok"))
