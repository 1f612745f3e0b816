"""Which configuration of a baseline a run belongs to. The version of the package is what may differ."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from slamhive.domain.parameters import Value
from slamhive.schema.gate import BaselineConfiguration
from slamhive.schema.record import ConfigurationContent

_ALIKE = ("algorithm", "dataset", "playback", "variant", "sensors")
_MOST_NAMED = 3


def pairing_key(content: ConfigurationContent) -> str:
    """What configurations that differ in their version alone have in common."""
    return replace(content.configuration, version=None).content_hash


def find_pair(
    held: Sequence[BaselineConfiguration], found: ConfigurationContent, ignored: Collection[str] = ()
) -> int | str:
    """The place in ``held`` of the configuration that ``found`` is compared with, or why there is none.

    A parameter that only one of them has was added to the package or removed from it, and does not count. Neither do
    the parameters ``ignored``.
    """
    alike = [place for place, entry in enumerate(held) if _alike(entry, found)]
    fitting = [place for place in alike if not _differences(held[place], found, ignored)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        return f"fits {len(fitting)} configurations of the baseline"
    if not alike:
        return "no such configuration is in the baseline"
    fewest = min((_differences(held[place], found, ignored) for place in alike), key=len)
    more = f" and {len(fewest) - _MOST_NAMED} more" if len(fewest) > _MOST_NAMED else ""
    return f"differs from the baseline in {', '.join(fewest[:_MOST_NAMED])}{more}"


def _alike(held: ConfigurationContent, found: ConfigurationContent) -> bool:
    """Whether all but the parameters is equal."""
    maps = [None if entry.map is None else entry.map.content for entry in (held, found)]
    return maps[0] == maps[1] and all(getattr(held, name) == getattr(found, name) for name in _ALIKE)


def _differences(held: ConfigurationContent, found: ConfigurationContent, ignored: Collection[str]) -> list[str]:
    """The parameters in which they differ, with both values."""
    common = [key for key in found.parameters if key in held.parameters and key not in ignored]
    return [
        f"{key} ({_text(held.parameters[key])}, here {_text(found.parameters[key])})"
        for key in common
        if held.parameters[key] != found.parameters[key]
    ]


def _text(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
