"""The first page, the events that keep open pages up to date, and the machines."""

from __future__ import annotations

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.errors import Unavailable
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.accounts import Action
from slamhive.domain.run import RunState
from slamhive.filters.words import matching
from slamhive.store.records import RunSort
from slamhive.web.columns import column
from slamhive.web.context import caller, callers, demo_work, hive, live_hub
from slamhive.web.long_work import DEMO
from slamhive.web.presenters import home
from slamhive.web.presenters.experiments import active_runs, progress_json
from slamhive.web.presenters.runs import rows
from slamhive.web.views.experiments import with_time_left

blueprint = Blueprint("dashboard", __name__)

RESULT_COLUMNS = (
    "id",
    "algorithm",
    "dataset",
    "parameters",
    "outcome",
    "ate.rmse",
    "tracked_fraction",
    "ended_at",
)
LIST_LENGTH = 10
MOST_ON_COVER = 50
GOING_ON = (ConfigurationStanding.STORING, ConfigurationStanding.ACTIVE, ConfigurationStanding.PAUSED)
ENDED_STATES = tuple(state for state in RunState if state.ended)


@blueprint.get("/")
def index() -> str:
    """Show what is going on, what needs somebody, and the latest answers; the cover of an archive; the way to begin."""
    services = hive()
    view_only = Action.CHANGE not in caller().may
    counts = services.runs.counts()
    total = sum(counts.values())
    experiments = services.experiments.list()
    if view_only and caller().role is None:
        return render_template(
            "dashboard/cover.html",
            cover=home.cover(services, total),
            experiments=experiments[:MOST_ON_COVER],
            more=max(0, len(experiments) - MOST_ON_COVER),
            cards=home.answer_cards(services, experiments),
        )
    if not total and not experiments:
        return render_template("dashboard/begin.html", demo=demo_work().latest(DEMO))
    algorithms = services.catalogue.algorithms()
    ended = services.runs.page(matching(states=ENDED_STATES), RunSort("ended_at"), None, LIST_LENGTH)
    queued = services.runs.page(matching(states=(RunState.QUEUED,)), RunSort("id", descending=False), None, 1)
    active = [(run, progress_json(services.runs.progress(run.id))) for run in active_runs(services)]
    cards = home.answer_cards(services, experiments)
    return render_template(
        "dashboard/index.html",
        headline=home.headline(len(active), queued.total),
        worker_missing=bool(queued.total) and not view_only and not services.worker_alive(),
        going_on=with_time_left(entry for entry in experiments if entry.state in GOING_ON)[:LIST_LENGTH],
        active=active,
        queued=queued.total,
        needs=[] if view_only else home.needs(services, experiments, cards),
        cards=cards,
        more_experiments=max(0, len(experiments) - len(cards)),
        ended_total=ended.total,
        ended_rows=rows(ended.records, map(column, RESULT_COLUMNS), algorithms),
        result_columns=[column(key) for key in RESULT_COLUMNS],
    )


@blueprint.post("/demo")
def demo() -> Response:
    """Start the demo: builds, a recording, and an experiment on it."""
    demo_work().start()
    return make_response(redirect(address("dashboard.index"), 303))


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


# -- the nodes: which machines execute runs, and what they do ----------------------------------------------------------

nodes_blueprint = Blueprint("nodes", __name__, url_prefix="/nodes")


@nodes_blueprint.get("", endpoint="index")
def machines() -> str:
    """Show nodes, what runs on them, throughput and disturbance."""
    return render_template("nodes/index.html", found=hive().nodes.overview())


@nodes_blueprint.post("/drain")
def drain() -> Response:
    """Keep further runs away from a node."""
    return _set_drained(True, "No further run starts on {}.")


@nodes_blueprint.post("/undrain")
def undrain() -> Response:
    """Let runs start on a node again."""
    return _set_drained(False, "Runs start on {} again.")


def _set_drained(drained: bool, done: str) -> Response:
    node = request.form.get("node", "")
    hive().nodes.drain(request.form.get("executor", ""), node, drained)
    flash(done.format(node), "success")
    return make_response(redirect(address("nodes.index"), 303))
