"""Decides whether a run ends early, by its stop rules and what was observed. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.domain.run import FailureReason
from slamhive.schema.limits import StopWhen


@dataclass(frozen=True, slots=True)
class Observation:
    """Facts about a run that goes on; None stands for what is not known yet.

    Attributes:
        elapsed_s: Wall-clock time since it started.
        memory_bytes: The most memory of its samples.
        untracked_s: For how long the algorithm has found no pose, in s of the recording.
    """

    elapsed_s: float
    memory_bytes: int | None = None
    untracked_s: float | None = None


@dataclass(frozen=True, slots=True)
class EarlyEnd:
    """Why a run ends early: the reason, and in words the rule and the value that broke it."""

    reason: FailureReason
    detail: str


def broken_rule(rules: StopWhen, seen: Observation) -> EarlyEnd | None:
    """The first rule that is broken, in the order time, memory, tracking; None if the run may go on."""
    if rules.time_s is not None and seen.elapsed_s > rules.time_s:
        detail = f"ended early: ran for {seen.elapsed_s:.1f} s, stop_when allows time_s {rules.time_s:g}"
        return EarlyEnd(FailureReason.TIME_BUDGET, detail)
    if rules.memory_mb is not None and (seen.memory_bytes or 0) > rules.memory_mb * 1_000_000:
        used = f"{(seen.memory_bytes or 0) / 1e6:.1f} MB"
        detail = f"ended early: used {used}, stop_when allows memory_mb {rules.memory_mb}"
        return EarlyEnd(FailureReason.MEMORY_BUDGET, detail)
    if rules.lost_tracking_s is not None and (seen.untracked_s or 0.0) > rules.lost_tracking_s:
        lost = f"no pose for {seen.untracked_s:.1f} s of the recording"
        detail = f"ended early: {lost}, stop_when allows lost_tracking_s {rules.lost_tracking_s:g}"
        return EarlyEnd(FailureReason.LOST_TRACKING, detail)
    return None


def skipped(rules: StopWhen, failures: int) -> EarlyEnd | None:
    """Why a run is not tried although it is its turn; None if it is.

    Args:
        rules: Of the run.
        failures: How often its configuration has failed since the run was asked for.
    """
    allowed = rules.failures_of_configuration
    if allowed is None or failures < allowed:
        return None
    times = "once" if failures == 1 else f"{failures} times"
    return EarlyEnd(
        FailureReason.CONFIGURATION_FAILED,
        f"not tried: since this run was asked for its configuration has failed {times}, stop_when allows "
        f"failures_of_configuration {allowed}",
    )
