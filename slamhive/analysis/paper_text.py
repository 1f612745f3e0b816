"""Finds the one analysis in a published file that also holds prose and other documents."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise

from slamhive.errors import InvalidInput
from slamhive.foreign.documents import Part, only, parts_of

MARK = "evaluation_form"
"""The key that identifies a file of the published system."""

_TOP_KEY = re.compile(r"(group_name|group_description|evaluation_form|configuration_choose|is_visualized|ids)\s*:")


def only_analysis(text: str, source: str) -> str:
    """The one analysis in a text that may also hold prose and other documents, which become empty lines.

    Published files have prose before the first key, lines of dashes between documents, and sometimes two analyses, each
    with its ``group_name``. Raises InvalidInput if there are two analyses, with the line of the second.
    """
    lines = text.split("\n")
    found = [part for whole in parts_of(lines) for part in _split_at_names(lines, whole)]
    holding = [part for part in found if any(line.startswith(f"{MARK}:") for line in lines[slice(*part)])]
    if len(holding) > 1:
        raise InvalidInput(
            f"{source}, line {holding[1][0] + 1}: a second analysis begins", "give each a file of its own"
        )
    if not holding:
        return text
    first, last = holding[0]
    while not _TOP_KEY.match(lines[first]):
        first += 1
    return only(lines, (first, last))


def _split_at_names(lines: Sequence[str], part: Part) -> Iterator[Part]:
    """A part, cut before each ``group_name`` after the first one."""
    named = [number for number in range(*part) if lines[number].startswith("group_name:")]
    yield from pairwise([part[0], *named[1:], part[1]])
