"""The description of the web API: OpenAPI for programs, and a page for people."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from flask import Blueprint, Response, render_template

from slamhive.web.api import TABLE
from slamhive.web.api.openapi import description
from slamhive.web.security import API_HEADER

blueprint = Blueprint("api_docs", __name__, url_prefix="/api")

_JSON = "application/json"
_NAMES = {"integer": "whole number", "object": "keys with values", "array": "list"}


@blueprint.get("/openapi.json")
def openapi() -> Response:
    """The OpenAPI description (3.1)."""
    return Response(_text(), mimetype="application/json")


@blueprint.get("/docs")
def page() -> str:
    """Every operation and every model, from the same description."""
    described = description(TABLE)
    return render_template(
        "api/docs.html",
        info=described["info"],
        sections=sections_of(described),
        models=models_of(described),
        header=API_HEADER,
    )


@cache
def _text() -> str:
    return json.dumps(description(TABLE), indent=1)


# -- the description as rows of the page -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Type:
    """A type in words; ``model`` is the model that it is made of, for a link."""

    words: str
    model: str | None = None


@dataclass(frozen=True, slots=True)
class FieldRow:
    """An argument, or a field of a model."""

    name: str
    type: Type
    help: str
    required: bool


@dataclass(frozen=True, slots=True)
class ShownOperation:
    """One operation. ``answer`` is a model, or the media types of a file."""

    name: str
    method: str
    path: str
    summary: str
    words: str
    arguments: tuple[FieldRow, ...]
    body: Type | None
    status: str
    answer: Type


@dataclass(frozen=True, slots=True)
class ShownModel:
    """One model with its fields; ``type`` is for a model without fields."""

    name: str
    help: str
    fields: tuple[FieldRow, ...]
    type: Type


def sections_of(described: Mapping[str, Any]) -> dict[str, list[ShownOperation]]:
    """The operations by section."""
    found: dict[str, list[ShownOperation]] = {entry["name"]: [] for entry in described["tags"]}
    for path, methods in described["paths"].items():
        for method, entry in methods.items():
            found[entry["tags"][0]].append(_operation(path, method.upper(), entry))
    return found


def models_of(described: Mapping[str, Any]) -> list[ShownModel]:
    """All models by name."""
    return [_model(name, schema) for name, schema in described["components"]["schemas"].items()]


def _operation(path: str, method: str, entry: Mapping[str, Any]) -> ShownOperation:
    status, success = next(iter(entry["responses"].items()))
    body = entry.get("requestBody")
    return ShownOperation(
        name=entry["operationId"],
        method=method,
        path=path,
        summary=entry["summary"],
        words=entry["description"],
        arguments=tuple(
            FieldRow(argument["name"], _type(argument["schema"]), argument["description"], argument["required"])
            for argument in entry["parameters"]
            if argument["in"] != "header"
        ),
        body=None if body is None else _content(body["content"]),
        status=status,
        answer=_content(success["content"]),
    )


def _content(content: Mapping[str, Any]) -> Type:
    """A model for JSON; the media types of anything else."""
    return _type(content[_JSON]["schema"]) if "schema" in content.get(_JSON, {}) else Type(", ".join(content))


def _model(name: str, schema: Mapping[str, Any]) -> ShownModel:
    required = schema.get("required", ())
    fields = tuple(
        FieldRow(key, _type(entry), entry.get("description", ""), key in required)
        for key, entry in schema.get("properties", {}).items()
    )
    return ShownModel(name, schema.get("description", ""), fields, _type(schema))


def _type(schema: Mapping[str, Any]) -> Type:
    """A type in words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return Type(name, name)
    choices = schema.get("anyOf") or schema.get("oneOf")
    if choices:
        types = [_type(choice) for choice in choices]
        return Type(
            " or ".join(entry.words for entry in types), next((entry.model for entry in types if entry.model), None)
        )
    inner = schema.get("items") if schema.get("type") == "array" else schema.get("additionalProperties")
    if not isinstance(inner, Mapping):
        return Type(_plain(schema))
    entry = _type(inner)
    return Type(f"list of {entry.words}" if schema["type"] == "array" else f"{entry.words} by name", entry.model)


def _plain(schema: Mapping[str, Any]) -> str:
    """A type that is made of no other."""
    if "const" in schema:
        return f"“{schema['const']}”"
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    kinds: str | list[str] = schema.get("type", "any value")
    names = [_NAMES.get(kind, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds)]
    return " or ".join(names) + _range(schema)


def _range(schema: Mapping[str, Any]) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    if low is None and high is None:
        return ""
    return f", {low} to {high}" if None not in (low, high) else f", from {low}" if high is None else f", to {high}"
