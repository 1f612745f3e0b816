"""The description of the web API: OpenAPI for programs, and a page for people."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

from flask import Blueprint, Response, render_template
from pydantic import TypeAdapter
from pydantic.json_schema import JsonSchemaMode

from slamhive import __version__
from slamhive.documents.api import ProblemDocument
from slamhive.documents.imports import OCTETS
from slamhive.documents.model import adapter
from slamhive.web.api import TABLE
from slamhive.web.api.operation import KEY_HEADER, PREFIX, ApiOperation, ArgumentPlace, Bytes, Table
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
            status, success = next(iter(entry["responses"].items()))
            body = entry.get("requestBody")
            found[entry["tags"][0]].append(
                ShownOperation(
                    name=entry["operationId"],
                    method=method.upper(),
                    path=path,
                    summary=entry["summary"],
                    words=entry["description"],
                    arguments=tuple(
                        FieldRow(
                            argument["name"], _type(argument["schema"]), argument["description"], argument["required"]
                        )
                        for argument in entry["parameters"]
                        if argument["in"] != "header"
                    ),
                    body=None if body is None else _content(body["content"]),
                    status=status,
                    answer=_content(success["content"]),
                )
            )
    return found


def models_of(described: Mapping[str, Any]) -> list[ShownModel]:
    """All models by name."""
    return [_model(name, schema) for name, schema in described["components"]["schemas"].items()]


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


# -- the OpenAPI description (3.1); pydantic writes the schemas of all models ------------------------------------------

Schemas: TypeAlias = Mapping[tuple[Any, JsonSchemaMode], dict[str, Any]]
"""The schema of a model as it is read (validation) or written (serialization)."""

_REFERENCES = "#/components/schemas/{model}"
_RESPONSES = "#/components/responses/"
_SCHEME = "bearer"
_PROBLEM = "application/problem+json"
_PROBLEMS = {
    "400": ("InvalidInput", "A value that cannot be used."),
    "401": ("Unauthenticated", "Sign-in required: sign in, or send an API token."),
    "403": ("Forbidden", "The server is view-only, or the caller may not do this."),
    "404": ("NotFound", "Nothing has this name or number."),
    "409": ("Conflict", "The present state does not allow it."),
    "413": ("TooLarge", "The body is too large."),
    "429": ("TooManyRequests", "Try again later."),
    "503": ("Unavailable", "Something that is needed does not answer now."),
}
_ALWAYS = ("400", "401", "403", "404", "503")
_CHANGES = ("409", "413", "429")
_DESCRIPTION = (
    "Everything that the pages of SLAM Hive can do. Changes are POST only, and need the header "
    f"`{API_HEADER}: 1` or an API token. With an `{KEY_HEADER}` they are done once, however often they are sent. "
    "Answers to GET have an ETag. Lists come in pages; `next` is the address of the next one."
)


@cache
def description(table: Table) -> dict[str, Any]:
    """The whole description, made once: the table does not change."""
    schemas, definitions = _schemas(table.operations)
    paths: dict[str, dict[str, Any]] = {}
    for operation in table.operations:
        entry = _described(operation, table.places, schemas)
        paths.setdefault(PREFIX + operation.path, {})[operation.method.lower()] = entry
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "SLAM Hive",
            "version": __version__,
            "description": _DESCRIPTION,
            "license": {"name": "GPL-3.0-or-later", "identifier": "GPL-3.0-or-later"},
        },
        "servers": [{"url": "/"}],
        "tags": [{"name": section} for section in dict.fromkeys(entry.section for entry in table.operations)],
        "paths": paths,
        "security": [{}, {_SCHEME: []}],
        "components": {
            "schemas": definitions,
            "responses": _problems(schemas),
            "securitySchemes": {
                _SCHEME: {
                    "type": "http",
                    "scheme": _SCHEME,
                    "description": "An API token, where callers have accounts.",
                }
            },
        },
    }


def _schemas(operations: Iterable[ApiOperation]) -> tuple[Schemas, dict[str, Any]]:
    """The schema of each model by (model, mode), and the definitions that they refer to."""
    kinds: dict[tuple[Any, JsonSchemaMode], TypeAdapter[Any]] = {
        (ProblemDocument, "serialization"): adapter(ProblemDocument)
    }
    for operation in operations:
        if operation.body is not None and not isinstance(operation.body, Bytes):
            kinds[operation.body, "validation"] = adapter(operation.body)
        if not isinstance(operation.answer, tuple):
            kinds[operation.answer, "serialization"] = adapter(operation.answer)
    inputs = [(kind, mode, found) for (kind, mode), found in kinds.items()]
    schemas, definitions = TypeAdapter.json_schemas(inputs, ref_template=_REFERENCES)
    return schemas, dict(sorted(definitions.get("$defs", {}).items()))


def _described(operation: ApiOperation, places: Mapping[str, ArgumentPlace], schemas: Schemas) -> dict[str, Any]:
    changes = operation.method == "POST"
    parameters = [_place(name, places[name]) for name in operation.places]
    for argument in operation.arguments:
        schema = {"type": "array", "items": argument.schema} if argument.many else dict(argument.schema)
        parameters.append(
            {
                "name": argument.name,
                "in": "query",
                "required": argument.required,
                "description": argument.help,
                "schema": schema,
            }
        )
    if changes:
        parameters.append(
            {
                "name": API_HEADER,
                "in": "header",
                "required": False,
                "description": "Needed unless an API token is sent. A page of another site cannot send it.",
                "schema": {"type": "string", "const": "1"},
            }
        )
    if changes and operation.once:
        parameters.append(
            {
                "name": KEY_HEADER,
                "in": "header",
                "required": False,
                "description": "A key of your own, unique for each change. "
                "A repetition answers as the first request did.",
                "schema": {"type": "string", "minLength": 1, "maxLength": 255, "pattern": "^[!-~]+$"},
            }
        )

    body = {} if operation.body is None else {"requestBody": _body(operation.body, schemas)}
    problems = (*_ALWAYS, *(_CHANGES if changes else ()))
    return {
        "operationId": operation.name,
        "tags": [operation.section],
        "summary": operation.summary,
        "description": re.sub(r"\s+", " ", operation.words),
        "parameters": parameters,
        **body,
        "responses": {
            str(operation.status): _success(operation, schemas),
            **({} if changes else {"304": {"description": "Unchanged since the `If-None-Match` that was sent."}}),
            **{status: {"$ref": _RESPONSES + _PROBLEMS[status][0]} for status in sorted(problems)},
        },
    }


def _success(operation: ApiOperation, schemas: Schemas) -> dict[str, Any]:
    if isinstance(operation.answer, tuple):
        return {"description": "The file.", "content": {kind: {} for kind in operation.answer}}
    kind = operation.answer
    said = (kind.__doc__ or "").partition("\n")[0]
    return {"description": said, "content": {_JSON: {"schema": schemas[kind, "serialization"]}}}


def _place(name: str, place: ArgumentPlace) -> dict[str, Any]:
    return {"name": name, "in": "path", "required": True, "description": place.help, "schema": dict(place.schema)}


def _body(kind: Any, schemas: Schemas) -> dict[str, Any]:
    if isinstance(kind, Bytes):
        return {"required": True, "content": {OCTETS: {}}, "description": f"At most {kind.most_bytes:,} bytes."}
    return {"required": True, "content": {_JSON: {"schema": schemas[kind, "validation"]}}}


def _problems(schemas: Schemas) -> dict[str, Any]:
    content = {_PROBLEM: {"schema": schemas[ProblemDocument, "serialization"]}}
    return {name: {"description": words, "content": content} for name, words in _PROBLEMS.values()}
