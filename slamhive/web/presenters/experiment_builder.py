"""The choices of the experiment builder (algorithms, datasets, parameters, kinds of steps), and its drafts."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from werkzeug.datastructures import MultiDict

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.documents.api import LONGEST_YAML
from slamhive.documents.catalogue import StepOptionDocument
from slamhive.documents.experiment import ExperimentPreviewDocument
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Parameter
from slamhive.domain.question import MOST_RUNS
from slamhive.domain.sensors import SensorKind, SensorSetup
from slamhive.recordings.variants.steps import STEPS, describe_options, describe_step, treated_kinds
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.web.experiment_fields import (
    EVALUATE_CHOICES,
    SOURCE,
    ExperimentFields,
    StepFields,
    field_at,
    fields_from_form,
    fields_from_yaml,
    line_of,
    renamed,
    yaml_from_fields,
)
from slamhive.web.formatting import value_text
from slamhive.web.presenters.catalogue import StepKind, lacking, step_groups, step_kinds
from slamhive.web.request_input import form_text, uploaded_text

_AXIS_PREFIX = {SensorKind.CAMERA: "image", SensorKind.DEPTH: "image", SensorKind.LIDAR: "lidar", SensorKind.IMU: "imu"}


@dataclass(frozen=True, slots=True)
class ValueChoice:
    """A checkbox with a note or a warning."""

    name: str
    title: str
    chosen: bool
    note: str = ""
    warning: str = ""


@dataclass(frozen=True, slots=True)
class ParameterField:
    """One parameter; ``name`` is its field, ``owners`` the algorithms that have it."""

    name: str
    label: str
    unit: str
    default: str
    hint: str
    help: str
    owners: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StepRow:
    """One step with every option of its kind, and options that the kind does not have."""

    fields: StepFields
    summary: str
    options: tuple[StepOptionDocument, ...]
    strange: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Builder:
    """The content of the builder.

    ``own``: parameters by algorithm. ``strange``: parameters that no selected algorithm has.
    """

    fields: ExperimentFields
    algorithms: Mapping[str, list[ValueChoice]]
    datasets: list[ValueChoice]
    shared: list[ParameterField]
    own: Mapping[str, list[ParameterField]]
    strange: list[str]
    steps: list[StepRow]
    kinds: Mapping[str, list[StepKind]]

    def typed(self, entries: Iterable[ParameterField]) -> bool:
        """True if any of these parameters has a value."""
        return any(self.fields.value(entry.name) for entry in entries)


def builder(fields: ExperimentFields, algorithms: Sequence[Algorithm], datasets: Sequence[Dataset]) -> Builder:
    """The builder for these fields, algorithms and datasets."""
    chosen = [algorithm for algorithm in algorithms if algorithm.name in fields.algorithms]
    shared = shared_parameters(chosen)
    own = {algorithm.name: own_parameters(algorithm) for algorithm in chosen}
    if len(chosen) == 1 and not any(name.startswith(f"parameters/{chosen[0].name}/") for name in fields.values):
        own = {}
    known = {entry.name for entries in (shared, *own.values()) for entry in entries}
    steps = []
    for step in fields.steps:
        options: tuple[StepOptionDocument, ...] = ()
        try:
            options, words = describe_options(step.kind), describe_step(step.kind)
        except NotFound as error:
            words = str(error)
        names = {option.name for option in options}
        steps.append(StepRow(step, words, options, tuple(name for name in step.options if name not in names)))

    groups: dict[str, list[ValueChoice]] = {}
    by_setup = sorted(algorithms, key=lambda algorithm: list(SensorSetup).index(algorithm.setup))
    for algorithm in by_setup:
        choice = ValueChoice(algorithm.name, algorithm.title, algorithm.name in fields.algorithms)
        groups.setdefault(algorithm.setup.value, []).append(choice)
    installed = {algorithm.name for algorithm in by_setup}
    unknown = [ValueChoice(name, "", True, warning="not installed") for name in fields.algorithms]
    if missing := [choice for choice in unknown if choice.name not in installed]:
        groups["unknown"] = missing

    choices = []
    for dataset in datasets:
        unfit = [algorithm.name for algorithm in chosen if lacking(algorithm, dataset) is not None]
        warning = f"missing sensors for {', '.join(unfit)}" if unfit else ""
        kinds = ", ".join(dict.fromkeys(sensor.kind.value for sensor in dataset.sensors))
        note = f"{dataset.duration_s:.0f} s; {kinds or 'no sensors'}"
        choices.append(ValueChoice(dataset.name, "", dataset.name in fields.datasets, note, warning))
    here = {choice.name for choice in choices}
    choices += [
        ValueChoice(name, "", chosen=True, warning="not here, see the preview")
        for name in fields.datasets
        if name not in here
    ]
    return Builder(
        fields=fields,
        algorithms=groups,
        datasets=choices,
        shared=shared,
        own=own,
        strange=[name for name in fields.values if name.startswith("parameters/") and name not in known],
        steps=steps,
        kinds=step_groups(step_kinds()),
    )


def shared_parameters(algorithms: Iterable[Algorithm]) -> list[ParameterField]:
    """Each parameter once, under its general name if it has one, with all algorithms that have it."""
    found: dict[str, list[tuple[str, Parameter]]] = {}
    for algorithm in algorithms:
        for parameter in algorithm.parameters:
            found.setdefault(parameter.general or parameter.key, []).append((algorithm.name, parameter))
    return [_field(f"parameters/{label}", label, entries) for label, entries in found.items()]


def own_parameters(algorithm: Algorithm) -> list[ParameterField]:
    """The parameters of one algorithm, for values that apply to it alone."""
    return [
        _field(f"parameters/{algorithm.name}/{parameter.key}", parameter.key, [(algorithm.name, parameter)])
        for parameter in algorithm.parameters
    ]


def new_step(kind: str) -> StepFields:
    """A new step of ``kind`` with its usual sensors and empty options; raises NotFound for an unknown kind."""
    kinds = treated_kinds(kind)
    sensor = kinds[0]
    everything = len(kinds) == len(SensorKind)
    shared = kind in ("rate", "resolution")
    sensors = "image" if {SensorKind.CAMERA, SensorKind.DEPTH} == set(kinds) else sensor.value
    options = {option.name: "" for option in describe_options(kind)}
    return StepFields(
        f"{_AXIS_PREFIX[sensor]}_{kind}" if shared else kind, kind, "camera" if everything else sensors, options
    )


def _default(parameter: Parameter) -> str:
    if parameter.source is not None:
        return f"from {parameter.source}"
    return value_text(parameter.default) or "empty"


def _field(name: str, label: str, entries: Sequence[tuple[str, Parameter]]) -> ParameterField:
    """The common properties of the definitions; says where they differ."""
    definitions = [parameter for _, parameter in entries]
    return ParameterField(
        name=name,
        label=label,
        unit=_agreed([parameter.unit for parameter in definitions], "units differ"),
        default=_agreed([_default(parameter) for parameter in definitions], "differs"),
        hint=_agreed([parameter.expectation for parameter in definitions], "ranges differ"),
        help=definitions[0].help,
        owners=tuple(owner for owner, _ in entries),
    )


def _agreed(texts: Sequence[str], otherwise: str) -> str:
    return texts[0] if len(set(texts)) == 1 else otherwise


# -- an experiment being edited: its YAML, the fields, and the preview or the error ------------------------------------

MOST_TEXT = LONGEST_YAML
"""Characters in the YAML of an experiment."""


@dataclass(frozen=True, slots=True)
class ExperimentDraft:
    """The content of the page. ``text`` is what starts; ``fields`` is None if the text cannot be shown in fields.

    A draft has either a ``preview`` or an ``error``. ``line``, ``excerpt`` and ``field`` locate the error, if known.
    An empty draft has neither.
    """

    text: str
    fields: ExperimentFields | None
    preview: ExperimentPreviewDocument | None = None
    error: str = ""
    line: int | None = None
    excerpt: str = ""
    field: str | None = None


_RUNS_OF_EACH = 20


def empty_draft() -> ExperimentDraft:
    """A draft without content."""
    return ExperimentDraft("", ExperimentFields())


def copied(hive: Hive, name: str) -> ExperimentDraft:
    """A copy of the experiment ``name`` under an unused name; raises NotFound."""
    text = hive.experiments.source(name).text
    taken = {status.name for status in hive.experiments.list()}
    stem = name[:56]
    free = next(new for number in itertools.count(2) if (new := f"{stem}-{number}") not in taken)
    return draft_from_text(hive, renamed(text, free))


def deciding(hive: Hive, draft: ExperimentDraft) -> ExperimentDraft:
    """``draft`` as an experiment that runs only until one candidate is the best, with room for 20 runs of each."""
    if draft.fields is None or draft.preview is None:
        return draft
    runs = min(MOST_RUNS, _RUNS_OF_EACH * draft.preview.cells)
    fields = draft.fields.with_value("repeats", "")
    fields = fields.with_value("decide/difference", "5%").with_value("decide/budget", f"{runs} runs")
    return _checked(hive, yaml_from_fields(fields), fields)


def draft_from_form(hive: Hive, form: MultiDict[str, str]) -> ExperimentDraft:
    """The edited draft: ``from`` names the side that was edited, ``do`` the button that was pressed."""
    action = form.get("do", "")
    if form.get("from") == "fields":
        fields = _changed(fields_from_form(form), action, form.get("kind", ""))
        text = yaml_from_fields(fields)
        return _checked(hive, text, fields)
    return draft_from_text(hive, _opened() if action == "open" else form_text("yaml"))


def draft_from_text(hive: Hive, text: str) -> ExperimentDraft:
    """A draft from YAML. Text that is too long is rejected."""
    if len(text) > MOST_TEXT:
        return ExperimentDraft(
            "", None, error=f"the text has more than {MOST_TEXT:,} characters; is this the right file?"
        )
    if not text.strip():
        return empty_draft()
    try:
        text = hive.experiments.context.with_datasets(ExperimentSource(text, SOURCE)).text
        fields = fields_from_yaml(text)
    except InvalidInput as error:
        return with_error(ExperimentDraft(text, None), error)
    return _checked(hive, text, fields)


def with_error(draft: ExperimentDraft, error: SlamHiveError) -> ExperimentDraft:
    """The draft with an error and its location."""
    line = line_of(error.message)
    lines = draft.text.splitlines()
    return ExperimentDraft(
        draft.text,
        draft.fields,
        error=str(error) if line is None else str(error).removeprefix(f"{SOURCE} line {line}: "),
        line=line,
        excerpt=lines[line - 1].strip() if line is not None and line <= len(lines) else "",
        field=None if line is None or draft.fields is None else field_at(draft.text, line, draft.fields),
    )


def _checked(hive: Hive, text: str, fields: ExperimentFields) -> ExperimentDraft:
    draft = ExperimentDraft(text, fields)
    try:
        preview = hive.experiments.preview(ExperimentSource(text, SOURCE))
    except SlamHiveError as error:
        return with_error(draft, error)
    return ExperimentDraft(text, fields, preview)


def _changed(fields: ExperimentFields, action: str, kind: str) -> ExperimentFields:
    """The fields after one of their buttons was pressed."""
    what, _, number = action.partition(":")
    index = int(number) if number.isascii() and number.isdigit() and len(number) < 4 else -1
    if what == "add":
        STEPS.get(kind)
        return fields.with_step(new_step(kind))
    if what == "drop" and 0 <= index < len(fields.steps):
        return fields.without_step(index)
    if what == "evaluate":
        for entry in number.split(";"):
            name, _, value = entry.partition("=")
            if name in EVALUATE_CHOICES and value in set(EVALUATE_CHOICES[name]):
                fields = fields.with_value(f"evaluate/{name}", value)
        return fields
    if what == "earlier":
        return fields.with_step_earlier(index)
    return fields


def _opened() -> str:
    uploaded = uploaded_text("file", 4 * MOST_TEXT)
    if uploaded is None:
        raise InvalidInput("no file is selected", "select one, then press the button again")
    return uploaded[1]
