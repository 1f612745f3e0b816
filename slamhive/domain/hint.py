"""A hint: a common mistake that an evaluation has found behind a large error, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Hint:
    """One likely mistake, or a doubt that a path leaves.

    Attributes:
        key: Names the mistake: ``quaternion_order``, ``inverse_poses``, ...
        sentence: What was found, with the numbers that show it.
        remedy: What to do.
    """

    key: str
    sentence: str
    remedy: str


def hints_from_json(content: Iterable[Mapping[str, Any]]) -> tuple[Hint, ...]:
    """The hints in a ``result.json``; raises TypeError or KeyError for anything else."""
    return tuple(Hint(str(entry["key"]), str(entry["sentence"]), str(entry["remedy"])) for entry in content)
