"""Text about configurations: names, notes and conditions that users type, and records as JSON."""

from __future__ import annotations

import re
from collections.abc import Iterable

from slamhive.errors import InvalidInput
from slamhive.schema import catalogue as schema
from slamhive.store import ConfigurationRecord, ParameterCondition

LONGEST_NAME = 64
LONGEST_NOTE = 2000
_CONDITION = re.compile(r"([^<>=]+)(<=|>=|=|<|>)(.*)", re.DOTALL)


def check_label(kind: str, text: str, *, empty: bool = False) -> str:
    """Check the name of a configuration or group: one line of text that is not a number; raises InvalidInput."""
    name = text.strip()
    if empty and not name:
        return ""
    digits = name.isascii() and name.isdigit()
    if not name or len(name) > LONGEST_NAME or digits or not name.isprintable():
        raise InvalidInput(
            f"{kind} name {text[:80]!r} is not allowed",
            f"use one line of 1 to {LONGEST_NAME} characters that is not a number",
        )
    return name


def check_note(text: str) -> str:
    """Strip a note; raises InvalidInput if it is too long or has control characters."""
    note = "\n".join(line.rstrip() for line in text.strip().splitlines())
    if len(note) > LONGEST_NOTE or not note.replace("\n", "").replace("\t", "").isprintable():
        raise InvalidInput(f"note {text[:40]!r}... is not allowed", f"use text of at most {LONGEST_NOTE} characters")
    return note


def parse_conditions(texts: Iterable[str]) -> tuple[ParameterCondition, ...]:
    """Parse conditions such as ``features>=1000``; raises InvalidInput."""
    found = []
    for text in texts:
        match = _CONDITION.fullmatch(text.strip())
        if match is None or not match[1].strip() or not match[3].strip():
            raise InvalidInput(
                f"condition {text[:80]!r} is not NAME=VALUE, NAME<VALUE, NAME<=VALUE, NAME>VALUE or NAME>=VALUE",
                "for example features>=1000",
            )
        found.append(ParameterCondition(match[1].strip(), match[2], match[3].strip()))
    return tuple(found)


def configuration_document(record: ConfigurationRecord) -> schema.Configuration:
    """A configuration as JSON shows it: its content, the definitions of its parameters, and what users say about it."""
    content = record.configuration
    parameters = {
        key: schema.ParameterValue.of(record.parameters[key], value=value) for key, value in content.parameters.items()
    }
    said = {
        name: getattr(record, name) for name in ("id", "name", "note", "groups", "created_at", "runs", "experiments")
    }
    return schema.Configuration.of(content, parameters=parameters, **said)
