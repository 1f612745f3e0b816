"""Files of the published SLAM Hive hold YAML among prose and other documents, with lines of dashes between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

_SEPARATOR = re.compile(r"-{3,}\s*$")

Part = tuple[int, int]
"""The first line of a part, from 0, and the line after its last."""


def parts_of(lines: Sequence[str]) -> list[Part]:
    """The parts between lines of dashes; an empty part has equal numbers."""
    dashes = [number for number, line in enumerate(lines) if _SEPARATOR.match(line)]
    return [(before + 1, after) for before, after in pairwise([-1, *dashes, len(lines)])]


def only(lines: Sequence[str], part: Part) -> str:
    """The text of one part. All other lines are empty, so that messages name the lines of the file."""
    first, last = part
    return "\n".join(line if first <= number < last else "" for number, line in enumerate(lines))
