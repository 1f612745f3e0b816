"""Challenges: what they ask for, their rankings, and the way to submit."""

from __future__ import annotations

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.documents.challenge import ImageEntry
from slamhive.documents.model import parse
from slamhive.domain.challenge import shown
from slamhive.web import challenge_files
from slamhive.web.context import caller, hive

blueprint = Blueprint("challenges", __name__, url_prefix="/challenges")


@blueprint.get("")
def index() -> str:
    """List challenges."""
    return render_template("challenges/index.html", found=hive().challenges.briefs())


@blueprint.get("/<name>")
def show(name: str) -> str:
    """Show a challenge, the ranking of one phase, and the caller's own submissions."""
    challenges = hive().challenges
    return render_template(
        "challenges/show.html",
        challenge=challenges.get(name),
        ranking=challenges.ranking(name, request.args.get("phase") or None),
        submissions=challenge_files.own_submissions(name),
        may_submit=challenge_files.may_submit(),
        versions=hive().versions.labels(),
        team=caller().account,
        shown=shown,
    )


@blueprint.post("/<name>/submit")
def submit(name: str) -> Response:
    """Take trajectories, and queue their evaluation."""
    team, phase = request.form.get("team", "").strip(), request.form.get("phase", "")
    made = challenge_files.send_form(name, team, phase, request.files.getlist("files"))
    flash(f"Submission {made.id} of team {made.team} waits for its evaluation.", "success")
    return make_response(redirect(address("challenges.show", name=name, phase=made.phase), 303))


@blueprint.post("/<name>/submit-package")
def submit_package(name: str) -> Response:
    """Take a version of a package, and queue its runs."""
    fields = ("package", "algorithm", "team", "phase")
    asked = parse(ImageEntry, {field: request.form.get(field, "").strip() for field in fields})
    made = challenge_files.send_image(name, asked)
    flash(f"Submission {made.id} of team {made.team} waits for its runs.", "success")
    return make_response(redirect(address("challenges.show", name=name, phase=made.phase), 303))


@blueprint.post("/<name>/submissions/<submission>/cancel")
def cancel(name: str, submission: str) -> Response:
    """Cancel a submission of the caller."""
    made = challenge_files.cancel(name, submission)
    flash(f"Submission {made.id} of team {made.team} is cancelled.", "success")
    return make_response(redirect(address("challenges.show", name=name, phase=made.phase), 303))
