"""Cards of plot types beside the text of an analysis: what each can be drawn over, and the entry that it writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

from pydantic_core import PydanticUndefined

from slamhive import strict_yaml
from slamhive.domain.numbers import plural

if TYPE_CHECKING:
    from slamhive.services.reports import OfferedColumns

ERRORS = ("ate.rmse", "rpe.rmse")
"""The metrics that stand for others where the data say nothing."""
_AXES = ("x", "y", "z")
_PARAMETERS = ("parameters", "dimensions")
_GROUP = "by"
_METRICS = ("metric", "metrics", "rank_by")


class Form(Protocol):
    """What is sent by a page."""

    def getlist(self, key: str) -> list[str]:
        """All values under a key."""
        ...


@dataclass(frozen=True, slots=True)
class OptionHelp:
    """One option of a plot type, with its default as it is written in YAML."""

    name: str
    kind: str
    default: str
    help: str


@dataclass(frozen=True, slots=True)
class Choice:
    """A value of a field."""

    value: str
    label: str
    chosen: bool


@dataclass(frozen=True, slots=True)
class CardField:
    """A field of a card, sent as ``KEY.OPTION``."""

    name: str
    option: str
    help: str
    choices: tuple[Choice, ...]
    several: bool


@dataclass(frozen=True, slots=True)
class Card:
    """One plot type. ``lacking`` says why it does not fit the selected runs; empty if it does."""

    key: str
    title: str
    description: str
    options: tuple[OptionHelp, ...]
    fields: tuple[CardField, ...]
    example: str
    lacking: str


def cards(offered: OfferedColumns | None = None) -> list[Card]:
    """All plot types, with choices and examples from the runs; without runs, from the catalogue alone."""
    from slamhive.analysis.plot_types import PLOT_TYPES  # noqa: PLC0415 - pandas and scipy take two seconds to load
    from slamhive.services.reports import OfferedColumns  # noqa: PLC0415 - as above

    return [_card(plot, offered or OfferedColumns()) for _, plot in PLOT_TYPES]


def entry_of(card: Card, form: Form) -> dict[str, Any]:
    """The entry of an analysis file that the fields of a card say; what a field does not say is left to the default."""
    entry: dict[str, Any] = {"form": card.key}
    for field in card.fields:
        values = [value for value in form.getlist(field.name) if value]
        if values:
            entry[field.option] = values if field.several else values[0]
    return _example(card) if entry == {"form": card.key} else entry


def choosing(card: Card, content: Mapping[str, Any]) -> Card:
    """The card with the choices of an entry that somebody has written; what its fields do not offer is offered too."""
    return replace(card, fields=tuple(_choosing(field, content) for field in card.fields))


def _choosing(field: CardField, content: Mapping[str, Any]) -> CardField:
    if field.option not in content:
        return field
    value = content[field.option]
    wanted = [str(entry) for entry in (value if isinstance(value, list) else [value])]
    offered = [(choice.value, choice.label) for choice in field.choices]
    missing = [(key, key) for key in wanted if key not in dict(offered)]
    choices = tuple(Choice(key, label, key in wanted) for key, label in [*offered, *missing])
    return replace(field, choices=choices)


def _example(card: Card) -> dict[str, Any]:
    return dict(strict_yaml.parse(card.example, "example")["forms"][0])


def _card(plot: Any, offered: OfferedColumns) -> Card:
    schema = plot.options.model_json_schema()
    helps, fields = [], []
    example: dict[str, Any] = {"form": plot.key}
    for name, field in plot.options.model_fields.items():
        described = schema["properties"][name]
        default = None if field.default is PydanticUndefined else field.default
        if field.default_factory is not None:
            default = field.default_factory()
        shown = "needed" if field.is_required() else _yaml(default)
        helps.append(OptionHelp(name, kind_of(described), shown, field.description or ""))
        values = _values(plot, name, offered)
        several = described.get("type") == "array"
        if values:
            chosen = _chosen(name, values, default, several=several)
            fields.append(_field(plot.key, name, field.description or "", values, chosen, several=several))
            if field.is_required() or (offered.runs and chosen != default):
                example[name] = chosen
        elif "enum" in described:
            named = [(str(value), str(value)) for value in described["enum"]]
            fields.append(_field(plot.key, name, field.description or "", named, default, several=False))
        if field.is_required() and name not in example:
            example[name] = described.get("examples", [list(ERRORS) if several else ERRORS[0]])[0]
    lacking = _lacking(plot, offered)
    return Card(
        plot.key,
        plot.title,
        plot.description,
        tuple(helps),
        tuple(fields),
        strict_yaml.dump({"forms": [example]}),
        lacking,
    )


def _values(plot: Any, name: str, offered: OfferedColumns) -> list[tuple[str, str]]:
    """What a field can be set to, with labels; empty for an option that names no column."""
    metrics = [(column.key, _label(column.key, column.label, column.unit)) for column in offered.metrics]
    numbers = [(column.key, _label(column.key, column.label, column.unit)) for column in offered.numbers]
    groups = [(column.key, _label(column.key, column.label, column.unit)) for column in offered.groups]
    if name in _METRICS:
        return metrics
    if name == _GROUP:
        return groups
    if name in _PARAMETERS:
        return list(dict.fromkeys([*numbers, *(entry for entry in groups if entry[0] != "dataset")]))
    if name in _AXES:
        over = [*numbers, *(entry for entry in groups if entry[0] != "dataset")] if "y" in _axes(plot) else numbers
        return list(dict.fromkeys([*over, *metrics] if _is_free(plot) else over))
    return []


def _axes(plot: Any) -> list[str]:
    return [name for name in _AXES if name in plot.options.model_fields]


def _is_free(plot: Any) -> bool:
    """Whether its axes may be metrics: where a plot has a metric besides, its axes are parameters."""
    return "metric" not in plot.options.model_fields


def _chosen(name: str, values: Sequence[tuple[str, str]], default: Any, *, several: bool) -> Any:
    """The default as far as the runs have it, else the first that fits; axes differ from each other."""
    keys = [key for key, _ in values]
    if several:
        return [key for key in default or () if key in keys] or ([] if name in _PARAMETERS else keys[:2])
    if default in keys:
        return default
    return keys[min(_AXES.index(name), len(keys) - 1)] if name in _AXES else keys[0]


def _field(
    key: str, name: str, words: str, values: Sequence[tuple[str, str]], chosen: Any, *, several: bool
) -> CardField:
    picked = chosen if several else [chosen]
    choices = tuple(Choice(value, label, value in picked) for value, label in values)
    return CardField(f"{key}.{name}", name, words, choices, several)


def _lacking(plot: Any, offered: OfferedColumns) -> str:
    """Why a plot over parameters does not fit the runs."""
    if not offered.looked_at or _is_free(plot):
        return ""
    wanted = len(_axes(plot))
    there = len(_values(plot, _AXES[0], offered)) if wanted else 0
    if wanted <= there:
        return ""
    kind = "parameter" if wanted > 1 else "numeric parameter"
    return f"It needs {plural(wanted, kind)} with several values. The selected runs have {there or 'none'}."


def _label(key: str, label: str, unit: str) -> str:
    named = key if label in ("", key) else f"{label} ({key})"
    return f"{named} [{unit}]" if unit and unit != "1" else named


def _yaml(value: Any) -> str:
    """A default as it is written in an analysis file; empty for none."""
    if value in (None, "", [], ()):
        return ""
    return strict_yaml.dump({"value": value}).partition(":")[2].strip()


def kind_of(described: Mapping[str, Any]) -> str:
    """The kind of an option in words."""
    if "enum" in described:
        return " or ".join(map(str, described["enum"]))
    if described.get("type") == "array":
        return f"list of {kind_of(described['items'])}"
    if "anyOf" in described:
        return kind_of(described["anyOf"][0])
    return {"string": "text", "integer": "whole number"}.get(str(described.get("type")), str(described.get("type")))
