"""The experiment builder: fields and YAML side by side, a preview, and the start."""

from __future__ import annotations

from typing import Any

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.domain.protocol import ALIGNMENT_LABELS
from slamhive.domain.visibility import Visibility
from slamhive.errors import SlamHiveError
from slamhive.executors.registry import EXECUTORS
from slamhive.services.experiments import ExperimentSource
from slamhive.web.context import hive
from slamhive.web.errors import status_of, wants_json
from slamhive.web.experiment_draft import MOST_TEXT, Draft, copied, draft_from_form, empty_draft, with_error
from slamhive.web.experiment_fields import SOURCE
from slamhive.web.formatting import plural
from slamhive.web.presenters.experiment_builder import Builder, builder

blueprint = Blueprint("experiment_builder", __name__, url_prefix="/new-experiment")
"""Not below ``/experiments``, where any name may be an experiment."""


@blueprint.get("")
def new() -> str:
    """Show an empty builder, or one with a copy of the experiment ``copy``."""
    services = hive()
    services.check_writable()
    source = request.args.get("copy")
    return _builder_page(empty_draft() if source is None else copied(services, source))


@blueprint.post("")
def draft() -> Response | tuple[str, int]:
    """Return the edited draft as a page, or as JSON for the open one. Only ``do=start`` saves anything."""
    edited = draft_from_form(hive(), request.form)
    if request.form.get("do") == "start" and request.form.get("from") == "text":
        return _start(edited)
    if wants_json():
        return make_response(jsonify(_parts(edited)))
    return _builder_page(edited), 400 if edited.error else 200


def _start(edited: Draft) -> Response | tuple[str, int]:
    if edited.preview is None:
        return _builder_page(edited), 400
    try:
        chosen = request.form.get("visibility")
        seen_by = Visibility.named(chosen) if chosen else None
        started = hive().experiments.start(ExperimentSource(edited.text, SOURCE), visibility=seen_by)
    except SlamHiveError as error:
        return _builder_page(with_error(edited, error)), status_of(error)
    flash(f"Started {started.name} with {plural(started.runs, 'run')}.", "success")
    return make_response(redirect(address("experiments.show", name=started.name), 303))


def _builder_page(edited: Draft) -> str:
    visibility = request.form.get("visibility", "")
    return render_template("experiments/new.html", **_builder_words(edited), visibility=visibility)


def _parts(edited: Draft) -> dict[str, Any]:
    """The parts that the open page replaces."""
    words = _builder_words(edited)
    return {
        "yaml": edited.text,
        "builder": None if edited.fields is None else render_template("experiments/_builder.html", **words),
        "preview": render_template("experiments/_preview.html", **words),
        "line": edited.line,
        "field": edited.field,
        "error": edited.error,
    }


def _builder_words(edited: Draft) -> dict[str, Any]:
    alignments = [("", "default for the sensors"), *((entry.value, label) for entry, label in ALIGNMENT_LABELS.items())]
    return {
        "draft": edited,
        "builder": _builder(edited),
        "alignments": alignments,
        "executors": [("", "from the settings"), *((name, name) for name in EXECUTORS.names())],
        "most_text": MOST_TEXT,
    }


def _builder(edited: Draft) -> Builder | None:
    if edited.fields is None:
        return None
    catalogue = hive().catalogue
    return builder(edited.fields, catalogue.algorithms(), catalogue.datasets())
