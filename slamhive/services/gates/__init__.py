"""Gates: baselines of runs, and whether later runs became worse than those by more than chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.gates.baselines import Baselines
    from slamhive.services.gates.candidates import GateCheck
    from slamhive.services.gates.repeating import Repeats, repeat_until_decided
    from slamhive.services.gates.reporting import (
        METRIC_HEADS,
        VALUE_HEADS,
        answer_junit,
        answer_markdown,
        metric_row,
        value_rows,
    )
    from slamhive.services.gates.service import Gates

__all__ = [
    "METRIC_HEADS",
    "VALUE_HEADS",
    "Baselines",
    "GateCheck",
    "Gates",
    "Repeats",
    "answer_junit",
    "answer_markdown",
    "metric_row",
    "repeat_until_decided",
    "value_rows",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
