"""Reads analysis files; messages about mistakes name file and line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from slamhive.analysis.analysis_model import (
    AnalysisModel,
    Expression,
    SetModel,
    check_names,
    in_words,
    parse_expression,
    union_of,
)
from slamhive.analysis.paper_file import convert, is_paper_file, only_analysis
from slamhive.analysis.plot_types import PLOT_TYPES, PlotOptions, PlotType
from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.documents.model import first_problem_at
from slamhive.domain.verdict import FailureRule
from slamhive.packages.published.knowledge import Numbers

PROTOCOL = "protocol:"

ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class PlotRequest:
    """One plot of an analysis; messages name its ``place`` in the file."""

    plot_type: PlotType[Any]
    options: PlotOptions
    place: str


@dataclass(frozen=True, slots=True)
class Analysis:
    """A checked analysis. The caller looks up its sets and names."""

    name: str
    text: str
    sets: dict[str, SetModel]
    use: Expression
    protocol: str | None
    one: tuple[str, ...]
    rule: FailureRule
    plots: tuple[PlotRequest, ...]
    source: str
    exclude_disturbed: bool = False
    places: Mapping[str, str] = field(default_factory=dict)
    """Places for messages: of each set by its name, and of the protocol under ``protocol:``."""

    def first(self, plots: int) -> Analysis:
        """The same with its first plots alone."""
        return replace(self, plots=self.plots[:plots])

    def placed(self, part: str, error: SlamHiveError) -> SlamHiveError:
        """The error, prefixed by the place of a part of :attr:`places`."""
        if part not in self.places:
            return error
        kind = NotFound if isinstance(error, NotFound) else InvalidInput
        return kind(f"{self.places[part]}: {error.message}", error.remedy)

    @property
    def selection_words(self) -> str:
        """The selection as a sentence."""
        return in_words(self.use, lambda name: set_words(self.sets[name]))


def set_words(chosen: SetModel) -> str:
    """A set in words."""
    if chosen.where is not None:
        return f"runs where {chosen.where}"
    if chosen.experiment is not None:
        return f"runs of experiment {chosen.experiment}"
    if chosen.search is not None:
        return f"runs of the saved search {chosen.search!r}"
    if chosen.group is not None:
        return f"runs of the configurations of group {chosen.group!r}"
    ids, noun = (chosen.runs, "run") if chosen.runs is not None else (chosen.configurations or [], "configuration")
    listed = ", ".join(map(str, ids[:8])) + (f" and {len(ids) - 8} more" if len(ids) > 8 else "")
    of = "" if noun == "run" else "runs of "
    return f"{of}{noun}{'s' if len(ids) > 1 else ''} {listed}"


def parse_analysis(
    text: str, source: str = "analysis.yaml", here: Numbers | None = None, given: Mapping[str, str] | None = None
) -> Analysis:
    """Read an analysis file of SLAM Hive or of the published system.

    Args:
        text: The YAML.
        source: Name of the file for messages.
        here: The numbers of this installation, for a file of the published system.
        given: What a user says about the numbers in such a file.

    Raises:
        InvalidInput: with the line.
    """
    content, lines = strict_yaml.parse_with_lines(only_analysis(text, source), source)
    places = strict_yaml.Places(source, lines)
    if is_paper_file(content):
        content = convert(content, places, here or Numbers(), given or {})
    model = _validated(AnalysisModel, content, (), places)
    plots = tuple(_plot(raw, index, places) for index, raw in enumerate(model.forms))
    use = union_of(list(model.select)) if model.use is None else parse_expression(model.use)
    try:
        check_names(use, list(model.select))
    except SlamHiveError as error:
        raise InvalidInput(f"{places.of('use')}: {error.message}") from None
    return Analysis(
        name=model.name,
        text=model.text,
        sets=dict(model.select),
        use=use,
        protocol=model.protocol,
        one=tuple(model.one),
        rule=model.failed_when.rule,
        plots=plots,
        source=text,
        exclude_disturbed=model.exclude_disturbed,
        places={name: str(places.of("select", name)) for name in model.select} | {PROTOCOL: str(places.of("protocol"))},
    )


def analysis_schema() -> str:
    """The JSON Schema of an analysis file, with the options of every plot type."""
    schema: dict[str, Any] = AnalysisModel.model_json_schema()
    choices = []
    for key, plot_type in PLOT_TYPES:
        options = plot_type.options.model_json_schema()
        schema.setdefault("$defs", {}).update(options.pop("$defs", {}))
        options["properties"] = {"form": {"const": key}, **options.get("properties", {})}
        options["required"] = ["form", *options.get("required", [])]
        choices.append(options | {"title": plot_type.title, "description": plot_type.description})
    schema["properties"]["forms"]["items"] = {"anyOf": choices}
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=2) + "\n"


def _plot(raw: dict[str, Any], index: int, places: strict_yaml.Places) -> PlotRequest:
    place = places.of("forms", index)
    key = raw.get("form")
    if not isinstance(key, str):
        raise InvalidInput(f"{place}: 'form' is missing, name one of {', '.join(PLOT_TYPES.names())}")
    try:
        plot_type = PLOT_TYPES.get(key)
    except SlamHiveError as error:
        raise InvalidInput(f"{places.of('forms', index, 'form')}: {error.message}") from None
    options = {name: value for name, value in raw.items() if name != "form"}
    return PlotRequest(plot_type, _validated(plot_type.options, options, ("forms", index), places), str(place))


def _validated(
    model: type[ModelT], content: object, above: tuple[str | int, ...], places: strict_yaml.Places
) -> ModelT:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        path, problem = first_problem_at(error, model)
        raise InvalidInput(f"{places.of(*above, *path)}: {problem}") from None
