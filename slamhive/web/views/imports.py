"""Import in the browser: the page that leads to all kinds, and trajectories, looked at before they are stored."""

from __future__ import annotations

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.errors import SlamHiveError, unknown
from slamhive.domain.sensors import SensorSetup
from slamhive.services.staged_trajectories import StagedFacts, StagedTrajectories
from slamhive.web.context import caller, hive
from slamhive.web.errors import status_of
from slamhive.web.formatting import plural

blueprint = Blueprint("imports", __name__, url_prefix="/import")

MOST_SENT_BYTES = 64_000_000
"""Of the trajectories of one web form."""


@blueprint.get("")
def index() -> str:
    """Show what can be imported, and the web form for trajectories."""
    hive().check_writable()
    return _page()


@blueprint.post("/trajectories")
def look() -> Response:
    """Read trajectories, and show what was found before anything is stored."""
    form = request.form
    staged = StagedTrajectories(hive())
    try:
        setup = form.get("sensors", "")
        if setup not in list(SensorSetup):
            raise unknown("sensor set-up", setup, list(SensorSetup))
        facts = StagedFacts(form.get("algorithm", "").strip(), form.get("dataset", ""), SensorSetup(setup))
        files = [(file.filename or "", file.stream) for file in request.files.getlist("files") if file.filename]
        token = staged.add(files, facts, caller().account)
        report = staged.rehearse(token, caller().account)
    except SlamHiveError as error:
        return make_response(_page(error), status_of(error))
    return make_response(render_template("imports/found.html", token=token, report=report, facts=facts))


@blueprint.post("/trajectories/<token>/store")
def store(token: str) -> Response:
    """Store the trajectories as runs, and evaluate them."""
    report = StagedTrajectories(hive()).store(token, caller().account)
    flash(
        f"{plural(report.imported, 'run')} imported; {'it is' if report.imported == 1 else 'they are'} evaluated next.",
        "success",
    )
    where = f"id in ({', '.join(map(str, report.run_ids))})"
    return make_response(redirect(address("runs.index", where=where), 303))


@blueprint.post("/trajectories/<token>/discard")
def discard(token: str) -> Response:
    """Forget the trajectories."""
    StagedTrajectories(hive()).discard(token, caller().account)
    flash("The trajectories are discarded. Nothing is stored.", "info")
    return make_response(redirect(address("imports.index"), 303))


def _page(error: SlamHiveError | None = None) -> str:
    return render_template(
        "imports/index.html", error=error, datasets=hive().catalogue.datasets(), setups=list(SensorSetup)
    )
