"""Text about configurations: names, notes and conditions that users type, and records as JSON."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from slamhive.domain.variant import variant_to_json
from slamhive.errors import InvalidInput
from slamhive.services.json_values import plain, timestamp
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


def configuration_to_json(record: ConfigurationRecord) -> dict[str, Any]:
    """A configuration with its name, note and groups. ``parameters``: {key: value, type, unit, general name}."""
    content = record.configuration
    return {
        "id": record.id,
        "name": record.name,
        "note": record.note,
        "groups": list(record.groups),
        "algorithm": content.algorithm,
        "dataset": content.dataset,
        "parameters": {
            key: {
                "value": plain(value),
                "type": record.parameters[key].type,
                "unit": record.parameters[key].unit,
                "general": record.parameters[key].general,
            }
            for key, value in content.parameters.items()
        },
        "variant": variant_to_json(content.variant),
        "playback": {"mode": content.playback.mode.value, "rate": content.playback.rate},
        "content_hash": content.content_hash,
        "created_at": timestamp(record.created_at),
        "runs": record.runs,
        "experiments": list(record.experiments),
    }
