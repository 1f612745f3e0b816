"""JSON documents from typed values and back, for every kind of document alike."""

from __future__ import annotations

import json
from typing import Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from slamhive.errors import InvalidInput
from slamhive.schema.validation import first_problem

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
    """What validates and serialises ``kind``; built at first use, since that takes milliseconds."""
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
