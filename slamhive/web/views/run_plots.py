"""The plots of a run, their data, and what its sensors saw at a moment."""

from __future__ import annotations

from flask import Blueprint, Response, jsonify, make_response, request

from slamhive.analysis.colours import colour_of
from slamhive.errors import InvalidInput
from slamhive.web.context import hive
from slamhive.web.figures import best_plane, captions, figure_csv, run_figures, timeline
from slamhive.web.presenters import moments
from slamhive.web.sparks import error_image
from slamhive.web.views.runs import RUN_ID

blueprint = Blueprint("run_plots", __name__, url_prefix="/runs")

LATEST_TIMESTAMP_S = 2**32
SPARK_KEPT_S = 60


@blueprint.get(f"/{RUN_ID}/figures.json")
def figures(run_id: int) -> Response:
    """All plots of a run, with captions and the reasons for missing ones."""
    services = hive()
    run = services.runs.get(run_id)
    series = services.runs.series(run_id)
    colour = colour_of(run.algorithm, (entry.name for entry in services.catalogue.algorithms()))
    track = series.groundtruth or series.estimate
    return make_response(
        jsonify(
            figures=run_figures(series, run.algorithm, colour),
            captions=captions(series, None if run.protocol is None else run.protocol.label),
            reasons=series.reasons,
            timeline=timeline(series),
            best_plane="xy" if track is None else best_plane(track),
        )
    )


@blueprint.get(f"/{RUN_ID}/error.svg")
def error_line(run_id: int) -> Response:
    """The error over time as a sparkline for lists, which load it when its row comes into view."""
    response = Response(error_image(hive().runs.error_over_time(run_id)), mimetype="image/svg+xml")
    response.cache_control.private = True
    response.cache_control.max_age = SPARK_KEPT_S
    return response


@blueprint.get(f"/{RUN_ID}/moment.json")
def moment(run_id: int) -> Response:
    """The error, the frame, and what the sensors saw at ``timestamp``, a header timestamp in s."""
    services = hive()
    run = services.runs.get(run_id)
    found = services.runs.moment(run_id, asked_timestamp_s())
    views = moments.sensor_views(services, run, found.shown_at_s)
    return make_response(jsonify(words=moments.words(found), views=views))


def asked_timestamp_s() -> float:
    """``timestamp`` of the request; raises InvalidInput."""
    timestamp_s = request.args.get("timestamp", type=float)
    if timestamp_s is None or not 0 <= timestamp_s <= LATEST_TIMESTAMP_S:
        raise InvalidInput(
            f"timestamp={request.args.get('timestamp', '')[:40]!r} is no time",
            f"give a header timestamp in s, up to {LATEST_TIMESTAMP_S:g}",
        )
    return timestamp_s


@blueprint.get(f"/{RUN_ID}/figures/<figure>.csv")
def figure_data(run_id: int, figure: str) -> Response:
    """The data of one plot as CSV."""
    response = Response(figure_csv(hive().runs.series(run_id), figure), mimetype="text/csv")
    response.headers["Content-Disposition"] = f'attachment; filename="run-{run_id}-{figure}.csv"'
    return response
