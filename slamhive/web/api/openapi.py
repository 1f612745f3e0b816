"""The OpenAPI description (3.1) of the table of operations. pydantic writes the schemas of all models."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, TypeAlias

from pydantic import TypeAdapter
from pydantic.json_schema import JsonSchemaMode

from slamhive import __version__
from slamhive.documents.api_answers import ProblemDocument
from slamhive.documents.imports import OCTETS
from slamhive.documents.model import adapter
from slamhive.web.api.idempotency import KEY_HEADER
from slamhive.web.api.operation import PREFIX, ApiOperation, Argument, ArgumentPlace, Bytes, Table
from slamhive.web.security import API_HEADER

Schemas: TypeAlias = Mapping[tuple[Any, JsonSchemaMode], dict[str, Any]]
"""The schema of a model as it is read (validation) or written (serialization)."""

_REFERENCES = "#/components/schemas/{model}"
_RESPONSES = "#/components/responses/"
_SCHEME = "bearer"
_JSON = "application/json"
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
        entry = _operation(operation, table.places, schemas)
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


def _operation(operation: ApiOperation, places: Mapping[str, ArgumentPlace], schemas: Schemas) -> dict[str, Any]:
    changes = operation.method == "POST"
    parameters = [_place(name, places[name]) for name in operation.places]
    parameters += [_argument(entry) for entry in operation.arguments]
    parameters += _change_headers(once=operation.once) if changes else []
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


def _argument(argument: Argument) -> dict[str, Any]:
    schema = {"type": "array", "items": argument.schema} if argument.many else dict(argument.schema)
    return {
        "name": argument.name,
        "in": "query",
        "required": argument.required,
        "description": argument.help,
        "schema": schema,
    }


def _change_headers(*, once: bool) -> list[dict[str, Any]]:
    ours = {
        "name": API_HEADER,
        "in": "header",
        "required": False,
        "description": "Needed unless an API token is sent. A page of another site cannot send it.",
        "schema": {"type": "string", "const": "1"},
    }
    key = {
        "name": KEY_HEADER,
        "in": "header",
        "required": False,
        "description": "A key of your own, unique for each change. A repetition answers as the first request did.",
        "schema": {"type": "string", "minLength": 1, "maxLength": 255, "pattern": "^[!-~]+$"},
    }
    return [ours, key] if once else [ours]


def _body(kind: Any, schemas: Schemas) -> dict[str, Any]:
    if isinstance(kind, Bytes):
        return {"required": True, "content": {OCTETS: {}}, "description": f"At most {kind.most_bytes:,} bytes."}
    return {"required": True, "content": {_JSON: {"schema": schemas[kind, "validation"]}}}


def _problems(schemas: Schemas) -> dict[str, Any]:
    content = {_PROBLEM: {"schema": schemas[ProblemDocument, "serialization"]}}
    return {name: {"description": words, "content": content} for name, words in _PROBLEMS.values()}
