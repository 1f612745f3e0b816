"""Configurations: the list, one page each, the web form, YAML import and export, and actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm
from slamhive.services.configurations import ConfigurationChange, Label, Stored
from slamhive.store import ConfigurationRecord
from slamhive.web.context import hive
from slamhive.web.errors import status_of
from slamhive.web.presenters import configurations as presenter
from slamhive.web.presenters.catalogue import dataset_choices, match_of_configuration, step_kinds
from slamhive.web.queries import CONFIGURATION_ID, ConfigurationQuery
from slamhive.web.request_input import form_text, uploaded_text
from slamhive.web.views.start import CONTENT_OPTIONS, RunForm, form_values, read_form

blueprint = Blueprint("configurations", __name__, url_prefix="/configurations")
RUNS_SHOWN = 20
MOST_TEXT_BYTES = 200_000
"""Longer YAML would take too long to parse within a request."""
LABELS = ("name", "note", "group")


@blueprint.get("")
def index() -> str:
    """List the configurations that match the query in the address."""
    services = hive()
    query = ConfigurationQuery.from_args(request.args)
    page = services.configurations.page(query.filter, query.after, query.limit)
    return render_template(
        "configurations/index.html",
        query=query,
        page=page,
        rows=presenter.rows(page.records, _algorithms()),
        summary=query.summary(len(page.records), page.total),
        algorithm_names=[entry.name for entry in services.catalogue.algorithms()],
        dataset_names=[entry.name for entry in services.catalogue.datasets()],
        groups=services.configurations.groups(),
    )


@blueprint.get(f"/{CONFIGURATION_ID}")
def show(configuration_id: int) -> str:
    """Show one configuration with its description and latest runs."""
    service = hive().configurations
    record = service.get(configuration_id)
    algorithm = _algorithms().get(record.configuration.algorithm)
    match = match_of_configuration(hive(), configuration_id)
    filled_in: dict[str, Any] = {name: text for name, text in _values_of(record).items() if text}
    return render_template(
        "configurations/show.html",
        record=record,
        held_by=presenter.held_by(record),
        parameters=presenter.parameter_rows(record, algorithm, match),
        match=match,
        outdated=presenter.outdated(record, algorithm),
        runs=presenter.run_rows(service.latest_runs(configuration_id, RUNS_SHOWN), _algorithms().values()),
        columns=presenter.run_columns(),
        start=address("start.form", **filled_in),
        groups=[name for name in service.groups() if name not in record.groups],
    )


@blueprint.get("/new")
def new() -> str:
    """The web form for a new configuration; ``copy=12`` fills it from configuration 12."""
    values = request.args.to_dict()
    reference = values.pop("copy", "")
    if reference:
        values = {**_values_of(hive().configurations.find(reference)), **values}
    return _form(_read(values, only_given=True), None)


@blueprint.post("/new")
def create() -> Response | tuple[str, int]:
    """Save the configuration, or show the web form again with its errors."""
    form = _read(request.form.to_dict())
    return _stored_or_form(form, None, hive().configurations.create)


@blueprint.get("/new/preview")
def check() -> Response:
    """JSON for the open page: does this configuration exist already, and which fields are invalid?"""
    form = _read(request.args.to_dict())
    return make_response(jsonify(preview=_preview(form), errors=form.errors, bound=form.bound, used=form.used))


@blueprint.get(f"/{CONFIGURATION_ID}/edit")
def edit(configuration_id: int) -> str:
    """The web form filled from a configuration that is to be edited."""
    record = hive().configurations.get(configuration_id)
    said = {"name": record.name or "", "note": record.note}
    return _form(_read({**_values_of(record), **said, **request.args.to_dict()}, only_given=True), record)


@blueprint.post(f"/{CONFIGURATION_ID}/edit")
def modify(configuration_id: int) -> Response | tuple[str, int]:
    """Replace a configuration, or save a new one if runs depend on the old one."""
    record = hive().configurations.get(configuration_id)

    form = _read(request.form.to_dict())

    def store(submission: Submission, label: Label) -> Stored:
        changes = ConfigurationChange(
            algorithm=submission.algorithm,
            dataset=submission.dataset,
            parameters={**form.cleared, **submission.parameters},
            variant=submission.variant,
            sensors=submission.sensors,
            playback_mode=submission.playback_mode,
            playback_rate=submission.playback_rate,
            map=submission.map,
        )
        said = Label(_changed("name", record.name or ""), _changed("note", record.note), label.group)
        return hive().configurations.modify(configuration_id, changes, said)

    return _stored_or_form(form, record, store)


@blueprint.post(f"/{CONFIGURATION_ID}/describe")
def describe(configuration_id: int) -> Response:
    """Set the name and the note."""
    record = hive().configurations.describe(
        configuration_id, Label(request.form.get("name", ""), request.form.get("note", ""))
    )
    flash(f"{record.label.capitalize()} is updated.", "success")
    return _to(configuration_id)


@blueprint.post(f"/{CONFIGURATION_ID}/group")
def group(configuration_id: int) -> Response:
    """Add the configuration to a group, or remove it."""
    name, remove = request.form.get("group", ""), bool(request.form.get("remove"))
    hive().configurations.group(name, [configuration_id], remove=remove)
    flash(f"{'Removed from' if remove else 'Added to'} group {name.strip()}.", "success")
    return _to(configuration_id)


@blueprint.post(f"/{CONFIGURATION_ID}/delete")
def delete(configuration_id: int) -> Response:
    """Delete a configuration that nothing depends on."""
    service = hive().configurations
    record = service.get(configuration_id)
    service.delete([configuration_id])
    flash(f"{record.label.capitalize()} is deleted.", "success")
    return make_response(redirect(address("configurations.index"), 303))


@blueprint.get(f"/{CONFIGURATION_ID}/configuration.yaml")
def export(configuration_id: int) -> Response:
    """The configuration as YAML that the import accepts."""
    response = Response(hive().configurations.export_yaml(configuration_id), mimetype="application/yaml")
    response.headers["Content-Disposition"] = f'attachment; filename="configuration-{configuration_id}.yaml"'
    return response


@blueprint.get("/import")
def import_form() -> str:
    """The page to paste YAML or to select a file."""
    return render_template("configurations/import.html", text="", problem=None)


@blueprint.post("/import")
def import_() -> Response | tuple[str, int]:
    """Save the configuration in the YAML, or show the page again with the error."""
    text = form_text("text")
    try:
        source, text = uploaded_text("file", MOST_TEXT_BYTES) or ("the text", text)
        if not text.strip():
            raise InvalidInput("there is no YAML to import", "paste it or select a file")
        stored = hive().configurations.import_yaml(text, source)
    except SlamHiveError as error:
        return render_template("configurations/import.html", text=text, problem=str(error)), status_of(error)
    return _tell(stored)


def _stored_or_form(
    form: RunForm, record: ConfigurationRecord | None, store: presenter.Store
) -> Response | tuple[str, int]:
    if form.submission is None:
        return _form(form, record), 400
    label = Label(*((request.form.get(name, "").strip() or None) for name in LABELS))
    try:
        return _tell(store(form.submission, label))
    except SlamHiveError as error:
        form.fail(error)
        return _form(form, record), status_of(error)


def _tell(stored: Stored) -> Response:
    flash(f"{stored.words[:1].upper()}{stored.words[1:]}.", "success" if stored.created else "info")
    for note in stored.notes:
        flash(f"{note[:1].upper()}{note[1:]}.", "warning")
    return _to(stored.record.id)


def _read(values: Mapping[str, str], *, only_given: bool = False) -> RunForm:
    """Read the web form; ``only_given`` reports errors only for fields with a value."""
    form = read_form(hive(), values, content_only=True)
    if only_given:
        form.errors = {name: text for name, text in form.errors.items() if values.get(name)}
    return form


def _form(form: RunForm, record: ConfigurationRecord | None) -> str:
    catalogue = hive().catalogue
    return render_template(
        "configurations/form.html",
        form=form,
        record=record,
        held_by=None if record is None else presenter.held_by(record),
        algorithms=catalogue.algorithms(),
        choices=dataset_choices(form.algorithm, catalogue.datasets()),
        content_options=CONTENT_OPTIONS,
        step_kinds=step_kinds(),
        preview=_preview(form),
        groups=hive().configurations.groups(),
    )


def _preview(form: RunForm) -> str | None:
    if form.submission is None:
        return None
    try:
        same = hive().configurations.same_as(form.submission)
    except SlamHiveError as error:
        return str(error)
    return "This configuration does not exist yet." if same is None else f"Identical to {same.label}."


def _values_of(record: ConfigurationRecord) -> dict[str, str]:
    """The values of the web form; only algorithm and dataset if the configuration is outdated."""
    try:
        return form_values(hive().configurations.submission(record.id)[0])
    except SlamHiveError:
        content = record.configuration
        return {"algorithm": content.algorithm, "dataset": content.dataset}


def _algorithms() -> dict[str, Algorithm]:
    return {entry.name: entry for entry in hive().catalogue.algorithms()}


def _changed(name: str, before: str) -> str | None:
    """The submitted text, or None if it is unchanged."""
    text = request.form.get(name, before)
    return None if text.replace("\r\n", "\n").strip() == before else text


def _to(configuration_id: int) -> Response:
    return make_response(redirect(address("configurations.show", configuration_id=configuration_id), 303))
