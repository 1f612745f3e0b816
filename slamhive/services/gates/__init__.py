"""Gates: baselines of runs, and whether later runs became worse than those by more than chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.gates.baselines import Baselines, frozen_configuration
    from slamhive.services.gates.candidates import GateCheck, Pair
    from slamhive.services.gates.checking import compared, good_values
    from slamhive.services.gates.measuring import measured_runs
    from slamhive.services.gates.pairing import pairing_key
    from slamhive.services.gates.repeating import Repeats, repeat_until_decided
    from slamhive.services.gates.reporting import (
        METRIC_HEADS,
        VALUE_HEADS,
        answer_junit,
        answer_markdown,
        change_words,
        metric_row,
        p_words,
        value_rows,
    )
    from slamhive.services.gates.service import Gates

__all__ = [
    "METRIC_HEADS",
    "VALUE_HEADS",
    "Baselines",
    "GateCheck",
    "Gates",
    "Pair",
    "Repeats",
    "answer_junit",
    "answer_markdown",
    "change_words",
    "compared",
    "frozen_configuration",
    "good_values",
    "measured_runs",
    "metric_row",
    "p_words",
    "pairing_key",
    "repeat_until_decided",
    "value_rows",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
