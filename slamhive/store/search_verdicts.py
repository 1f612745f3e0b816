"""Comparisons of the verdict as comparisons of the state of a run and of the stored verdict."""

from __future__ import annotations

from slamhive.domain.run import RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.search.binding import Bound, Condition
from slamhive.search.fields import BUILT_IN, Field, Kind, Source
from slamhive.search.grammar import join
from slamhive.search.syntax import Sign
from slamhive.store.metrics import VERDICT
from slamhive.store.verdicts import CODES

_STORED = Field(VERDICT, "stored verdict", Kind.NUMBER, Source.METRIC)
STORED_FAILURE = Condition(_STORED, Sign.MORE, (CODES[VerdictKind.GOOD],))
"""Runs that succeeded and failed by their verdict."""


def verdict_tree(leaf: Condition) -> Bound:
    """The condition behind ``leaf``, which names kinds of verdicts."""
    kinds = list(VerdictKind) if leaf.sign is Sign.HAS else [VerdictKind(str(value)) for value in leaf.values]
    codes = tuple(CODES[kind] for kind in kinds if kind in CODES)
    parts: list[Bound] = [Condition(_STORED, Sign.IN, codes)] if codes else []
    if VerdictKind.ENDED_BADLY in kinds:
        parts.append(Condition(BUILT_IN["state"], Sign.EQUAL, (RunState.FAILED.value,)))
    return join("or", parts) if parts else Condition(_STORED, Sign.IN, ())
