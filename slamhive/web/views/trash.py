"""The trash: deleted runs, taken out again or removed for good."""

from __future__ import annotations

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.bounds import whole_number
from slamhive.documents.api_requests import LARGEST_RUN_ID
from slamhive.web.context import hive
from slamhive.web.formatting import plural

blueprint = Blueprint("trash", __name__, url_prefix="/trash")
MOST_SHOWN = 500


@blueprint.get("")
def index() -> str:
    """List the deleted runs."""
    found = hive().trash.listed()
    return render_template("trash/index.html", runs=found[:MOST_SHOWN], total=len(found))


@blueprint.post("/restore")
def restore() -> Response:
    """Take runs out of the trash."""
    trash, deleted_at = hive().trash, request.form.get("deleted_at")
    numbers = [whole_number(text, "run", 1, LARGEST_RUN_ID) for text in request.form.getlist("run")]
    runs = trash.restore(trash.deleted_together(deleted_at) if deleted_at else numbers)
    flash(f"{plural(len(runs), 'run')} restored." if runs else "No run is selected.", "success" if runs else "warning")
    target = address("runs.show", run_id=runs[0]) if len(runs) == 1 else address("runs.index")
    return make_response(redirect(target, 303))


@blueprint.post("/empty")
def empty() -> Response:
    """Remove the files of all deleted runs for good."""
    count = hive().trash.empty()
    flash(f"{plural(count, 'run')} removed for good." if count else "The trash is empty.", "info")
    return make_response(redirect(address("trash.index"), 303))
