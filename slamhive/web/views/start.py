"""The web form that starts runs: its pages, and how its fields become a checked :class:`Submission`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from flask import Blueprint, Response, flash, jsonify, make_response, redirect, render_template, request, url_for

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.base.settings import Settings
from slamhive.documents.submission import CONTENT, OPTIONS, Submission, nested
from slamhive.domain.accounts import VISIBILITY_LABELS
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import PlaybackMode, Variant, parse_step, step_text
from slamhive.domain.dataset import Dataset
from slamhive.domain.matching import Match, match_of
from slamhive.domain.parameters import ParameterType, Value
from slamhive.domain.protocol import ALIGNMENT_LABELS
from slamhive.executors.registry import EXECUTORS
from slamhive.services.hive import Hive
from slamhive.web.context import hive
from slamhive.web.errors import status_of
from slamhive.web.formatting import duration, plural, value_text
from slamhive.web.presenters.catalogue import dataset_choices, step_kinds

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


# -- the forms of runs and configurations: text in, a checked :class:`Submission` or one message a field out -----------


PARAMETER_PREFIX = "parameter."
SENSOR_PREFIX = "sensor."
_OWN_FIELDS = ("algorithm", "dataset", "parameters", "variant", "sensors")
"""Fields that need the catalogue; the field ``steps`` contains ``variant``."""
_TYPED = [option for option in OPTIONS.values() if option.name not in _OWN_FIELDS]
CONTENT_OPTIONS = [option for option in _TYPED if option.group == CONTENT]
RUN_OPTIONS = [option for option in _TYPED if option.group != CONTENT]
T = TypeVar("T")


@dataclass(slots=True)
class RunForm:
    """Typed text, and what is wrong with it.

    ``values`` holds the text of each field by name, ``errors`` one message for each field that cannot be used.
    ``submission`` is there if all of them can, ``match`` if algorithm and dataset fit.
    """

    values: dict[str, str]
    algorithm: Algorithm | None = None
    dataset: Dataset | None = None
    errors: dict[str, str] = field(default_factory=dict)
    submission: Submission | None = None
    match: Match | None = None

    def value(self, name: str) -> str:
        """The text to show in a field."""
        if name in self.values or name not in OPTIONS:
            return self.values.get(name, "")
        default = OPTIONS[name].default
        if isinstance(default, bool):
            return "yes" if default else "no"
        return "" if default is None else value_text(default)

    @property
    def used(self) -> dict[str, str]:
        """The sensor in each role, by name of the field."""
        found = {} if self.match is None else self.match.sensors
        return {SENSOR_PREFIX + role: sensor.name for role, sensor in found.items()}

    @property
    def cleared(self) -> dict[str, Value]:
        """An empty value for each parameter that is taken from a sensor, which removes what a user set before."""
        known = () if self.algorithm is None else self.algorithm.parameters
        return {parameter.key: "" for parameter in known if parameter.source is not None}

    @property
    def bound(self) -> dict[str, dict[str, str]]:
        """The value that each parameter taken from a sensor has now, and where it comes from, by name of the field."""
        found = () if self.match is None else self.match.bound
        return {
            PARAMETER_PREFIX + entry.key: {
                "value": "" if entry.found is None else value_text(entry.found),
                "words": entry.words,
            }
            for entry in found
        }

    def has_typed(self, group: str) -> bool:
        """Tell if something is typed into an option of this group."""
        return any(self.values.get(option.name) for option in RUN_OPTIONS if option.group == group)

    def fail(self, error: SlamHiveError) -> None:
        """Show an error that only the services could find, above the fields."""
        self.errors[""] = str(error)


def read_form(services: Hive, values: Mapping[str, str], *, content_only: bool = False) -> RunForm:
    """Check every field; a field that is not there has its default.

    Args:
        services: Algorithms, datasets and steps to choose from.
        values: Field names and typed text; ``evaluate`` is off by being ``no``, ``steps`` has one step a line.
        content_only: For a configuration: without the fields that only say how it is run.
    """
    form, catalogue = RunForm(dict(values)), services.catalogue
    form.algorithm = _checked(form, "algorithm", lambda: _named(catalogue.algorithm, form.value("algorithm")))
    form.dataset = _checked(form, "dataset", lambda: _named(catalogue.dataset, form.value("dataset")))
    algorithm, dataset = form.algorithm, form.dataset

    # The values of the algorithm's parameters; an empty field means the default, or that of a sensor.
    parameters: dict[str, Value] = {}
    for parameter in () if algorithm is None else algorithm.parameters:
        field, taken = PARAMETER_PREFIX + parameter.key, parameter.source is not None
        form.values.setdefault(field, "" if taken else value_text(parameter.default))
        text = form.values[field]
        if not text.strip() and (taken or parameter.type is not ParameterType.STRING):
            continue
        try:
            parameters[parameter.key] = parameter.parse(text)
        except InvalidInput as error:
            form.errors[field] = str(error)

    # The fields that do not depend on the algorithm; None if one of all fields cannot be used.
    found: dict[str, Any] = {}
    for option in CONTENT_OPTIONS if content_only else _TYPED:
        try:
            found[option.name] = option.read(form.value(option.name))
        except InvalidInput as error:
            form.errors[option.name] = str(error)
    run_fields = None if form.errors else found

    if algorithm is None or dataset is None:
        return form
    variant = _checked(form, "steps", lambda: services.variants.resolve(dataset, read_steps(form.value("steps"))))
    seen = services.variants.planned(dataset, variant or ())
    # The sensor that is chosen for each role; an empty field follows the rule.
    names = {entry.role: form.value(SENSOR_PREFIX + entry.role).strip() for entry in algorithm.inputs}
    choices = {role: name for role, name in names.items() if name}
    chosen_field = SENSOR_PREFIX + next(reversed(choices), "")
    chosen = _checked(form, chosen_field, lambda: algorithm.stated_choice(dataset, choices)) or {}
    form.match = _checked(form, "dataset", lambda: match_of(algorithm, seen, parameters, chosen))
    if not form.errors and run_fields is not None:
        submission = Submission(
            algorithm=algorithm.label,
            dataset=dataset.name,
            parameters=parameters,
            variant=variant or (),
            sensors=chosen,
            **nested(run_fields),
        )
        _checked(form, "", submission.check)
        form.submission = submission if not form.errors else None
    return form


def read_steps(text: str) -> Variant:
    """One pre-processing step a line, as on the command line; raises InvalidInput naming the line."""
    return tuple(parse_step(line) for line in text.splitlines() if line.strip())


def form_values(submission: Submission) -> dict[str, str]:
    """The fields of the web form for the content of ``submission``."""
    parameters = {PARAMETER_PREFIX + key: value_text(value) for key, value in submission.parameters.items()}
    return {
        "algorithm": submission.algorithm,
        "dataset": submission.dataset,
        "steps": "\n".join(step_text(step) for step in submission.variant),
        "playback_mode": submission.playback_mode,
        "playback_rate": value_text(submission.playback_rate),
        **{SENSOR_PREFIX + role: name for role, name in submission.sensors.items()},
        "map": submission.map or "",
        **parameters,
    }


def preview(submission: Submission, dataset: Dataset, settings: Settings, waiting: int) -> str:
    """Effect of pressing the button: how many runs, how long, behind how many others."""
    what = f"{plural(submission.repeat, 'run')} of {submission.algorithm} on {dataset.name}"
    # A worker prefers runs on the data that it has just used, so a new run may overtake some.
    behind = f" At most {plural(waiting, 'queued run goes', 'queued runs go')} first." if waiting else ""
    if submission.playback_mode == PlaybackMode.SEQUENTIAL:
        return f"{what}, as fast as the algorithm goes.{behind}"
    once_s = dataset.duration_s / submission.playback_rate
    limit_s = submission.timeout_s
    if limit_s is None:
        limit_s = settings.run_timeout_factor * dataset.duration_s / min(submission.playback_rate, 1.0)
        limit_s += settings.run_timeout_slack_s
    each, whole = "", ""
    if submission.repeat > 1:
        each, whole = "each ", f", {duration(once_s * submission.repeat / settings.worker_slots)} in all"
    return f"{what}, {each}about {duration(once_s)} plus start-up{whole}; time limit {duration(limit_s)}.{behind}"


def _named(find: Callable[[str], T], name: str) -> T:
    if not name:
        raise InvalidInput("nothing is chosen")
    return find(name)


def _checked(form: RunForm, name: str, read: Callable[[], T]) -> T | None:
    try:
        return read()
    except SlamHiveError as error:
        form.errors.setdefault(name, str(error))
        return None
