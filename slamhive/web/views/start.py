"""The web form that starts runs."""

from __future__ import annotations

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request, url_for

from slamhive.base.errors import SlamHiveError
from slamhive.domain.accounts import VISIBILITY_LABELS
from slamhive.domain.protocol import ALIGNMENT_LABELS
from slamhive.executors.registry import EXECUTORS
from slamhive.web.context import hive
from slamhive.web.errors import status_of
from slamhive.web.presenters.catalogue import dataset_choices, step_kinds
from slamhive.web.run_form import CONTENT_OPTIONS, RUN_OPTIONS, RunForm, preview, read_form

blueprint = Blueprint("start", __name__, url_prefix="/runs/new")


@blueprint.get("")
def form() -> str:
    """Show the web form with the values from the address; only those are checked."""
    values = request.args.to_dict()
    filled = read_form(hive(), values)
    filled.errors = {name: text for name, text in filled.errors.items() if values.get(name)}
    return _page(filled)


@blueprint.get("/preview")
def check() -> Response:
    """The preview and the invalid fields, as JSON for the open page."""
    filled = read_form(hive(), request.args.to_dict())
    words = _preview(filled)
    return make_response(jsonify(preview=words, errors=filled.errors, bound=filled.bound, used=filled.used))


@blueprint.post("")
def submit() -> Response | tuple[str, int]:
    """Queue the runs, or show the web form again with its errors."""
    values = request.form.to_dict()
    filled = read_form(hive(), values)
    if filled.submission is None:
        return _page(filled), 400
    try:
        runs = hive().runs.submit(filled.submission)
    except SlamHiveError as error:
        filled.fail(error)
        return _page(filled), status_of(error)
    if len(runs) == 1:
        flash(f"Run {runs[0].id} was put into the queue.", "success")
        return make_response(redirect(url_for("runs.show", run_id=runs[0].id), 303))
    flash(f"Runs {runs[0].id} to {runs[-1].id} were put into the queue.", "success")
    return make_response(redirect(url_for("runs.index", configuration=runs[0].configuration_id), 303))


def _preview(filled: RunForm) -> str | None:
    if filled.submission is None or filled.dataset is None:
        return None
    priority = filled.submission.priority
    waiting = hive().store.read(lambda t: t.queue.ahead_of(priority))
    what = preview(filled.submission, filled.dataset, hive().settings, waiting)
    try:
        note = hive().configurations.map_note(filled.submission)
    except SlamHiveError as error:
        filled.errors["map"] = str(error)
        return None
    return what if note is None else f"{what} Note: {note}."


def _page(filled: RunForm) -> str:
    catalogue = hive().catalogue
    return render_template(
        "runs/new.html",
        form=filled,
        algorithms=catalogue.algorithms(),
        choices=dataset_choices(filled.algorithm, catalogue.datasets()),
        preview=_preview(filled),
        content_options=CONTENT_OPTIONS,
        options=RUN_OPTIONS,
        labels={
            "executor": {name: name for name in EXECUTORS.names()},
            "alignment": ALIGNMENT_LABELS,
            "visibility": VISIBILITY_LABELS,
        },
        step_kinds=step_kinds(),
    )
