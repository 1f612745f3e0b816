"""``--id``: what names and numbers in files of the published SLAM Hive mean here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.packages.published.knowledge import HERE


def _read(_context: click.Context, _parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, str]:
    found: dict[str, str] = {}
    for text in texts:
        old, sign, new = (HERE, "=", HERE) if text == HERE else (part.strip() for part in text.partition("="))
        if not (old and sign and new):
            raise InvalidInput(f"--id {text!r} is not OLD=NEW", "write for instance --id 3=orb-slam2-mono")
        if found.setdefault(old, new) != new:
            raise InvalidInput(f"--id {old} is given as {found[old]} and as {new}", "give it once")
    return found


id_option: Callable[..., Any] = click.option(
    "--id",
    "ids",
    metavar="OLD=NEW",
    multiple=True,
    callback=_read,
    help="What a number or a name in a file of the published SLAM Hive means here, for instance 3=orb-slam2-mono; "
    "'here': its numbers are those of this installation. Can be given several times.",
)
