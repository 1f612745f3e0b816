"""The fields of the experiment builder: read from YAML and written as YAML. The YAML is what counts."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from werkzeug.datastructures import MultiDict

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.documents.limits import RULES, Limits, options_of
from slamhive.domain.protocol import Alignment, TrajectoryKind
from slamhive.experiments.file import LIMIT_WORDS
from slamhive.experiments.values import as_scalar, parse_values
from slamhive.web.formatting import value_text

KeyPath = tuple[str | int, ...]

SOURCE = "experiment.yaml"
"""Name of the text in messages."""

MOST_STEPS = 50

_WORDS = ("name", "description", "executor")
"""Fields with plain text."""

_VALUES = ("seeds", "repeats", "repeat_disturbed", "same_cpu", "priority")
_SECTIONS = {
    "playback": ("mode", "rate"),
    "stop_when": RULES,
    "limits": tuple(option.name for option in options_of(Limits)),
    "optimise": (
        "budget",
        "metric",
        "against",
        "limits",
        "within",
        "confidence",
        "worst",
        "first_look",
        "keep",
        "sampler",
    ),
    "decide": ("budget", "difference", "metric", "error", "worst"),
}
EVALUATE_CHOICES: Mapping[str, type[StrEnum]] = {"alignment": Alignment, "trajectory": TrajectoryKind}
"""What the section ``evaluate`` may say, with the values of each entry."""
_LIMIT_NAMES = {word: name for name, word in LIMIT_WORDS.items()}
_SETS = ("linked", "tied")
_PARAMETERS = "parameters/"
_STEP = re.compile(r"steps/(\d{1,3})/([\w.-]{1,64})")
_STEP_OWN = ("name", "step", "sensors")
_NAME_LINE = re.compile(r"name:(?:[ \t].*)?")
_LINE = re.compile(rf"{re.escape(SOURCE)} line (\d+)")


@dataclass(frozen=True, slots=True)
class StepFields:
    """One pre-processing step as typed."""

    name: str
    kind: str
    sensors: str
    options: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_form(cls, texts: Mapping[str, str]) -> StepFields:
        """Read the fields of one step of the web form."""
        name, kind, sensors = (texts.get(key, "") for key in _STEP_OWN)
        return cls(name, kind, sensors, {key: text for key, text in texts.items() if key not in _STEP_OWN})

    @classmethod
    def from_yaml(cls, name: str, content: Mapping[str, Any]) -> StepFields:
        """Read one step of an experiment in YAML."""
        options = {key: _text(value) for key, value in content.items() if key not in _STEP_OWN}
        return cls(name, _text(content.get("step", "")), ", ".join(_words(content.get("sensors"))), options)

    @property
    def content(self) -> dict[str, Any]:
        """The step as YAML has it, without empty options."""
        options = {key: _value(text) for key, text in self.options.items() if text.strip()}
        sensors = [word.strip() for word in re.split(r"[,|]", self.sensors) if word.strip()]
        return {"step": self.kind.strip(), "sensors": _one_or_list(sensors), **options}


@dataclass(frozen=True, slots=True)
class ExperimentFields:
    """The fields of the builder: text by name, where a name is the path of the YAML key (``limits/memory_mb``)."""

    values: Mapping[str, str] = field(default_factory=dict)
    algorithms: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    steps: tuple[StepFields, ...] = ()

    def value(self, name: str) -> str:
        """The text of a field, or an empty string."""
        return self.values.get(name, "")

    @property
    def has_limits(self) -> bool:
        """True if any limit or stop rule is set."""
        return any(text for name, text in self.values.items() if name.startswith(("limits/", "stop_when/")))

    def with_value(self, name: str, text: str) -> ExperimentFields:
        """Set the text of a field."""
        return replace(self, values={**self.values, name: text})

    def has_section(self, section: str) -> bool:
        """True if any field of a section is filled in."""
        return any(text for name, text in self.values.items() if name.startswith(f"{section}/"))

    def with_step(self, step: StepFields) -> ExperimentFields:
        """Append a step under an unused name."""
        taken = {entry.name for entry in self.steps}
        names = [step.name, *(f"{step.name}_{number}" for number in range(2, len(taken) + 3))]
        free = next(name for name in names if name not in taken)
        return replace(self, steps=(*self.steps, replace(step, name=free)))

    def without_step(self, index: int) -> ExperimentFields:
        """Without the step at ``index``."""
        return replace(self, steps=self.steps[:index] + self.steps[index + 1 :])

    def with_step_earlier(self, index: int) -> ExperimentFields:
        """Swap the step at ``index`` with the one before it."""
        if not 0 < index < len(self.steps):
            return self
        before, step = self.steps[index - 1 : index + 1]
        return replace(self, steps=(*self.steps[: index - 1], step, before, *self.steps[index + 1 :]))


def fields_from_form(form: MultiDict[str, str]) -> ExperimentFields:
    """Read the fields of the web form."""
    steps: dict[int, dict[str, str]] = {}
    values: dict[str, str] = {}
    for name, text in form.items():
        if match := _STEP.fullmatch(name):
            if int(match[1]) < MOST_STEPS:
                steps.setdefault(int(match[1]), {})[match[2]] = text
        elif name in _NAMES or name.startswith(_PARAMETERS):
            values[name] = text
    return ExperimentFields(
        values,
        tuple(dict.fromkeys(form.getlist("algorithms"))),
        tuple(dict.fromkeys(form.getlist("datasets"))),
        tuple(StepFields.from_form(steps[number]) for number in sorted(steps)),
    )


def fields_from_yaml(text: str) -> ExperimentFields:
    """The fields of an experiment in YAML; raises InvalidInput if ``text`` is not a YAML mapping.

    Entries of an unexpected type are skipped here: the check of the experiment reports them.
    """
    content = strict_yaml.parse(text, SOURCE)
    values = {name: _text(content[name]) for name in (*_WORDS, *_VALUES) if name in content}
    for section, keys in _SECTIONS.items():
        found = _mapping(content.get(section))
        if section == "limits":
            found = {_LIMIT_NAMES.get(key, key): value for key, value in found.items()}
        values |= {f"{section}/{key}": _text(found[key]) for key in keys if key in found}
    values |= {name: "\n".join(_texts(content[name])) for name in ("where",) if name in content}
    for name in _SETS:
        entries = content.get(name)
        if isinstance(entries, list):
            values[name] = "\n".join(", ".join(_texts(entry)) for entry in entries)
    values["sensors"] = "\n".join(f"{role}={_text(name)}" for role, name in _mapping(content.get("sensors")).items())
    evaluate = content.get("evaluate")
    if isinstance(evaluate, dict):
        values |= {f"evaluate/{name}": _text(evaluate.get(name, "")) for name in EVALUATE_CHOICES}
    elif evaluate is False:
        values["evaluate"] = "no"
    for key, entry in _mapping(content.get("parameters")).items():
        if isinstance(entry, dict):
            values |= {f"{_PARAMETERS}{key}/{own}": _text(value) for own, value in entry.items()}
        else:
            values[f"{_PARAMETERS}{key}"] = _text(entry)
    return ExperimentFields(
        values,
        tuple(_words(content.get("algorithms"))),
        tuple(_words(content.get("datasets"))),
        tuple(StepFields.from_yaml(name, _mapping(step)) for name, step in _mapping(content.get("steps")).items()),
    )


def yaml_from_fields(fields: ExperimentFields) -> str:
    """Write the fields as YAML, without empty ones."""
    content: dict[str, Any] = {name: fields.value(name).strip() for name in _WORDS[:2]}
    content["algorithms"] = _one_or_list(fields.algorithms)
    content["datasets"] = _one_or_list(fields.datasets)
    content["steps"] = {step.name.strip(): step.content for step in fields.steps}

    # Shared parameters first, then those of single algorithms.
    parameters: dict[str, Any] = {}
    for name, text in fields.values.items():
        if not name.startswith(_PARAMETERS) or not text.strip():
            continue
        owner, slash, key = name.removeprefix(_PARAMETERS).partition("/")
        if slash:
            section = parameters.setdefault(owner, {})
            if isinstance(section, dict):
                section[key] = _value(text)
        else:
            parameters[owner] = _value(text)
    content["parameters"] = dict(sorted(parameters.items(), key=lambda entry: isinstance(entry[1], dict)))

    # ``ROLE=SENSOR`` lines; for one without a sensor, the check of the experiment names the sensors that fit.
    chosen = (line.partition("=") for line in _lines(fields.value("sensors")))
    content["sensors"] = {role.strip(): name.strip() or role.strip() for role, _, name in chosen}
    for name in _SETS:
        content[name] = [[word.strip() for word in line.split(",")] for line in _lines(fields.value(name))]
    content["where"] = _one_or_list(_lines(fields.value("where")))
    content |= {name: _value(fields.value(name)) for name in _VALUES[:-1]}
    for section, keys in _SECTIONS.items():
        content[section] = {key: _value(fields.value(f"{section}/{key}")) for key in keys}
    evaluate = {name: fields.value(f"evaluate/{name}").strip() for name in EVALUATE_CHOICES}
    content["evaluate"] = False if fields.value("evaluate") == "no" else evaluate
    content["executor"] = fields.value("executor").strip()
    content["priority"] = _value(fields.value("priority"))
    return strict_yaml.dump(_without_empty(content) or {"name": ""})


def renamed(text: str, name: str) -> str:
    """Rename an experiment. Comments and layout stay if the name has a line of its own."""
    _, lines = strict_yaml.parse_with_lines(text, SOURCE)
    written = text.splitlines()
    place = lines.get(("name",), 0) - 1
    if place >= 0 and _NAME_LINE.fullmatch(written[place]):
        written[place] = f"name: {name}"
        return "\n".join(written) + "\n"
    fields = fields_from_yaml(text)
    return yaml_from_fields(replace(fields, values={**fields.values, "name": name}))


def line_of(message: str) -> int | None:
    """The line number in an error message, or None."""
    match = _LINE.match(message)
    return None if match is None else int(match[1])


def field_at(text: str, line: int, fields: ExperimentFields) -> str | None:
    """The field for a line of the YAML, or None."""
    try:
        _, lines = strict_yaml.parse_with_lines(text, SOURCE)
    except InvalidInput:
        return None
    path = next((path for path in reversed(lines) if lines[path] == line), None)
    if path is None:
        return None
    if path[0] == "steps":
        number = next((number for number, step in enumerate(fields.steps) if path[1:2] == (step.name,)), None)
        return None if number is None else "/".join(["steps", str(number), *map(str, path[2:3] or ("name",))])
    if path[0] in (*_SETS, "sensors", "where", "algorithms", "datasets"):
        return str(path[0])
    if path[0] == "limits":
        path = (path[0], *(_LIMIT_NAMES.get(str(key), key) for key in path[1:]))
    return "/".join(map(str, path[:3]))


def _without_empty(content: Mapping[str, Any]) -> dict[str, Any]:
    kept = {key: _without_empty(value) if isinstance(value, dict) else value for key, value in content.items()}
    return {key: value for key, value in kept.items() if value not in ("", {}, [])}


def _value(text: str) -> object:
    """The value of a field: a list in brackets, a number, a word, or an expression that is expanded later."""
    text = text.strip()
    if text.startswith("["):
        try:
            return strict_yaml.parse(f"value: {text}", SOURCE)["value"]
        except InvalidInput:
            return text
    return as_scalar(text)


def _text(raw: object) -> str:
    """The text for a field. :func:`_value` reads it back as the same values."""
    if not isinstance(raw, list):
        return "" if raw is None else value_text(raw)
    if all(isinstance(item, str | int | float) for item in raw):
        text = " | ".join(map(value_text, raw))
        try:
            if parse_values(text) == parse_values(raw):
                return text
        except InvalidInput:
            pass
    return json.dumps(raw, ensure_ascii=False)


def _words(raw: object) -> list[str]:
    if isinstance(raw, str):
        return [word.strip() for word in raw.split("|") if word.strip()]
    return _texts(raw) if isinstance(raw, list) else []


def _texts(raw: object) -> list[str]:
    return [_text(item) for item in raw] if isinstance(raw, list) else [_text(raw)]


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip()]


def _one_or_list(items: Sequence[str]) -> object:
    return items[0] if len(items) == 1 else list(items)


def _mapping(raw: object) -> dict[str, Any]:
    return {str(key): value for key, value in raw.items()} if isinstance(raw, dict) else {}


_NAMES = frozenset([
    *_WORDS, *_VALUES, *_SETS, "sensors", "where", "evaluate", *(f"evaluate/{name}" for name in EVALUATE_CHOICES),
    *(f"{section}/{key}" for section, keys in _SECTIONS.items() for key in keys),
])  # fmt: skip
