"""Gates: baselines of runs, and whether later runs became worse than those by more than chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.gates.baselines import (
        Baselines,
        GateCheck,
        RunPair,
        frozen_configuration,
        measured_runs,
        pairing_key,
    )
    from slamhive.services.gates.bisecting import Bisections, BisectRequest
    from slamhive.services.gates.checking import (
        METRIC_HEADS,
        VALUE_HEADS,
        Repeats,
        answer_junit,
        answer_markdown,
        change_words,
        compared,
        good_values,
        metric_row,
        p_words,
        repeat_until_decided,
        value_rows,
    )
    from slamhive.services.gates.service import Gates
    from slamhive.services.gates.shrinking import Shrinkings, ShrinkRequest
    from slamhive.services.gates.trials import searched_metric


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
