"""The web forms of imports: their fields, from the one definition of the requests, and what was typed into them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from werkzeug.datastructures import MultiDict

from slamhive.base.errors import InvalidInput
from slamhive.documents.imports import (
    AlgorithmOnServer,
    AlgorithmUpload,
    DatasetOnServer,
    DatasetUpload,
    PackageFacts,
    RecordingFacts,
)
from slamhive.documents.model import dump, json_schema, parse
from slamhive.recordings.importing import read_topics

_FLAG = re.compile(r"--([a-z][a-z-]*)(?: (?:NAME|FILE)(?:\.tar)?)?")
_OTHER_NAMES = {"topic": "topics", "depth_units": "depth_units_per_m", "frame_rate": "frame_rate_hz"}
"""Options of the command line whose field has another name."""
TABLE = "table"
LINES = "lines"

Asked = TypeVar("Asked", DatasetUpload, DatasetOnServer, AlgorithmUpload, AlgorithmOnServer)


@dataclass(frozen=True, slots=True)
class ImportField:
    """One field of a web form.

    ``kind`` is ``text``, ``number``, ``switch``, ``lines`` (one entry a line) or ``table`` (SENSOR=TOPIC, one a line).
    """

    name: str
    label: str
    help: str
    kind: str
    choices: tuple[str, ...] = ()


@cache
def import_fields(model: Any) -> tuple[ImportField, ...]:
    """The fields of a request, or of the facts that several requests share."""
    schema = json.loads(json_schema(model))
    kinds = {
        "number": "number", "boolean": "switch", "array": LINES, "object": TABLE,
    }  # fmt: skip
    fields = []
    for name, entry in schema["properties"].items():
        value = next(part for part in entry.get("anyOf", [entry]) if part.get("type") != "null")
        choices = schema.get("$defs", {}).get(value.get("$ref", "").rpartition("/")[2], {}).get("enum", ())
        unit = f" [{entry['unit']}]" if entry.get("unit") else ""
        words = entry.get("description", "").replace("null:", "empty:")
        kind = kinds.get(value.get("type", "string"), "text")
        fields.append(ImportField(name, entry.get("title", name) + unit, words, kind, tuple(choices)))
    return tuple(fields)


def read_import(model: type[Asked], form: MultiDict[str, str]) -> Asked:
    """The request that a web form makes; an empty field has its default. Raises InvalidInput naming the field."""
    content: dict[str, Any] = {}
    for field in import_fields(model):
        lines = [line.strip() for text in form.getlist(field.name) for line in text.splitlines() if line.strip()]
        if not lines:
            continue
        if field.kind == LINES:
            content[field.name] = lines
        elif field.kind == TABLE:
            content[field.name] = read_topics(lines)
        elif field.kind == "switch":
            content[field.name] = True
        elif field.kind == "number":
            content[field.name] = _number(field, lines[0])
        else:
            content[field.name] = lines[0]
    for name in json.loads(json_schema(model)).get("required", ()):
        if name not in content:
            raise InvalidInput("nothing is chosen to import", "choose a file, or type the path of one")
    return parse(model, content)


def typed(request: Any) -> dict[str, str]:
    """What a form has to hold for the request, by name of the field."""
    model: Any = type(request)
    content = dump(model, request)
    found = {}
    for field in import_fields(model):
        value = content[field.name]
        if field.kind == TABLE:
            found[field.name] = "\n".join(f"{key}={entry}" for key, entry in value.items())
        elif field.kind == LINES:
            found[field.name] = "\n".join(value)
        elif field.kind == "switch":
            found[field.name] = "yes" if value else ""
        else:
            found[field.name] = "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return found


def without_flags(text: str) -> str:
    """A message in which options of the command line are called as the fields of the form are."""
    labels = {
        field.name: field.label
        for model in (DatasetOnServer, AlgorithmOnServer)
        for field in import_fields(model)
        if field.name != "name"
    }

    def label(found: re.Match[str]) -> str:
        name = found[1].replace("-", "_")
        name = _OTHER_NAMES.get(name, name)
        return "name" if name == "name" else f"“{labels[name]}”" if name in labels else found[0]

    return _FLAG.sub(label, text)


def _number(field: ImportField, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"{field.label}: {text[:40]!r} is not a number", "write for instance 5000") from None


FACTS: Mapping[str, Any] = {"dataset": RecordingFacts, "algorithm": PackageFacts}
