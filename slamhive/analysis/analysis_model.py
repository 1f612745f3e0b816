"""The model of an analysis file, from which its JSON Schema is made, and its named sets of runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from slamhive.base.errors import InvalidInput, unknown
from slamhive.documents.model import explained
from slamhive.domain.verdict import MOST_MISSED, FailureRule

_TOKEN = re.compile(r"\s*(?:(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<sign>[|&()∪∩∖\\-]))")
_WORDS = {"union": "|", "or": "|", "intersection": "&", "and": "&", "minus": "-", "without": "-", "difference": "-"}
_SIGNS = {"∪": "|", "∩": "&", "∖": "-", "\\": "-"}
_MEANING: dict[str, Callable[[frozenset[int], frozenset[int]], frozenset[int]]] = {
    "|": frozenset.union,
    "&": frozenset.intersection,
    "-": frozenset.difference,
}
_IN_WORDS = {"|": "or", "&": "and also", "-": "but not"}
_MAX_DEPTH = 50


@dataclass(frozen=True, slots=True)
class SetName:
    """A set by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class Combined:
    """Two expressions joined by ``|`` (union), ``&`` (intersection) or ``-`` (difference)."""

    sign: str
    left: Expression
    right: Expression


Expression = SetName | Combined


def parse_expression(text: str) -> Expression:
    """Parse an expression such as ``(a | b) - c``.

    Operators have equal precedence and apply from left to right. Words (``union``, ``intersection``, ``minus``) and
    mathematical signs are allowed too.

    Raises:
        InvalidInput: with the position of the mistake.
    """
    parser = _Parser(text)
    expression = parser.expression(0)
    parser.end()
    return expression


def names_in(expression: Expression) -> set[str]:
    """The names of the sets in an expression."""
    if isinstance(expression, SetName):
        return {expression.name}
    return names_in(expression.left) | names_in(expression.right)


def union_of(names: Collection[str]) -> Expression:
    """The union of all sets."""
    first, *others = [SetName(name) for name in names]
    expression: Expression = first
    for other in others:
        expression = Combined("|", expression, other)
    return expression


def evaluate(expression: Expression, members: Callable[[str], frozenset[int]]) -> frozenset[int]:
    """The run ids in the set that ``expression`` describes.

    Args:
        expression: Over names of sets.
        members: Gives the run ids of a set by its name; raises NotFound for an unknown name.
    """
    if isinstance(expression, SetName):
        return members(expression.name)
    return _MEANING[expression.sign](evaluate(expression.left, members), evaluate(expression.right, members))


def in_words(expression: Expression, words: Callable[[str], str]) -> str:
    """The expression in words; ``words`` describes a set by its name."""
    if isinstance(expression, SetName):
        return words(expression.name)
    left, right = in_words(expression.left, words), in_words(expression.right, words)
    return f"({left}) {_IN_WORDS[expression.sign]} ({right})"


def check_names(expression: Expression, known: Collection[str]) -> None:
    """Raise NotFound for a name without a set."""
    for name in sorted(names_in(expression)):
        if name not in known:
            raise unknown("set", name, list(known))


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._place = 0
        self._tokens: list[tuple[str, str, int]] = []
        while text[self._place :].strip():
            match = _TOKEN.match(text, self._place)
            if match is None:
                at = self._place + len(text[self._place :]) - len(text[self._place :].lstrip())
                raise self._error(at, f"unexpected {text[at]!r}")
            kind, token = ("name", match["name"]) if match["name"] else ("sign", match["sign"])
            if kind == "name" and token.lower() in _WORDS:
                kind, token = "sign", _WORDS[token.lower()]
            self._tokens.append((kind, _SIGNS.get(token, token), match.end() - len(match[0].strip())))
            self._place = match.end()
        self._next = 0

    def expression(self, depth: int) -> Expression:
        if depth > _MAX_DEPTH:
            raise InvalidInput(f"'use' is nested deeper than {_MAX_DEPTH} parentheses")
        left = self._operand(depth)
        while (token := self._peek()) is not None and token[1] in _MEANING:
            self._next += 1
            left = Combined(token[1], left, self._operand(depth))
        return left

    def end(self) -> None:
        token = self._peek()
        if token is not None:
            raise self._error(token[2], f"unexpected {token[1]!r}")

    def _operand(self, depth: int) -> Expression:
        token = self._peek()
        if token is None:
            raise self._error(len(self._text), "the name of a set is missing")
        kind, value, at = token
        self._next += 1
        if kind == "name":
            return SetName(value)
        if value != "(":
            raise self._error(at, f"expected the name of a set, found {value!r}")
        inner = self.expression(depth + 1)
        closing = self._peek()
        if closing is None or closing[1] != ")":
            raise self._error(at, "this '(' is not closed")
        self._next += 1
        return inner

    def _peek(self) -> tuple[str, str, int] | None:
        return self._tokens[self._next] if self._next < len(self._tokens) else None

    def _error(self, at: int, what: str) -> InvalidInput:
        shown = self._text if len(self._text) <= 80 else f"{self._text[:77]}..."
        return InvalidInput(f"'use' at character {at + 1}: {what} in {shown!r}", "an example: (a | b) - c")


# The model of an analysis file; its JSON Schema is made from it.


MAX_SETS = 50
MAX_PLOTS = 50
MAX_LISTED = 100_000
_SET_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_RESERVED = {"union", "or", "intersection", "and", "minus", "without", "difference"}

Id = Annotated[int, Field(ge=1, lt=2**63)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SetModel(_Model):
    """A set of runs, given by exactly one field."""

    where: str | None = Field(default=None, min_length=1, description="A filter, as on the page of runs.")
    experiment: str | None = Field(default=None, min_length=1, description="All runs of an experiment.")
    runs: list[Id] | None = Field(default=None, min_length=1, max_length=MAX_LISTED, description="Numbers of runs.")
    configurations: list[Id] | None = Field(
        default=None, min_length=1, max_length=MAX_LISTED, description="All runs of these configurations."
    )
    search: str | None = Field(default=None, min_length=1, description="The name of a saved search.")
    group: str | None = Field(default=None, min_length=1, description="The name of a group of configurations.")

    @model_validator(mode="after")
    def _one_way(self) -> SetModel:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "nothing"
            known = ", ".join(type(self).model_fields)
            raise explained(InvalidInput(f"a set needs exactly one field, found {found}", f"use one of {known}"))
        return self


class FailureModel(_Model):
    """Rule by which a run that ended well counts as failed; replaces the rule that applies elsewhere."""

    tracked_path_below: float | None = Field(
        default=0.7, ge=0, le=1, description="Share of the path; gaps relate to the spacing of the estimate."
    )
    tracked_fraction_below: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Share of the time, by the protocol's gap; replaces the share of the path.",
    )
    ate_rmse_above_m: float | None = Field(default=None, gt=0)
    ate_path_above_percent: float | None = Field(default=5.0, gt=0, description="ATE RMSE in percent of the path.")
    ate_extent_above_percent: float | None = Field(
        default=50.0, gt=0, description="ATE RMSE in percent of the ATE RMSE of an estimate that never moves."
    )
    outliers: bool = Field(default=True, description="Whether an outlier among repeats counts as diverged.")
    missed_input_above: float | None = Field(
        default=MOST_MISSED, ge=0, le=1, description="Share of the input frames that may not reach the algorithm."
    )

    @property
    def rule(self) -> FailureRule:
        """The rule; a file that names only the share of the time replaces the share of the path by it."""
        rule = FailureRule(**self.model_dump())
        given = self.model_fields_set
        by_time = "tracked_fraction_below" in given and "tracked_path_below" not in given
        return replace(rule, tracked_path_below=None) if by_time else rule


def _set_name(name: str) -> str:
    if not _SET_NAME.fullmatch(name) or name.lower() in _RESERVED:
        raise explained(
            InvalidInput(
                f"{name!r} cannot name a set", "use letters, digits and '_', begin with a letter, and use no operator"
            )
        )
    return name


def read_by(parse: Callable[[str], object]) -> AfterValidator:
    """A validator that accepts what ``parse`` reads, and reports its InvalidInput."""

    def check(text: str) -> str:
        try:
            parse(text)
        except InvalidInput as error:
            raise explained(error) from None
        return text

    return AfterValidator(check)


class AnalysisModel(_Model):
    """An analysis: its runs, protocol and plots."""

    model_config = ConfigDict(title="SLAM Hive analysis")
    format: Literal[1] = 1
    name: str = Field(min_length=1, max_length=200, description="Name of the analysis.")
    text: str = Field(default="", max_length=100_000, description="Markdown above the plots.")
    select: dict[Annotated[str, AfterValidator(_set_name)], SetModel] = Field(
        min_length=1, max_length=MAX_SETS, description="Sets of runs by name."
    )
    use: Annotated[str, read_by(parse_expression)] | None = Field(
        default=None,
        max_length=10_000,
        description="An expression over the sets, such as (a | b) - c; their union if absent.",
    )
    protocol: str | None = Field(
        default=None, description="Fingerprint of the evaluation protocol; the current protocol of each run if absent."
    )
    one: list[Literal["algorithm", "dataset"]] = Field(
        default_factory=list, description="The selection must have only one of these."
    )
    exclude_disturbed: bool = Field(
        default=False, description="Leave out runs that were measured on a disturbed machine, and report their number."
    )
    failed_when: FailureModel = Field(default_factory=FailureModel)
    forms: list[dict[str, Any]] = Field(
        min_length=1, max_length=MAX_PLOTS, description="The plots in order; 'form' names the plot type."
    )
