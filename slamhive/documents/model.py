"""JSON documents from typed values and back, and their errors in one line that a user understands."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import datetime
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Self, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    StrictInt,
    TypeAdapter,
    ValidationError,
)
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
from slamhive.documents.limits import StopWhen
from slamhive.domain.names import check_name, plural
from slamhive.domain.parameters import Parameter, ParameterType, Value
from slamhive.domain.trust import Disturbance

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
    kind, context = first["type"], first.get("ctx", {})
    if path != _shown(first["loc"]):
        wanted = "has a type that is not allowed here"
    elif kind in ("too_short", "too_long"):
        most, length = ("least", "min_length") if kind == "too_short" else ("most", "max_length")
        allowed = plural(context[length], "entry", "entries")
        wanted = f"must have at {most} {allowed}, not {context['actual_length']}"
    else:
        message: str = first["msg"]
        wanted = _SAYINGS.get(kind) or message.removeprefix("Value error, ").replace("Input should be", "must be")
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


# JSON documents from typed values and back, for every kind of document alike.


T = TypeVar("T")


class Document(BaseModel):
    """A JSON document. Its fields are read from the attributes of a record, or from JSON."""

    model_config = ConfigDict(frozen=True, from_attributes=True, populate_by_name=True, defer_build=True)

    @classmethod
    def of(cls, record: object, **more: Any) -> Self:
        """The document of a record. ``more`` are fields that the record does not have."""
        if not more:
            return cls.model_validate(record)
        found = {}
        for name, field in cls.model_fields.items():
            keys = (*getattr(field.validation_alias, "choices", ()), name)  # in the order in which pydantic tries them
            key = next((key for key in keys if hasattr(record, key)), None)
            if key is not None:
                found[name] = getattr(record, key)
        return cls.model_validate({**found, **more})

    @classmethod
    def read(cls, content: Any) -> Self:
        """The document that :attr:`content` wrote; raises InvalidInput naming the key that does not fit."""
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise InvalidInput(first_problem(error, cls)) from None

    @property
    def content(self) -> dict[str, Any]:
        """The document as JSON."""
        return self.model_dump(mode="json", by_alias=True)


_adapters: dict[Any, TypeAdapter[Any]] = {}


def adapter(kind: Any) -> TypeAdapter[Any]:
    """Validator and serialiser of ``kind``; built at first use, since that takes milliseconds."""
    if kind not in _adapters:
        _adapters[kind] = TypeAdapter(kind)
    return _adapters[kind]


def parse(kind: type[T], content: Any) -> T:
    """``content``, as read from JSON, as a ``kind``. Types are strict; raises InvalidInput naming the key."""
    try:
        found: T = adapter(kind).validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        raise InvalidInput(first_problem(error, kind)) from None
    return found


def load(kind: type[T], content: Any) -> T:
    """The value that :func:`dump` wrote as ``content``; raises InvalidInput naming the key."""
    try:
        found: T = adapter(kind).validate_python(content)
    except ValidationError as error:
        raise InvalidInput(first_problem(error, kind)) from None
    return found


def dump(kind: Any, value: Any) -> Any:
    """A value of ``kind`` as JSON."""
    return adapter(kind).dump_python(value, mode="json", by_alias=True)


def json_schema(kind: Any, mode: Literal["validation", "serialization"] = "validation") -> str:
    """The JSON Schema of what is read, or written, as a ``kind``, as a file of ``docs/schemas`` holds it."""
    schema = adapter(kind).json_schema(mode=mode)
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}, indent=2) + "\n"


# The fields of documents: what each means, and what the JSON Schema says of it.


def described(description: str, *, unit: str = "", group: str = "", title: str | None = None, **rules: Any) -> Any:
    """A field for ``Annotated``: its help, and what the JSON Schema says of it.

    Args:
        description: One sentence for users.
        unit: Of the number, empty for none.
        group: Fields of one group stand together in web forms.
        title: The label; the name of the field without it.
        rules: ``ge``, ``gt``, ``le`` and the other constraints of pydantic.
    """
    extra: dict[str, Any] = {key: text for key, text in (("unit", unit), ("group", group)) if text}
    return Field(description=description, title=title, json_schema_extra=extra or None, **rules)


# The types that fields of documents are made of.


def _moment(raw: object) -> object:
    at = datetime.fromisoformat(raw) if isinstance(raw, str) else raw
    if isinstance(at, datetime) and at.tzinfo is None:
        raise ValueError(f"{at} lacks its UTC offset")
    return at


def timestamp(at: datetime) -> str:
    """ISO 8601 with the UTC offset, to the millisecond."""
    return at.isoformat(timespec="milliseconds")


Moment = Annotated[
    datetime, BeforeValidator(_moment), PlainSerializer(datetime.isoformat, when_used="json-unless-none")
]
"""A time that a row is rebuilt from: ISO 8601 with its UTC offset, to the microsecond."""
Timestamp = Annotated[datetime, PlainSerializer(timestamp, when_used="json-unless-none")]
"""A time that is shown."""


def cut(length: int) -> Any:
    """Keeps as much of a text as its column holds."""
    return AfterValidator(lambda text: text if text is None else text[:length])


Values = dict[str, int | float | str | bool | tuple[int | float, ...]]
"""Values by name; a matrix is a list of numbers."""
RowNumber = Annotated[StrictInt, Field(ge=0, lt=2**31)]
Uid = Annotated[str, Field(pattern=r"\A[0-9a-f]{32}\z")]
ContentHash = Annotated[str, Field(pattern=r"\A[0-9a-f]{64}\z")]


Rules = Annotated[
    StopWhen,
    BeforeValidator(lambda raw: raw if isinstance(raw, StopWhen) else StopWhen.of(raw)),
    PlainSerializer(lambda rules: rules.content),
]
"""Only the rules that are set; None and unknown ones are no rules."""


def _disturbance(raw: Any) -> Any:
    try:
        return Disturbance.of(raw) if isinstance(raw, dict) else raw
    except (KeyError, TypeError) as error:
        raise ValueError(f"no disturbance: {error!r}") from None


FoundDisturbance = Annotated[Disturbance, BeforeValidator(_disturbance), PlainSerializer(lambda found: found.content)]


def _definitions(raw: Any) -> Any:
    """``[type, unit, general name]`` by key, from definitions or as read."""
    return {
        key: entry if isinstance(entry, list | tuple) else (entry.type, entry.unit, entry.general)
        for key, entry in raw.items()
    }


Definitions = Annotated[
    dict[str, tuple[ParameterType, str, str | None]],
    BeforeValidator(_definitions),
    Field(description="Type, unit and general name of each parameter."),
]


def defined(definitions: Definitions, values: Mapping[str, Value]) -> tuple[Parameter, ...]:
    """Definitions of the parameters with these values."""
    return tuple(
        Parameter(key, kind, values[key], "", unit, general=general)
        for key, (kind, unit, general) in definitions.items()
        if key in values
    )
