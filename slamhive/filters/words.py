"""Writes a search as the end of a sentence: ``ATE RMSE below 0.1 m and state failed``."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta

from slamhive.domain.names import plain
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.filters.binding import Condition, Search, Value
from slamhive.filters.fields import BUILT_IN, Field, FieldKind, Source
from slamhive.filters.syntax import Sign, Tree, join, written

_DAY = timedelta(days=1)
_SPELT_OUT = frozenset({"reason", "disturbed_by"})
_WORDS = {
    Sign.NOT_EQUAL: "not {}",
    Sign.LESS: "below {}",
    Sign.AT_MOST: "at most {}",
    Sign.MORE: "above {}",
    Sign.AT_LEAST: "at least {}",
    Sign.LIKE: "like {}",
    Sign.UNLIKE: "not like {}",
    Sign.BETWEEN: "from {} to {}",
}


def in_words(search: Search) -> str:
    """The search in words; empty for all runs."""
    parts = [] if search.tree is None else [written(search.tree, _words)]
    if search.protocol is not None:
        parts.append(f"metrics under protocol {search.protocol}")
    return ", ".join(parts)


def _words(condition: Condition) -> str:
    field, sign = condition.field, condition.sign
    # Abbreviations such as ATE keep their capitals within a sentence.
    name = field.label if field.label[:2].isupper() else field.label[:1].lower() + field.label[1:]
    if field.source is Source.PARAMETER:
        name = field.name
    if sign in {Sign.HAS, Sign.MISSING}:
        return f"{'with' if sign is Sign.HAS else 'without'} {name}"
    if field.kind is FieldKind.TIME:
        return f"{name} {_span(condition)}"
    if field.kind is FieldKind.FLAG and field.source is not Source.PARAMETER:
        yes = condition.values[0] is (sign is Sign.EQUAL)
        return {"variant": "of a pre-processed recording"}.get(field.name, name) if yes else f"not {name}"
    values = [_value(field, value) for value in condition.values]
    if sign in {Sign.IN, Sign.NOT_IN}:
        if sign is Sign.IN and len(values) == 1:
            return f"{name} {values[0]}"
        return f"{name} {'one' if sign is Sign.IN else 'none'} of {', '.join(values) or 'nothing'}"
    return f"{name} " + _WORDS.get(sign, "{}").format(*values)


def _value(field: Field, value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        if field.unit == "bytes":
            for factor, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
                if abs(value) >= factor:
                    return f"{value / factor:g} {name}"
        return f"{plain(value)} {field.unit}".strip()
    if field.source is Source.VERDICT:
        return VerdictKind(str(value)).label
    return str(value).replace("_", " ") if field.kind is FieldKind.CHOICE and field.name in _SPELT_OUT else str(value)


def _span(condition: Condition) -> str:
    moments = [value for value in condition.values if isinstance(value, datetime)]
    if condition.sign is Sign.LESS:
        return f"before {_moment(moments[0])}"
    if condition.sign is Sign.AT_LEAST:
        return f"since {_moment(moments[0])}"
    begin, end = moments
    last = end - _DAY if _moment(end).count(":") == 0 else end
    words = f"on {_moment(begin)}" if begin == last else f"from {_moment(begin)} to {_moment(last)}"
    return words if condition.sign is Sign.EQUAL else f"not {words}"


def _moment(at: datetime) -> str:
    midnight = at.hour == at.minute == at.second == at.microsecond == 0
    return at.strftime("%Y-%m-%d") if midnight else at.strftime("%Y-%m-%d %H:%M:%S UTC")


# Builds searches in code.


def matching(  # noqa: PLR0913 - every one may be left out
    *,
    states: Iterable[RunState] = (),
    reasons: Iterable[FailureReason] = (),
    algorithms: Iterable[str] = (),
    datasets: Iterable[str] = (),
    executors: Iterable[str] = (),
    experiments: Iterable[str] = (),
    configuration_id: int | None = None,
    created_after: datetime | None = None,
    created_before: datetime | None = None,
    evaluated: bool | None = None,
) -> Search:
    """Search for runs that match all arguments; empty and None do not restrict.

    ``created_after`` is inclusive, ``created_before`` is not; ``evaluated``: whether an evaluation succeeded.
    """
    parts: list[Tree[Condition]] = []

    def add(name: str, sign: Sign, *values: Value) -> None:
        parts.append(Condition(BUILT_IN[name], sign, values))

    lists: dict[str, Iterable[str]] = {
        "state": states,
        "reason": reasons,
        "algorithm": algorithms,
        "dataset": datasets,
        "executor": executors,
        "experiment": experiments,
    }
    for name, values in lists.items():
        if wanted := tuple(str(value) for value in values):
            add(name, Sign.IN, *wanted)
    if configuration_id is not None:
        add("configuration", Sign.EQUAL, configuration_id)
    if created_after is not None:
        add("created_at", Sign.AT_LEAST, created_after)
    if created_before is not None:
        add("created_at", Sign.LESS, created_before)
    if evaluated is not None:
        add("evaluated", Sign.EQUAL, evaluated)
    return Search(join("and", parts)) if parts else Search()
