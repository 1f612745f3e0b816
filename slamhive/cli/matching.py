"""The fit of an algorithm and a dataset, on the command line."""

from __future__ import annotations

from collections.abc import Iterator

from slamhive.cli.output import print_table
from slamhive.cli.visible import say
from slamhive.schema.matching import Match, UsedSensor


def print_match(match: Match) -> None:
    """The sensor in each role, and the parameters that are taken from sensors."""
    rows = [
        (role, used.name, f"{used.rate_hz:g}", match.topics.get(role, used.topic), _others(used))
        for role, used in match.sensors.items()
    ]
    print_table(("role", "sensor", "Hz", "topic", "also fits"), rows, right=("Hz",))
    if match.parameters:
        print_table(("parameter", "value", "source"), list(bound_rows(match)))
    else:
        say("no parameter is taken from a sensor")


def _others(used: UsedSensor) -> str | None:
    return ", ".join(name for name in used.fitting if name != used.name) or None


def bound_rows(match: Match | None) -> Iterator[tuple[str, object, str]]:
    """Key, value and source of each parameter that is taken from a sensor."""
    for key, entry in ({} if match is None else match.parameters).items():
        yield key, list(entry.value) if isinstance(entry.value, tuple) else entry.value, entry.words
