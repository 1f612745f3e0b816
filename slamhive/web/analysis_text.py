"""Analysis files that pages write: a first one for a search, the constraint selector; and what each form takes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic_core import PydanticUndefined

from slamhive import strict_yaml
from slamhive.domain.sensors import SensorSetup
from slamhive.errors import InvalidInput
from slamhive.search.reader import quoted

FIRST = """name: A first look
text: |
  What you want to say, in Markdown.
select:
  runs: {where: %s}
forms:
  - form: by_algorithm
    metric: ate.rmse
  - form: distributions
    metrics: [ate.rmse]
"""
ALL = "id >= 1"
"""A filter that finds every run."""
BOUNDS = {
    "max_cores": ("cpu.mean", "<=", 1.0),
    "max_memory_mb": ("ram.max", "<=", 1e6),
    "min_tracked": ("tracked_fraction", ">=", 1.0),
    "max_ate_m": ("ate.rmse", "<=", 1.0),
}
"""Fields of the selector: metric, sign, and what one of the field's unit is in the metric's."""


@dataclass(frozen=True, slots=True)
class OptionHelp:
    """One option of a form as the page shows it."""

    name: str
    kind: str
    default: str
    help: str


@dataclass(frozen=True, slots=True)
class FormHelp:
    """One form as the page shows it; ``example`` is the least that a file must say."""

    key: str
    title: str
    description: str
    options: tuple[OptionHelp, ...]
    example: str


def first_text(where: str) -> str:
    """An analysis of the runs that a filter finds; an empty one finds all."""
    return FIRST % json.dumps(where.strip() or ALL, ensure_ascii=False)  # text of JSON is quoted text of YAML


def form_helps() -> list[FormHelp]:
    """Every form with its options, out of their models."""
    from slamhive.analysis.forms import FORMS  # noqa: PLC0415 - pandas and scipy take two seconds to load

    return [_form_help(form) for _, form in FORMS]


def _form_help(form: Any) -> FormHelp:
    schema = form.options.model_json_schema()
    options = []
    example: dict[str, Any] = {"form": form.key}
    for name, field in form.options.model_fields.items():
        described = schema["properties"][name]
        default = field.default if field.default is not PydanticUndefined else None
        if field.default_factory is not None:
            default = field.default_factory()
        if field.is_required():
            metrics = ["ate.rmse", "rpe.rmse"] if described.get("type") == "array" else "ate.rmse"
            example[name] = described.get("examples", [metrics])[0]
        shown = "" if default in (None, "") else str(default)
        options.append(
            OptionHelp(name, _kind(described), "needed" if field.is_required() else shown, field.description or "")
        )
    return FormHelp(form.key, form.title, form.description, tuple(options), strict_yaml.dump({"forms": [example]}))


def _kind(described: Mapping[str, Any]) -> str:
    if "enum" in described:
        return " or ".join(map(str, described["enum"]))
    if described.get("type") == "array":
        return f"list of {_kind(described['items'])}"
    if "anyOf" in described:
        return _kind(described["anyOf"][0])
    return {"string": "text", "integer": "whole number"}.get(str(described.get("type")), str(described.get("type")))


def selector_text(fields: Mapping[str, str], sensors: list[str], datasets: list[str]) -> str:
    """The analysis that asks for configurations within bounds; raises InvalidInput naming the field.

    Args:
        fields: Of :data:`BOUNDS`, as typed; empty ones do not bind.
        sensors: Set-ups to choose from, all if empty.
        datasets: Datasets that count, all if empty.
    """
    bounds = []
    for name, (metric, sign, factor) in BOUNDS.items():
        text = fields.get(name, "").strip()
        if text:
            bounds.append(f"{metric} {sign} {_number(name, text) * factor:g}")
    if not bounds:
        raise InvalidInput("no bound is given", "fill at least one of the fields")
    for name in sensors:
        if name not in list(SensorSetup):
            raise InvalidInput(f"sensors {name[:40]!r} are not known", f"choose of {', '.join(SensorSetup)}")
    conditions = []
    if sensors:
        conditions.append(f"sensor in ({', '.join(sensors)})")
    if datasets:
        conditions.append(f"dataset in ({', '.join(quoted(name[:100]) for name in datasets)})")
    content = {
        "name": "Configurations within bounds",
        "select": {"candidates": {"where": " and ".join(conditions) or ALL}},
        "forms": [{"form": "selector", "bounds": bounds}],
    }
    return strict_yaml.dump(content)


def _number(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < 1e12:
        raise InvalidInput(f"{name.replace('_', ' ')} {text[:40]!r} is not a number from 0", "write for example 1.5")
    return number
