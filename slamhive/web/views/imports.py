"""Import in the browser: datasets, algorithms and trajectories, looked at before anything is stored."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address
from werkzeug.datastructures import MultiDict

from slamhive.base.errors import InvalidInput, SlamHiveError, unknown
from slamhive.documents.imports import (
    AlgorithmOnServer,
    AlgorithmUpload,
    DatasetOnServer,
    DatasetUpload,
    PackageFacts,
    RecordingFacts,
)
from slamhive.documents.model import dump, json_schema, parse
from slamhive.domain.accounts import Action
from slamhive.domain.sensors import SensorSetup
from slamhive.recordings.importers.registry import IMPORTERS
from slamhive.recordings.importing import read_topics
from slamhive.services.staged_trajectories import StagedFacts, StagedTrajectories
from slamhive.services.uploads import AlgorithmAsked, DatasetAsked
from slamhive.web import access
from slamhive.web.context import caller, hive, import_jobs
from slamhive.web.errors import status_of
from slamhive.web.formatting import plural
from slamhive.web.import_jobs import ImportJob

blueprint = Blueprint("imports", __name__, url_prefix="/import")
server_blueprint = Blueprint("server_imports", __name__, url_prefix="/import/server")
"""Imports for admins alone: of files on the server, and of algorithms, whose build executes what others wrote."""

MOST_SENT_BYTES = 64_000_000
"""Of the trajectories of one web form."""
_WAIT_S = 1.5
"""What is small is looked at in this time, and its page needs no second look."""


@blueprint.get("")
def index() -> str:
    """Show what can be imported, and the web forms for it."""
    hive().check_writable()
    return _page()


# -- datasets and algorithms -------------------------------------------------------------------------------------------


@blueprint.post("/datasets")
def look_at_dataset() -> Response:
    """Detect what is in an uploaded recording."""
    return _look(lambda: read_import(DatasetUpload, request.form))


@server_blueprint.post("/datasets")
def look_at_dataset_here() -> Response:
    """Detect what is in a recording on the server."""
    return _look(lambda: read_import(DatasetOnServer, request.form))


@server_blueprint.post("/algorithms")
def look_at_algorithm() -> Response:
    """Detect what is in an uploaded algorithm."""
    return _look(lambda: read_import(AlgorithmUpload, request.form))


@server_blueprint.post("/algorithms/here")
def look_at_algorithm_here() -> Response:
    """Detect what is in the folder of an algorithm on the server."""
    return _look(lambda: read_import(AlgorithmOnServer, request.form))


def show(token: str) -> str:
    """Show an import: what was detected, how far it is, its log, and what it has made."""
    job = _job(token)
    look_again = "imports.look_at_dataset"
    if isinstance(job.asked, AlgorithmUpload):
        look_again = "server_imports.look_at_algorithm"
    elif isinstance(job.asked, AlgorithmOnServer):
        look_again = "server_imports.look_at_algorithm_here"
    elif isinstance(job.asked, DatasetOnServer):
        look_again = "server_imports.look_at_dataset_here"
    return render_template(
        "imports/job.html",
        job=job,
        area=job.area,
        fields=import_fields(FACTS["algorithm" if job.is_algorithm else "dataset"]),
        values=typed(job.asked),
        again=address(look_again),
        formats=_formats(),
        problem=None if job.problem is None else without_flags(job.problem),
        words=without_flags,
    )


def store(token: str) -> Response:
    """Start the import of what was looked at; the page of one that was started already."""
    job = _job(token)
    if job.done:
        act = access.acting(hive().store, caller(), hive().settings.new_runs) if caller().account else nullcontext()
        import_jobs().store(job, act)
    return _to_job(job)


def cancel(token: str) -> Response:
    """Cancel an import while it is working."""
    job = _job(token)
    job.cancel()
    return _to_job(job)


def discard(token: str) -> Response:
    """Forget an import, and the files that were sent for it."""
    import_jobs().discard(_job(token))
    flash("The import is discarded. Nothing of it is stored.", "info")
    return make_response(redirect(address("imports.index"), 303))


for _part in (blueprint, server_blueprint):
    _part.add_url_rule("/jobs/<token>", view_func=show)
    for _action in (store, cancel, discard):
        _part.add_url_rule(f"/jobs/<token>/{_action.__name__}", view_func=_action, methods=["POST"])


def _look(read: Callable[[], DatasetAsked | AlgorithmAsked]) -> Response:
    """Start looking at what the web form names; its page, or the web form again with what is wrong."""
    hive().check_writable()
    try:
        job = import_jobs().look(read(), caller().account, str(request.blueprint))
    except SlamHiveError as error:
        return make_response(_page(error, str(request.endpoint)), status_of(error))
    hive().store.note_act()
    return _to_job(job)


def _job(token: str) -> ImportJob:
    """The import of the caller on the pages of this request, which the rules of access are about."""
    return import_jobs().get(token, caller().account, str(request.blueprint))


def _to_job(job: ImportJob) -> Response:
    if job.thread is not None:
        job.thread.join(_WAIT_S)
    return make_response(redirect(address(f"{job.area}.show", token=job.token), 303))


def _formats() -> dict[str, str]:
    return {name: importer.title for name, importer in IMPORTERS}


# -- trajectories ------------------------------------------------------------------------------------------------------


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
        return make_response(_page(error, "imports.look"), status_of(error))
    return make_response(render_template("imports/found.html", token=token, report=report, facts=facts))


@blueprint.post("/trajectories/<token>/store")
def store_trajectories(token: str) -> Response:
    """Store the trajectories as runs, and evaluate them."""
    report = StagedTrajectories(hive()).store(token, caller().account)
    flash(
        f"{plural(report.imported, 'run')} imported; {'it is' if report.imported == 1 else 'they are'} evaluated next.",
        "success",
    )
    where = f"id in ({', '.join(map(str, report.run_ids))})"
    return make_response(redirect(address("runs.index", where=where), 303))


@blueprint.post("/trajectories/<token>/discard")
def discard_trajectories(token: str) -> Response:
    """Forget the trajectories."""
    StagedTrajectories(hive()).discard(token, caller().account)
    flash("The trajectories are discarded. Nothing is stored.", "info")
    return make_response(redirect(address("imports.index"), 303))


def _page(error: SlamHiveError | None = None, refused: str = "") -> str:
    """The page of all web forms. ``refused`` is the endpoint of the one that was sent; its values stay."""
    is_admin = Action.ADMINISTER in caller().may
    areas = ("imports", "server_imports") if is_admin else ("imports",)
    return render_template(
        "imports/index.html",
        problem=None if error is None else without_flags(str(error)),
        refused=refused,
        values=request.form if error is not None else MultiDict(),
        is_admin=is_admin,
        jobs=import_jobs().listed(caller().account, areas),
        facts={name: import_fields(model) for name, model in FACTS.items()},
        formats=_formats(),
        on_server={
            name: [entry for entry in import_fields(model) if entry not in import_fields(FACTS[name])]
            for name, model in (("dataset", DatasetOnServer), ("algorithm", AlgorithmOnServer))
        },
        most_bytes=hive().settings.uploads_max_bytes,
        datasets=hive().catalogue.datasets(),
        setups=list(SensorSetup),
    )


# -- the web forms of imports: their fields, from the one definition of the requests, and what was typed into them -----


_FLAG = re.compile(r"--([a-z][a-z-]*)(?: (?:NAME|FILE)(?:\.tar)?)?")
_OTHER_NAMES = {
    "topic": "topics",
    "depth_units": "depth_units_per_m",
    "frame_rate": "frame_rate_hz",
    "uncertainty": "uncertainty_m",
}
"""Options of the command line whose field has another name."""
TABLE = "table"
LINES = "lines"

Asked = TypeVar("Asked", DatasetUpload, DatasetOnServer, AlgorithmUpload, AlgorithmOnServer)


@dataclass(frozen=True, slots=True)
class ImportField:
    """One field of a web form.

    ``kind`` is ``text``, ``number``, ``switch``, ``lines`` (one entry a line) or ``table`` (SENSOR=TOPIC, one a line).
    """

    name: str
    label: str
    help: str
    kind: str
    choices: tuple[str, ...] = ()


@cache
def import_fields(model: Any) -> tuple[ImportField, ...]:
    """The fields of a request, or of the facts that several requests share."""
    schema = json.loads(json_schema(model))
    kinds = {
        "number": "number", "boolean": "switch", "array": LINES, "object": TABLE,
    }  # fmt: skip
    fields = []
    for name, entry in schema["properties"].items():
        value = next(part for part in entry.get("anyOf", [entry]) if part.get("type") != "null")
        choices = schema.get("$defs", {}).get(value.get("$ref", "").rpartition("/")[2], {}).get("enum", ())
        unit = f" [{entry['unit']}]" if entry.get("unit") else ""
        words = entry.get("description", "").replace("null:", "empty:").replace("`", "")
        kind = kinds.get(value.get("type", "string"), "text")
        fields.append(ImportField(name, entry.get("title", name) + unit, words, kind, tuple(choices)))
    return tuple(fields)


def read_import(model: type[Asked], form: MultiDict[str, str]) -> Asked:
    """The request that a web form makes; an empty field has its default. Raises InvalidInput naming the field."""
    content: dict[str, Any] = {}
    for field in import_fields(model):
        lines = [line.strip() for text in form.getlist(field.name) for line in text.splitlines() if line.strip()]
        if not lines:
            continue
        if field.kind == LINES:
            content[field.name] = lines
        elif field.kind == TABLE:
            content[field.name] = read_topics(lines)
        elif field.kind == "switch":
            content[field.name] = True
        elif field.kind == "number":
            content[field.name] = _number(field, lines[0])
        else:
            content[field.name] = lines[0]
    for name in json.loads(json_schema(model)).get("required", ()):
        if name not in content:
            raise InvalidInput("nothing is chosen to import", "choose a file, or type the path of one")
    return parse(model, content)


def typed(request: Any) -> dict[str, str]:
    """The content of the web form for the request, by name of the field."""
    model: Any = type(request)
    content = dump(model, request)
    found = {}
    for field in import_fields(model):
        value = content[field.name]
        if field.kind == TABLE:
            found[field.name] = "\n".join(f"{key}={entry}" for key, entry in value.items())
        elif field.kind == LINES:
            found[field.name] = "\n".join(value)
        elif field.kind == "switch":
            found[field.name] = "yes" if value else ""
        else:
            found[field.name] = "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return found


def without_flags(text: str) -> str:
    """A message in which options of the command line are called as the fields of the web form are."""
    labels = {
        field.name: field.label
        for model in (DatasetOnServer, AlgorithmOnServer)
        for field in import_fields(model)
        if field.name != "name"
    }

    def label(found: re.Match[str]) -> str:
        name = found[1].replace("-", "_")
        name = _OTHER_NAMES.get(name, name)
        return "name" if name == "name" else f"“{labels[name]}”" if name in labels else found[0]

    return _FLAG.sub(label, text)


def _number(field: ImportField, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"{field.label}: {text[:40]!r} is not a number", "write for instance 5000") from None


FACTS: Mapping[str, Any] = {"dataset": RecordingFacts, "algorithm": PackageFacts}
