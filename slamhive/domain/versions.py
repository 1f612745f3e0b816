"""How users name a version of a package: ``aloam@2``."""

from __future__ import annotations

import re

from slamhive.errors import InvalidInput

VERSION_SIGN = "@"
"""Between the name of an algorithm or package and the number of a version: ``aloam@2``."""

_VERSIONED = re.compile(r"(?P<name>[^@]+)@(?P<number>[1-9][0-9]{0,8})", re.ASCII)


def version_label(name: str, number: int) -> str:
    """How users name a version: ``aloam@2``."""
    return f"{name}{VERSION_SIGN}{number}"


def split_version(text: str) -> tuple[str, int | None]:
    """``aloam@2`` as name and number of a version; None for a name alone. Raises InvalidInput for anything else."""
    if VERSION_SIGN not in text:
        return text, None
    found = _VERSIONED.fullmatch(text)
    if found is None:
        raise InvalidInput(f"{text!r} names no version", "write NAME@NUMBER, for example aloam@2")
    return found["name"], int(found["number"])
