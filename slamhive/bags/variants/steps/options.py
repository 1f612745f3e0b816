"""How steps declare their options: pydantic fields that say what they mean, in which unit, within which range."""

from __future__ import annotations

from typing import Any

from pydantic import Field


def option(help_text: str, *, unit: str = "", default: Any = ..., **bounds: Any) -> Any:
    """A field of a step.

    Args:
        help_text: What it does, for forms and documentation.
        unit: The unit of the value, empty if it has none.
        default: Without one the option must be given.
        **bounds: pydantic's ``ge``, ``gt``, ``le``, ``lt``.
    """
    return Field(default, description=help_text, json_schema_extra={"unit": unit}, **bounds)
