"""Errors in a file, in one line that a user understands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticCustomError

from slamhive.base.errors import (
    Conflict,
    Forbidden,
    InvalidInput,
    NotFound,
    SlamHiveError,
    TooManyRequests,
    Unauthenticated,
    Unavailable,
    nearest,
)
from slamhive.domain.names import check_name, plural

_UNION_TAGS = {"bool", "int", "float", "str", "list[float]", "tuple[float, ...]"}
"""What pydantic adds to a place to tell which member of a union did not fit."""

PLAIN, SECTION = "<plain>", "<section>"
"""Tags for the members of a union that is told apart by shape; never shown."""

_NOT_SHOWN = {PLAIN, SECTION, "[key]"}
_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
_EXPLAINED = "explained"

_SAYINGS = {
    "string_type": "must be text; put it in quotes",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "dict_type": "must be keys with values",
    "model_type": "must be keys with values",
    "dataclass_type": "must be keys with values",
    "dataclass_exact_type": "must be keys with values",
    "model_attributes_type": "must be keys with values",
    "finite_number": "must be a finite number",
}
_SHOWN = 80


def first_problem(error: ValidationError, model: type[Any] | None = None) -> str:
    """The first problem as ``place: what is wrong (found value)``, and how many more there are.

    A key that is unknown comes first: a misspelt key is also one that is missing.

    Args:
        error: What pydantic found.
        model: What was validated; with it, an unknown key is answered with the nearest known one.
    """
    return first_problem_at(error, model)[1]


def explained(error: InvalidInput) -> PydanticCustomError:
    """For a validator to raise: ``error`` becomes the problem, whose message names the value itself."""
    return PydanticCustomError(_EXPLAINED, "{text}", {"text": str(error)})


def first_problem_at(error: ValidationError, model: type[Any] | None = None) -> tuple[tuple[int | str, ...], str]:
    """The place of the first problem, and what :func:`first_problem` says of it."""
    problems = error.errors(include_url=False)
    problems.sort(key=lambda problem: problem["type"] not in _UNKNOWN_KEY)
    first: dict[str, Any] = {**problems[0]}
    places = [_place(problem["loc"]) for problem in problems]
    more = len(set(places)) - 1
    also = f"; and {more} more" if more else ""
    return places[0], _sentence(first, places[0], model) + also


def _sentence(first: Mapping[str, Any], path: tuple[int | str, ...], model: type[Any] | None) -> str:
    place = ".".join(str(part) for part in path) or "top level"
    if first["type"] in ("missing", "missing_argument"):
        return f"{place} is missing"
    if first["type"] == _EXPLAINED:
        return f"{place}: {first['msg']}"
    if first["type"] in _UNKNOWN_KEY:
        annotation: Any = model
        for part in path[:-1]:
            keys = _keys(annotation)
            if keys is not None:
                annotation = _inner(keys.get(str(part)))
            else:
                inside = [inner for inner in get_args(annotation) if inner is not Ellipsis]
                annotation = _inner(inside[-1]) if inside else None
        known = list(_keys(annotation) or ())
        hint = f"; {nearest(str(path[-1]), known)}" if known else ""
        return f"unknown key {place!r}{hint}"
    wanted = "has a type that is not allowed here" if path != _shown(first["loc"]) else _saying(first)
    return f"{place}: {wanted} (found {repr(first['input'])[:_SHOWN]})"


def check_name_in(source: Path, kind: str, name: str) -> str:
    """:func:`check_name`, with the file in the message."""
    try:
        return check_name(kind, name)
    except InvalidInput as error:
        raise InvalidInput(f"{source}: {error.message}", error.remedy) from None


def _place(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """``loc`` up to the union member that pydantic tried; a top-level key of that name stays."""
    loc = _shown(loc)
    for index in range(len(loc) - 1, 0, -1):
        if loc[index] in _UNION_TAGS:
            return loc[:index]
    return loc


def _shown(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    return tuple(part for part in loc if part not in _NOT_SHOWN)


def _saying(problem: Mapping[str, Any]) -> str:
    kind, context = problem["type"], problem.get("ctx", {})
    if kind == "too_short":
        return f"must have at least {plural(context['min_length'], 'entry', 'entries')}, not {context['actual_length']}"
    if kind == "too_long":
        return f"must have at most {plural(context['max_length'], 'entry', 'entries')}, not {context['actual_length']}"
    message: str = problem["msg"]
    return _SAYINGS.get(kind) or message.removeprefix("Value error, ").replace("Input should be", "must be")


def _keys(annotation: Any) -> Mapping[str, Any] | None:
    """The keys of a model or dataclass with their types, None for anything else."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {name: field.annotation for name, field in annotation.model_fields.items()}
    if not is_dataclass(annotation):
        return None
    types = get_type_hints(annotation)
    return {field.name: types[field.name] for field in fields(annotation)}  # class variables are no keys


def _inner(annotation: Any) -> Any:
    """The one thing that an optional or annotated type is about."""
    if get_origin(annotation) is Annotated:
        return _inner(get_args(annotation)[0])
    if get_origin(annotation) in {Union, UnionType}:
        return next((_inner(part) for part in get_args(annotation) if part is not type(None)), None)
    return annotation


# Which HTTP status stands for which error: the web answers by it, and clients raise by it.


STATUS: dict[type[SlamHiveError], int] = {
    InvalidInput: 400,
    Unauthenticated: 401,
    Forbidden: 403,
    NotFound: 404,
    Conflict: 409,
    TooManyRequests: 429,
    Unavailable: 503,
}
