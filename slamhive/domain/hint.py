"""A hint: a common mistake that an evaluation has found behind a large error, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
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


def hints_to_json(hints: Iterable[Hint]) -> list[dict[str, str]]:
    """As results, the command line and the web API have them."""
    return [asdict(hint) for hint in hints]


def hints_from_json(content: Iterable[Mapping[str, Any]]) -> tuple[Hint, ...]:
    """What :func:`hints_to_json` wrote; raises TypeError or KeyError for anything else."""
    return tuple(Hint(str(entry["key"]), str(entry["sentence"]), str(entry["remedy"])) for entry in content)
