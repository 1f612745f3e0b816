"""The fields of documents: what each means, and what the JSON Schema says of it."""

from __future__ import annotations

from typing import Any

from pydantic import Field


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
