"""How far the measurements of a run can be trusted: one rule for lists, pages, filters, JSON and commands.

Trust is not the outcome. A run that dropped most of its frames because it had too little CPU has succeeded, but its
error is not that of the algorithm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from slamhive.domain.disturbance import Disturbance, DisturbanceKind

DROPPED_FRAMES = "frames.dropped_fraction"
PLAYER_LAG = "playback.lag_max"
CPU_LIMIT_USED = "cpu.limit_used"
DISTURBED = "disturbed"
"""The kind of the reason for a run on a disturbed machine."""


class TrustLevel(StrEnum):
    """How far the measurements can be trusted."""

    HIGH = "high"
    LIMITED = "limited"
    LOW = "low"


@dataclass(frozen=True, slots=True)
class TrustLimit:
    """From where on a metric limits the trust.

    Attributes:
        metric: Its key.
        limited_above: Above this value the trust is limited.
        low_above: Above this value it is low; None if the metric alone never makes it low.
        realtime_only: It says nothing where playback waits for the algorithm.
        words: What happened, with the ``{value}`` in its unit or in ``{percent}``.
        remedy: What to do about it.
    """

    metric: str
    limited_above: float
    low_above: float | None
    realtime_only: bool
    words: str
    remedy: str

    def level(self, value: float) -> TrustLevel:
        """The trust that this value leaves."""
        if self.low_above is not None and value > self.low_above:
            return TrustLevel.LOW
        return TrustLevel.LIMITED if value > self.limited_above else TrustLevel.HIGH


LIMITS = (
    TrustLimit(
        DROPPED_FRAMES,
        limited_above=0.05,
        low_above=0.25,
        realtime_only=False,
        words="the algorithm was too slow for {percent:.0f} % of the frames, which were dropped",
        remedy="give it more CPU cores or a lower playback rate, or play sequentially",
    ),
    TrustLimit(
        PLAYER_LAG,
        limited_above=0.5,
        low_above=2.0,
        realtime_only=False,
        words="the player was up to {value:.2g} s late",
        remedy="use a faster disk or a lower playback rate, or play sequentially",
    ),
    TrustLimit(
        CPU_LIMIT_USED,
        limited_above=0.9,
        low_above=None,
        realtime_only=True,
        words="the run used {percent:.0f} % of the CPU time that its limit allows",
        remedy="raise the limit of CPU cores",
    ),
)
"""The limits, the most important first. A disturbed machine limits the trust as well."""


@dataclass(frozen=True, slots=True)
class TrustReason:
    """One reason why the trust is not high, in words, and what to do about it."""

    kind: str
    level: TrustLevel
    words: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Trust:
    """How far a run can be trusted. ``level`` is None if too little was measured; ``not_measured`` says what."""

    level: TrustLevel | None
    reasons: tuple[TrustReason, ...] = ()
    not_measured: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """All reasons in one line, or what was not measured."""
        return "; ".join([reason.words for reason in self.reasons] or self.not_measured)

    @property
    def remedies(self) -> tuple[str, ...]:
        """What to do about the reasons, each once."""
        return tuple(dict.fromkeys(reason.remedy for reason in self.reasons))


def judge_trust(metrics: Mapping[str, float], disturbance: Disturbance | None, *, realtime: bool) -> Trust:
    """How far a run that has ended can be trusted, and why.

    Args:
        metrics: What was measured, {key: value}.
        disturbance: What is known of the machine; None for nothing.
        realtime: Whether the recording was played in real time.
    """
    reasons = tuple(_reasons(metrics, disturbance, realtime=realtime))
    if reasons:
        low = any(reason.level is TrustLevel.LOW for reason in reasons)
        return Trust(TrustLevel.LOW if low else TrustLevel.LIMITED, reasons)
    missing = []
    if realtime and DROPPED_FRAMES not in metrics:
        missing.append("dropped frames were not counted")
    if disturbance is None or disturbance.disturbed is None:
        missing.append("the load of the machine was not recorded")
    return Trust(None if missing else TrustLevel.HIGH, (), tuple(missing))


def _reasons(metrics: Mapping[str, float], disturbance: Disturbance | None, *, realtime: bool) -> Iterator[TrustReason]:
    late = False
    for limit in LIMITS:
        value = metrics.get(limit.metric)
        if value is None or (limit.realtime_only and not realtime):
            continue
        level = limit.level(value)
        if level is not TrustLevel.HIGH:
            late = late or limit.metric == PLAYER_LAG
            words = limit.words.format(value=value, percent=100 * value)
            yield TrustReason(limit.metric, level, words, limit.remedy)
    if disturbance is not None and disturbance.disturbed:
        told = [reason for reason in disturbance.reasons if not (late and reason.kind is DisturbanceKind.PLAYER_LAG)]
        known = Disturbance(known=True, reasons=tuple(told))
        if told:
            words = f"measured on a disturbed machine: {known.words}"
            yield TrustReason(DISTURBED, TrustLevel.LIMITED, words, "; ".join(known.remedies))
