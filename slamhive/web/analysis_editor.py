"""Cards of plot types beside the text of an analysis: what each can be drawn over, and the entry that it writes."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, Protocol

from pydantic_core import PydanticUndefined

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, NotFound, unknown
from slamhive.domain.names import plural
from slamhive.domain.parameters import Value
from slamhive.domain.sensors import SensorSetup
from slamhive.filters.syntax import quoted

if TYPE_CHECKING:
    from slamhive.services.analysis import OfferedColumns

ERRORS = ("ate.rmse", "rpe.rmse")
"""The metrics that stand for others where the data say nothing."""
_AXES = ("x", "y", "z")
_PARAMETERS = ("parameters", "dimensions")
_GROUP = "by"
_METRICS = ("metric", "metrics", "rank_by")


class Form(Protocol):
    """The fields that a page sends."""

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
class PlotTypeChoice:
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
    choices: tuple[PlotTypeChoice, ...]
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
    from slamhive.services.analysis import OfferedColumns  # noqa: PLC0415 - as above

    return [_card(plot, offered or OfferedColumns()) for _, plot in PLOT_TYPES]


def entry_of(card: Card, form: Form) -> dict[str, Any]:
    """The entry of an analysis file that the fields of a card say; what a field does not say is left to the default."""
    entry: dict[str, Any] = {"form": card.key}
    for field in card.fields:
        values = [value for value in form.getlist(field.name) if value]
        if values:
            entry[field.option] = values if field.several else values[0]
    return dict(strict_yaml.parse(card.example, "example")["forms"][0]) if entry == {"form": card.key} else entry


def choosing(card: Card, content: Mapping[str, Any]) -> Card:
    """The card with the choices of an entry that somebody has written; what its fields do not offer is offered too."""
    fields = []
    for field in card.fields:
        value = content.get(field.option)
        wanted = [str(entry) for entry in (value if isinstance(value, list) else [value])]
        offered = [(choice.value, choice.label) for choice in field.choices]
        missing = [(key, key) for key in wanted if key not in dict(offered)]
        choices = tuple(PlotTypeChoice(key, label, key in wanted) for key, label in [*offered, *missing])
        fields.append(replace(field, choices=choices) if field.option in content else field)
    return replace(card, fields=tuple(fields))


def _card(plot: Any, offered: OfferedColumns) -> Card:
    schema = plot.options.model_json_schema()
    helps, fields = [], []
    example: dict[str, Any] = {"form": plot.key}
    for name, field in plot.options.model_fields.items():
        described = schema["properties"][name]
        default = None if field.default is PydanticUndefined else field.default
        if field.default_factory is not None:
            default = field.default_factory()
        shown = ""
        if field.is_required():
            shown = "needed"
        elif default not in (None, "", [], ()):
            shown = strict_yaml.dump({"value": default}).partition(":")[2].strip()  # as in the file
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
    """The choices of a field, with labels; empty for an option that names no column."""
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
    """True if its axes may be metrics: where a plot has a metric besides, its axes are parameters."""
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
    choices = tuple(PlotTypeChoice(value, label, value in picked) for value, label in values)
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


def kind_of(described: Mapping[str, Any]) -> str:
    """The kind of an option in words."""
    if "enum" in described:
        return " or ".join(map(str, described["enum"]))
    if described.get("type") == "array":
        return f"list of {kind_of(described['items'])}"
    if "anyOf" in described:
        return kind_of(described["anyOf"][0])
    return {"string": "text", "integer": "whole number"}.get(str(described.get("type")), str(described.get("type")))


# -- the list ``forms`` in the text of an analysis: entries are added, replaced, moved and removed line by line --------

# Everything else in the text stays as it is written, comments too.

_LIST = "forms"
_KIND = "form"
_OTHER_BREAKS = re.compile("[\r\x85\u2028\u2029]")
"""What ends a line for a parser of YAML besides a line feed. A text that has one is not changed line by line."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry. Its lines are those from ``begin`` up to ``end``, from 0; comments above it belong to it."""

    number: int
    begin: int
    end: int
    content: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Its plot type."""
        return str(self.content.get(_KIND, ""))

    @property
    def words(self) -> str:
        """Its other options, in one line."""
        return ", ".join(f"{name}: {_in_words(value)}" for name, value in self.content.items() if name != _KIND)


def entries(text: str) -> list[Entry]:
    """The entries in their order; none of a text that cannot be read, or whose list is in one line."""
    try:
        content, places = strict_yaml.parse_with_lines(text, "the text")
    except InvalidInput:
        return []
    found, lines = content.get(_LIST), text.split("\n")
    if not isinstance(found, list) or not found or _is_in_one_line(lines) or _OTHER_BREAKS.search(text):
        return []
    begins, before = [], places[(_LIST,)] - 1
    for place in range(len(found)):
        dash = places[(_LIST, place)] - 1  # where the content of the entry begins, perhaps below its dash
        while dash > 0 and not lines[dash].lstrip().startswith("-"):
            dash -= 1
        # Comments right above a dash belong to the entry; what is indented more belongs to the entry before.
        begin = dash
        while begin > before + 1 and lines[begin - 1].lstrip().startswith("#"):
            if _indent(lines[begin - 1]) > _indent(lines[dash]):
                break
            begin -= 1
        begins.append(begin)
        before = dash
    last = before + 1
    while last < len(lines) and (not lines[last].strip() or lines[last][0] == " "):
        last += 1
    ends = [*begins[1:], last]
    contents = [entry if isinstance(entry, dict) else {} for entry in found]
    numbered = enumerate(zip(begins, ends, contents, strict=True), start=1)
    return [Entry(number, begin, end, content) for number, (begin, end, content) in numbered]


def with_entry(text: str, added: Mapping[str, Any]) -> str:
    """The text with one more entry at the end of the list; raises InvalidInput if the list is in one line."""
    lines = text.rstrip().split("\n") if text.strip() else []
    start = _start(lines)
    if start is None:
        return "\n".join([*lines, f"{_LIST}:", *_written(added)]) + "\n"
    if _is_in_one_line(lines):
        raise _one_line()
    end = start + 1
    while end < len(lines) and (not lines[end].strip() or lines[end][0] in " -#"):
        end += 1
    written = next((line for line in lines[start + 1 : end] if line.lstrip().startswith("- ")), None)
    shifted = _written(added, None if written is None else _indent(written))
    return "\n".join([*lines[:end], *shifted, *lines[end:]]) + "\n"


def without_entry(text: str, number: int) -> str:
    """The text without one entry. Raises NotFound."""
    lines, entry = text.split("\n"), find_entry(text, number)
    return "\n".join([*lines[: entry.begin], *lines[entry.end :]])


def replaced_entry(text: str, number: int, content: Mapping[str, Any]) -> str:
    """The text with other content in the place of one entry. Comments above it stay. Raises NotFound."""
    lines, entry = text.split("\n"), find_entry(text, number)
    dash = next(place for place in range(entry.begin, entry.end) if lines[place].lstrip().startswith("-"))
    written = _written(content, _indent(lines[dash]))
    end = entry.end  # the blank lines that end the entry stay
    while not lines[end - 1].strip():
        end -= 1
    return "\n".join([*lines[:dash], *written, *lines[end:]])


def moved_entry(text: str, number: int, steps: int) -> str:
    """The text with one entry ``steps`` places later, or earlier if negative. Raises NotFound."""
    lines, (one, other) = text.split("\n"), _find(text, *sorted((number, number + steps)))
    between = lines[one.end : other.begin]
    swapped = [*lines[other.begin : other.end], *between, *lines[one.begin : one.end]]
    return "\n".join([*lines[: one.begin], *swapped, *lines[other.end :]])


def find_entry(text: str, number: int) -> Entry:
    """One entry, counted from 1. Raises NotFound."""
    return _find(text, number)[0]


def _find(text: str, *numbers: int) -> list[Entry]:
    """Several entries, of a text that is parsed once. Raises NotFound."""
    found = {entry.number: entry for entry in entries(text)}
    for number in numbers:
        if number not in found:
            if _is_in_one_line(text.split("\n")):
                raise _one_line()
            raise NotFound(f"the text has no plot {number}", f"it has {len(found)}")
    return [found[number] for number in numbers]


def _written(content: Mapping[str, Any], indent: int | None = None) -> list[str]:
    """The lines of an entry, with the dash at an indent."""
    dumped = strict_yaml.dump({_LIST: [dict(content)]}).splitlines()
    lines = [line for line in dumped if line and line != f"{_LIST}:"]
    own = _indent(lines[0])
    return [" " * (own if indent is None else indent) + line[own:] for line in lines]


def _start(lines: list[str]) -> int | None:
    """The line of the key of the list."""
    return next((place for place, line in enumerate(lines) if line.startswith(f"{_LIST}:")), None)


def _is_in_one_line(lines: list[str]) -> bool:
    start = _start(lines)
    return start is not None and bool(lines[start].partition(":")[2].partition("#")[0].strip())


def _one_line() -> InvalidInput:
    remedy = "write each plot in a line of its own, beginning with '-'"
    return InvalidInput(f"{_LIST!r} is written in one line", remedy)


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _in_words(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_in_words, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {_in_words(entry)}" for name, entry in value.items()) + "}"
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else str(value)


# -- the buttons of the editor that change the plots of its text -------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ChangedAnalysis:
    """The text after a change, what was done, and the plot whose choices its card should show."""

    text: str
    notice: str
    editing: Entry | None = None


class AnalysisChanges:
    """Changes by the buttons. A button sends a verb, a colon, and its subject: a plot type, a number, or both.

    Args:
        text: Of the editor.
        cards: The cards beside it; asked for when a change needs them.
        form: What the page has sent with the button.
    """

    def __init__(self, text: str, cards: Callable[[], Sequence[Card]], form: Form) -> None:
        self._text = text
        self._cards = cards
        self._form = form
        self._verbs: dict[str, Callable[[str], ChangedAnalysis]] = {
            "insert": self._insert,
            "edit": self._edit,
            "replace": self._replace,
            "remove": self._remove,
            "earlier": lambda what: self._move(what, -1),
            "later": lambda what: self._move(what, 1),
        }

    def made(self, button: str) -> ChangedAnalysis | None:
        """The change of one button; None for other buttons. Raises NotFound, InvalidInput."""
        verb, _, what = button.partition(":")
        change = self._verbs.get(verb)
        return None if change is None else change(what)

    def _insert(self, key: str) -> ChangedAnalysis:
        longer = with_entry(self._text, entry_of(self._card(key), self._form))
        return ChangedAnalysis(longer, f"Plot {len(entries(longer))} was added: {key}.")

    def _edit(self, number: str) -> ChangedAnalysis:
        entry = find_entry(self._text, _number(number))
        self._card(entry.key)
        return ChangedAnalysis(self._text, f"Change plot {number} under {entry.key}, then replace it.", entry)

    def _replace(self, what: str) -> ChangedAnalysis:
        number, _, key = what.partition(":")
        before, card = find_entry(self._text, _number(number)), self._card(key)
        written = entry_of(card, self._form)
        if before.key == key:  # what has no field stays
            fields = {field.option for field in card.fields}
            written = {**{name: value for name, value in before.content.items() if name not in fields}, **written}
        return ChangedAnalysis(replaced_entry(self._text, before.number, written), f"Plot {number} was changed: {key}.")

    def _remove(self, number: str) -> ChangedAnalysis:
        return ChangedAnalysis(without_entry(self._text, _number(number)), f"Plot {number} was removed.")

    def _move(self, number: str, steps: int) -> ChangedAnalysis:
        place = _number(number)
        return ChangedAnalysis(moved_entry(self._text, place, steps), f"Plot {place} is now plot {place + steps}.")

    def _card(self, key: str) -> Card:
        known = {card.key: card for card in self._cards()}
        if key not in known:
            raise unknown("plot type", key, list(known))
        return known[key]


def _number(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise InvalidInput(f"{text[:40]!r} is not the number of a plot")
    return int(text)


# -- analysis files written by pages: a first one for a search or an experiment, the constraint selector ---------------

FIRST = """name: A first look
text: |
  Write your text here, in Markdown.
select:
  runs: {where: %s}
forms:
  - form: by_algorithm
    metric: ate.rmse
  - form: distributions
    metrics: [ate.rmse]
"""
_UNNAMED = FIRST.partition("\n")[0].removeprefix("name: ")
ALL = "id >= 1"
"""A filter that matches every run."""
ERROR = "ate.rmse"
MOST_LINES = 3
"""Parameters that an analysis of an experiment draws a metric over."""
BOUNDS = {
    "max_cores": ("cpu.mean", "<=", 1.0),
    "max_memory_mb": ("ram.max", "<=", 1e6),
    "min_tracked": ("tracked_fraction", ">=", 1.0),
    "max_ate_m": ("ate.rmse", "<=", 1.0),
}
"""Fields of the selector: metric, comparison, and the factor from the field's unit to the metric's unit."""


_NAME_LINE = re.compile(r"^name:[ \t]*(?![>|])[^\n]*$", re.MULTILINE)


def title_of(text: str) -> str:
    """The name in an analysis file; empty if it has none, or still the one that a first file comes with."""
    try:
        name = strict_yaml.parse(text, "text").get("name")
    except InvalidInput:
        return ""
    return name if isinstance(name, str) and name != _UNNAMED else ""


def with_title(text: str, title: str) -> str:
    """The same text with another name; an empty title, or the one that it has, leaves it as it is."""
    title = " ".join(title.split())
    if not title or title == title_of(text):
        return text
    line = f"name: {json.dumps(title, ensure_ascii=False)}"  # a JSON string is a quoted YAML string
    found = _NAME_LINE.search(text)
    return f"{text[: found.start()]}{line}{text[found.end() :]}" if found else f"{line}\n{text}"


def first_text(where: str) -> str:
    """An analysis file for the runs that match a filter; an empty filter matches all."""
    return FIRST % json.dumps(where.strip() or ALL, ensure_ascii=False)  # a JSON string is a quoted YAML string


def experiment_text(
    name: str, axes: Mapping[str, Sequence[Value]], crossed: Callable[[str, str], bool] = lambda _first, _second: True
) -> str:
    """An analysis file for an experiment, with plots that fit what it varies.

    Args:
        name: Of the experiment.
        axes: Its axes with their values.
        crossed: Whether values of two axes are combined; values of linked axes follow from each other.
    """
    varying = [axis for axis, values in axes.items() if len(values) > 1]
    parameters = [axis for axis in varying if axis not in ("algorithm", "dataset")]
    numeric = [axis for axis in parameters if all(type(value) in (int, float) for value in axes[axis])]
    paper = {"columns": "algorithms"} if "algorithm" in varying else {}
    forms: list[dict[str, Any]] = [{"form": "table", **paper}, {"form": "by_algorithm", "metric": ERROR}]
    forms += [{"form": "line", "x": axis, "metric": ERROR} for axis in numeric[:MOST_LINES]]
    pair = next((pair for pair in combinations(parameters, 2) if crossed(*pair)), None)
    if pair is not None:
        forms.append({"form": "heatmap", "x": pair[0], "y": pair[1], "metric": ERROR})
        forms.append({"form": "importance", "metric": ERROR})
    forms.append({"form": "distributions", "metrics": [ERROR]})
    if "algorithm" in varying or parameters:
        forms.append({"form": "pareto", "metrics": ["cpu.mean", ERROR]})
    varied = f"It varies {', '.join(varying)}." if varying else "It varies nothing."
    content = {"name": name, "text": varied, "select": {"runs": {"experiment": name}}, "forms": forms}
    return strict_yaml.dump(content)


def selector_text(fields: Mapping[str, str], sensors: list[str], datasets: list[str]) -> str:
    """An analysis file that asks for configurations within limits; raises InvalidInput naming the field.

    Args:
        fields: Typed text of the fields in :data:`BOUNDS`; empty means no limit.
        sensors: Sensor setups to consider; empty means all.
        datasets: Datasets to consider; empty means all.
    """
    bounds = []
    for name, (metric, sign, factor) in BOUNDS.items():
        text = fields.get(name, "").strip()
        if text:
            bounds.append(f"{metric} {sign} {_number_text(name, text) * factor:g}")
    if not bounds:
        raise InvalidInput("no limit is set", "fill in at least one field")
    for name in sensors:
        if name not in list(SensorSetup):
            raise InvalidInput(f"unknown sensors {name[:40]!r}", f"use one of {', '.join(SensorSetup)}")
    conditions = []
    if sensors:
        conditions.append(f"sensor in ({', '.join(sensors)})")
    if datasets:
        conditions.append(f"dataset in ({', '.join(quoted(name[:100]) for name in datasets)})")
    content = {
        "name": "Configurations within limits",
        "select": {"candidates": {"where": " and ".join(conditions) or ALL}},
        "forms": [{"form": "selector", "bounds": bounds}],
    }
    return strict_yaml.dump(content)


def _number_text(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < 1e12:
        raise InvalidInput(f"{name.replace('_', ' ')} {text[:40]!r} is not a positive number", "for example, enter 1.5")
    return number
