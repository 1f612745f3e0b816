"""Numpy arrays in JSON, and dataclasses that name their type there."""

from __future__ import annotations

import base64
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, PlainSerializer, PlainValidator, WithJsonSchema

_KIND = "array"


def _write(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return list(value)
    whole = np.issubdtype(value.dtype, np.integer)
    wanted = np.ascontiguousarray(value, dtype="<i8" if whole else "<f8")
    data = base64.b64encode(wanted.tobytes()).decode()
    return {"is": _KIND, "dtype": wanted.dtype.str, "shape": value.shape, "data": data}


def _read(content: Any) -> Any:
    if not isinstance(content, dict):
        return content if isinstance(content, np.ndarray) else tuple(content)
    try:
        data = np.frombuffer(base64.b64decode(content["data"], validate=True), dtype=np.dtype(content["dtype"]))
        return data.reshape(content["shape"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"no array: {error!r}") from None


Array = Annotated[
    np.ndarray[Any, np.dtype[Any]],
    PlainValidator(_read),
    PlainSerializer(_write),
    WithJsonSchema(
        {
            "type": "object",
            "description": "An array: its numbers in base64, little-endian.",
            "properties": {
                "is": {"const": _KIND},
                "dtype": {"enum": ["<i8", "<f8"]},
                "shape": {"type": "array", "items": {"type": "integer"}},
                "data": {"type": "string"},
            },
            "required": ["is", "dtype", "shape", "data"],
        }
    ),
]
"""Whole numbers of 64 bits, or double precision. A plug-in may have a list in its place."""


Name = TypeVar("Name")
Kind = Annotated[Name, Field(alias="is")]
"""The name of a dataclass in JSON, by which the members of a union are told apart. It is no argument of its own."""
