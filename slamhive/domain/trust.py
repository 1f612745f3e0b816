"""Trust in the measurements of a run: one rule for lists, pages, filters, JSON and commands.

Trust is not the outcome. A run that dropped most of its frames because it had too little CPU has succeeded, but its
error is not that of the algorithm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

# Whether a run was measured on a disturbed machine: one rule, from what was measured beside the run to reasons.
#
# Disturbance is not failure. A disturbed run keeps its outcome and its metrics, with a mark. Its CPU time and latency
# depend on other load, and in real time dropped frames and errors do too.


_LEAST_COVERED = 0.5
"""Less of a run than this says nothing about the rest."""


class DisturbanceKind(StrEnum):
    """Cause of a disturbed run."""

    STEAL = "steal"
    OTHERS = "others"
    CPU_PRESSURE = "cpu_pressure"
    IO_PRESSURE = "io_pressure"
    MEMORY_PRESSURE = "memory_pressure"
    THROTTLING = "throttling"
    PLAYER_LAG = "player_lag"

    @property
    def label(self) -> str:
        """In words."""
        return _LABELS[self]


_LABELS = {
    DisturbanceKind.STEAL: "steal",
    DisturbanceKind.OTHERS: "load of others",
    DisturbanceKind.CPU_PRESSURE: "CPU pressure",
    DisturbanceKind.IO_PRESSURE: "disk pressure",
    DisturbanceKind.MEMORY_PRESSURE: "memory pressure",
    DisturbanceKind.THROTTLING: "thermal throttling",
    DisturbanceKind.PLAYER_LAG: "late player",
}

REMEDIES: Mapping[DisturbanceKind, str] = {
    DisturbanceKind.STEAL: "run it on a machine that is not shared with other virtual machines",
    DisturbanceKind.OTHERS: "stop other programs and run it again",
    DisturbanceKind.CPU_PRESSURE: "stop other programs and run it again",
    DisturbanceKind.IO_PRESSURE: "stop what reads or writes the disk, or use a faster disk, and run it again",
    DisturbanceKind.MEMORY_PRESSURE: "free memory and run it again",
    DisturbanceKind.THROTTLING: "improve the cooling, or set a lower fixed CPU frequency, and run it again",
    DisturbanceKind.PLAYER_LAG: "use a faster disk or a lower playback rate, or play sequentially",
}
"""What to do about each kind."""


@dataclass(frozen=True, slots=True)
class DisturbanceLimits:
    """From where on a machine counts as disturbed; what each limit means is said in :mod:`slamhive.base.settings`."""

    time_fraction: float
    steal_fraction: float
    others_fraction: float
    cpu_pressure: float
    io_pressure: float
    memory_pressure: float
    throttle_events: int
    player_lag_s: float


@dataclass(frozen=True, slots=True)
class HostInterval:
    """The machine during a part of the run; what could not be measured is None.

    ``others_cores``: CPU time of everything but the run, over the wall time. ``steal_fraction``: share of the CPU time
    that the hypervisor gave to other machines. Pressures: share of the time in which some task waited.
    """

    duration_s: float
    others_cores: float | None = None
    steal_fraction: float | None = None
    cpu_pressure: float | None = None
    io_pressure: float | None = None
    memory_pressure: float | None = None


@dataclass(frozen=True, slots=True)
class HostLoad:
    """The machine during a run: ``cores`` that the run could use, its intervals, what was counted over the whole run.

    ``not_measured`` says in words what could not be measured and why.
    """

    cores: int = 0
    intervals: tuple[HostInterval, ...] = ()
    throttle_events: int | None = None
    frequency_hz: float | None = None
    not_measured: tuple[str, ...] = ()

    @property
    def covered_s(self) -> float:
        """Share of the run that the intervals cover."""
        return sum(interval.duration_s for interval in self.intervals)

    def mean(self, name: str) -> float | None:
        """The mean of a field of the intervals over time, None if it was never measured."""
        known = [(entry.duration_s, getattr(entry, name)) for entry in self.intervals]
        known = [(duration_s, value) for duration_s, value in known if value is not None]
        total_s = sum(duration_s for duration_s, _ in known)
        return sum(duration_s * value for duration_s, value in known) / total_s if total_s > 0 else None

    def share(self, holds: Callable[[HostInterval], bool]) -> float:
        """The share of the covered time in which a condition holds."""
        total_s = self.covered_s
        return sum(entry.duration_s for entry in self.intervals if holds(entry)) / total_s if total_s > 0 else 0.0


@dataclass(frozen=True, slots=True)
class DisturbanceReason:
    """One reason why a run counts as disturbed, in words."""

    kind: DisturbanceKind
    words: str


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Known disturbance of a run.

    ``known`` is False where too little was measured to call the run undisturbed; ``not_measured`` says what is missing.
    """

    known: bool
    reasons: tuple[DisturbanceReason, ...] = ()
    not_measured: tuple[str, ...] = ()

    @property
    def disturbed(self) -> bool | None:
        """True if the run was disturbed, None if that is unknown."""
        return bool(self.reasons) if self.known else None

    @property
    def words(self) -> str:
        """All reasons in one line."""
        return "; ".join(reason.words for reason in self.reasons)

    @property
    def content(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "disturbed": self.disturbed,
            "reasons": [{"kind": reason.kind.value, "words": reason.words} for reason in self.reasons],
            "not_measured": list(self.not_measured),
        }

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Disturbance:
        """From :attr:`content`; raises ValueError, KeyError or TypeError for anything else."""
        reasons = tuple(
            DisturbanceReason(DisturbanceKind(entry["kind"]), str(entry["words"])) for entry in content["reasons"]
        )
        return cls(content["disturbed"] is not None, reasons, tuple(map(str, content["not_measured"])))

    @property
    def remedies(self) -> tuple[str, ...]:
        """Advice for the reasons, each once."""
        return tuple(dict.fromkeys(REMEDIES[reason.kind] for reason in self.reasons))


def judge(load: HostLoad, duration_s: float, player_lag_s: float | None, limits: DisturbanceLimits) -> Disturbance:
    """Decide if a run of ``duration_s`` was disturbed, and why.

    Args:
        load: What was measured of the machine.
        duration_s: How long the run lasted.
        player_lag_s: How late the player was at worst, None without a schedule.
        limits: From where on something counts.
    """
    reasons = tuple(_disturbance_reasons(load, player_lag_s, limits))
    not_measured = load.not_measured
    enough = load.cores > 0 and load.covered_s > 0 and load.covered_s >= _LEAST_COVERED * duration_s
    if not enough and not reasons and (load.cores > 0 or not not_measured):
        too_little = f"the machine was watched for {load.covered_s:.1f} s of {duration_s:.1f} s"
        not_measured = (too_little, *not_measured)
    return Disturbance(enough or bool(reasons), reasons, not_measured)


def _disturbance_reasons(
    load: HostLoad, player_lag_s: float | None, limits: DisturbanceLimits
) -> Iterator[DisturbanceReason]:
    yield from _cpu_reasons(load, limits)
    for kind, limit, what in (
        (DisturbanceKind.IO_PRESSURE, limits.io_pressure, "the disk"),
        (DisturbanceKind.MEMORY_PRESSURE, limits.memory_pressure, "memory"),
    ):
        share = load.share(lambda entry, kind=kind, limit=limit: _above(getattr(entry, kind.value), limit))  # type: ignore[misc]
        if share > limits.time_fraction:
            mean = load.mean(kind.value) or 0.0
            words = (
                f"processes waited for {what} more than {_percent(limit)} of the time for {_percent(share)} of the run"
            )
            yield DisturbanceReason(kind, f"{words} ({_percent(mean)} on average)")
    if load.throttle_events is not None and load.throttle_events > limits.throttle_events:
        words = f"the processor was too hot and slowed down {load.throttle_events} times"
        yield DisturbanceReason(DisturbanceKind.THROTTLING, words)
    if player_lag_s is not None and player_lag_s > limits.player_lag_s:
        words = f"the player was up to {player_lag_s:.2g} s late"
        yield DisturbanceReason(DisturbanceKind.PLAYER_LAG, words)


def _cpu_reasons(load: HostLoad, limits: DisturbanceLimits) -> Iterator[DisturbanceReason]:
    stolen = load.share(lambda entry: _above(entry.steal_fraction, limits.steal_fraction))
    if stolen > limits.time_fraction:
        mean = load.mean("steal_fraction") or 0.0
        limit = _percent(limits.steal_fraction)
        words = f"the hypervisor took more than {limit} of the CPU time for {_percent(stolen)} of the run"
        yield DisturbanceReason(DisturbanceKind.STEAL, f"{words} ({_percent(mean)} on average)")
    limit_cores = limits.others_fraction * load.cores
    busy = load.share(lambda entry: _above(entry.others_cores, limit_cores))
    if busy > limits.time_fraction:
        mean = load.mean("others_cores") or 0.0
        cores = f"{load.cores} core{'s' * (load.cores != 1)}"
        words = f"other processes used more than {limit_cores:.2g} of {cores} for {_percent(busy)} of the run"
        yield DisturbanceReason(DisturbanceKind.OTHERS, f"{words} ({mean:.2g} on average)")
        return
    # A run with more threads than cores makes its own tasks wait. So pressure counts only beside a load of others.
    squeezed = load.share(
        lambda entry: _above(entry.cpu_pressure, limits.cpu_pressure) and _above(entry.others_cores, limit_cores / 2)
    )
    if squeezed > limits.time_fraction:
        words = f"processes waited for a core that other processes used for {_percent(squeezed)} of the run"
        yield DisturbanceReason(DisturbanceKind.CPU_PRESSURE, words)


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %"


def _above(value: float | None, limit: float) -> bool:
    return value is not None and value > limit


DROPPED_FRAMES = "frames.dropped_fraction"
LARGEST_DOUBTED_SHARE = 0.25
"""Above this share of dropped frames the trust is low."""
PLAYER_LAG = "playback.lag_max"
CPU_LIMIT_USED = "cpu.limit_used"
DISTURBED = "disturbed"
"""The kind of the reason for a run on a disturbed machine."""


class TrustLevel(StrEnum):
    """Level of trust in the measurements."""

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
        low_above=LARGEST_DOUBTED_SHARE,
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
TRUST_METRICS = frozenset({DROPPED_FRAMES, *(limit.metric for limit in LIMITS)})
"""The metrics that :func:`judge_trust` reads."""
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
    """Trust in a run. ``level`` is None if too little was measured; ``not_measured`` says what."""

    level: TrustLevel | None
    reasons: tuple[TrustReason, ...] = ()
    not_measured: tuple[str, ...] = ()

    @property
    def doubt(self) -> str:
        """The mark that people read; empty where nothing speaks against the run."""
        return {TrustLevel.LOW: "very doubtful", TrustLevel.LIMITED: "doubtful"}.get(self.level or TrustLevel.HIGH, "")

    @property
    def mark(self) -> str:
        """The doubt, or the level where there is none; empty if too little was measured."""
        return self.doubt or (self.level.value if self.level is not None else "")

    @property
    def words(self) -> str:
        """All reasons in one line, or what was not measured."""
        return "; ".join([reason.words for reason in self.reasons] or self.not_measured)

    @property
    def remedies(self) -> tuple[str, ...]:
        """Advice for the reasons, each once."""
        return tuple(dict.fromkeys(reason.remedy for reason in self.reasons))


def judge_trust(metrics: Mapping[str, float], disturbance: Disturbance | None, *, realtime: bool) -> Trust:
    """Judge the trust in a run that has ended, with reasons.

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
