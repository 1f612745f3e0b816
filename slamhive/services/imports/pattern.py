"""Path patterns such as ``<algorithm>/<dataset>/<trial>.txt``, which read fields from a file's path."""

from __future__ import annotations

import re
from collections.abc import Collection

from slamhive.errors import InvalidInput

FIELDS = ("algorithm", "dataset", "trial")
_FIELD = re.compile(r"<([^<>]*)>")


class PathPattern:
    """A pattern for paths below a folder: ``<field>`` reads a part, ``*`` matches anything within one part.

    Args:
        text: The pattern, with ``/`` between parts.
        fields: The allowed names.
        needed: The required names.

    Raises InvalidInput for an unknown field, one that is used twice or one that is missing.
    """

    def __init__(self, text: str, fields: Collection[str] = FIELDS, needed: Collection[str] = ()) -> None:
        self.text = text
        self.fields: list[str] = _FIELD.findall(text)
        for name in self.fields:
            if name not in fields:
                raise InvalidInput(
                    f"pattern {text!r} has an unknown field <{name}>",
                    f"fields are {', '.join(f'<{field}>' for field in fields)}",
                )
            if self.fields.count(name) > 1:
                raise InvalidInput(f"pattern {text!r} has the field <{name}> twice")
        missing = [name for name in needed if name not in self.fields]
        if missing:
            raise InvalidInput(
                f"pattern {text!r} lacks <{missing[0]}>", "for example <algorithm>/<dataset>/<trial>.txt"
            )
        if text.startswith("/") or ".." in text.split("/"):
            raise InvalidInput(f"pattern {text!r} leaves the folder", "give a path below it")
        self._expression = re.compile(_expression(text))

    def match(self, path: str) -> dict[str, str] | None:
        """The fields of ``path`` (relative, with ``/``); None if it does not match."""
        found = self._expression.fullmatch(path)
        return None if found is None else found.groupdict()


def _expression(text: str) -> str:
    parts = _FIELD.split(text)
    literal, names = parts[0::2], parts[1::2]
    expression = _literal(literal[0])
    for name, after in zip(names, literal[1:], strict=True):
        expression += f"(?P<{name}>[^/]+?){_literal(after)}"
    return expression


def _literal(text: str) -> str:
    return "[^/]*".join(re.escape(part) for part in text.split("*"))
