"""JSON documents from typed values and back, for every kind of document alike."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, Literal, Self, TypeVar

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

from slamhive.base.errors import InvalidInput
from slamhive.documents.limits import StopWhen
from slamhive.documents.validation import first_problem
from slamhive.domain.parameters import Parameter, ParameterType, Value
from slamhive.domain.trust import Disturbance

T = TypeVar("T")


class Document(BaseModel):
    """A JSON document. Its fields are read from the attributes of a record, or from JSON."""

    model_config = ConfigDict(frozen=True, from_attributes=True, populate_by_name=True, defer_build=True)

    @classmethod
    def of(cls, record: object, **more: Any) -> Self:
        """The document of a record. ``more`` are fields that the record does not have."""
        return cls.model_validate({**_attributes(cls, record), **more} if more else record)

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


def _attributes(kind: type[Document], record: object) -> dict[str, Any]:
    """The attributes of ``record`` that ``kind`` has fields for."""
    found = {}
    for name, field in kind.model_fields.items():
        keys = (*getattr(field.validation_alias, "choices", ()), name)  # in the order in which pydantic tries them
        key = next((key for key in keys if hasattr(record, key)), None)
        if key is not None:
            found[name] = getattr(record, key)
    return found


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


def _rules(raw: Any) -> Any:
    return raw if isinstance(raw, StopWhen) else StopWhen.of(raw)


Rules = Annotated[StopWhen, BeforeValidator(_rules), PlainSerializer(lambda rules: rules.content)]
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
