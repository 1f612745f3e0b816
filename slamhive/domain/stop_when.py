"""When a run ends early: rules that a user states, for an experiment or for a single run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from slamhive.errors import InvalidInput, unknown

_WHOLE = frozenset({"memory_mb", "failures_of_configuration"})


@dataclass(frozen=True, slots=True)
class StopWhen:
    """When a run ends early; None never ends one.

    ``lost_tracking_s``: no pose for this long, in s of the recording. ``memory_mb``, ``time_s``: budgets of a run.
    ``failures_of_configuration``: a run is not started any more once its configuration has failed so often since the
    run was asked for.
    """

    lost_tracking_s: float | None = None
    memory_mb: int | None = None
    time_s: float | None = None
    failures_of_configuration: int | None = None

    def check(self) -> None:
        """Raise InvalidInput for a rule that cannot be meant."""
        for name, value in stop_when_to_json(self).items():
            if not (math.isfinite(value) and value > 0):
                raise InvalidInput(f"stop_when {name} {value:.10g} is not allowed", "use a number above 0")


NEVER = StopWhen()
"""No rule: the run ends by itself or at its limits."""

RULES = tuple(entry.name for entry in fields(StopWhen))


def stop_when_to_json(rules: StopWhen) -> dict[str, Any]:
    """The rules that are set, ``{}`` for none."""
    return {name: value for name in RULES if (value := getattr(rules, name)) is not None}


def stop_when_from_json(content: Mapping[str, Any] | None) -> StopWhen:
    """The rules that :func:`stop_when_to_json` wrote; None, as an absent column or key gives, is no rule."""
    return StopWhen(**(content or {}))


def parse_stop_when(texts: Sequence[str]) -> StopWhen:
    """The rules written as ``RULE=NUMBER``; raises NotFound or InvalidInput naming the text."""
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        if not equals:
            raise InvalidInput(f"stop rule {text!r} is not clear", f"write RULE=NUMBER, e.g. {RULES[0]}=5")
        if name not in RULES:
            raise unknown("stop rule", name, list(RULES), f"use one of {', '.join(RULES)}")
        if name in values:
            raise InvalidInput(f"stop rule {name} is given twice", "give it once")
        try:
            values[name] = int(number) if name in _WHOLE else float(number)
        except ValueError:
            kind = "a whole number" if name in _WHOLE else "a number"
            raise InvalidInput(f"stop rule {name}={number!r} is not allowed", f"use {kind} above 0") from None
    rules = StopWhen(**values)
    rules.check()
    return rules
