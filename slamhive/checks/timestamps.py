"""Timestamps of one stream: order, duplicates, gaps, jumps of the clock; and the clocks of all streams together."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Array, Evidence, Findings, Stream
from slamhive.checks.streams import GAP_PERIODS, period_s
from slamhive.domain.checks import Finding, NotChecked, Severity

JUMP_S = 0.5
"""Header and receive time of neighbours differ by a transport delay, which changes by less than this."""
APART_S = 0.25
"""Delays from measurement to recording differ less than this between sensors: exposure, sweep, transport."""
DRIFT_S = 0.2
"""What two clocks may drift apart during a recording; more than the delays vary."""
COMMON_S = 1.0
FEWEST_FOR_DRIFT = 20


def order(evidence: Evidence) -> Findings:
    """Header timestamps are set and increase."""
    for stream in evidence.streams.values():
        if len(stream.header_ns) and not stream.header_ns.any():
            yield stream.finding(
                "order",
                Severity.ERROR,
                f"All header timestamps of {stream.sensor.name} are 0.",
                "set the timestamps when the recording is converted; algorithms get these times",
                expected="the time of the measurement",
                count=stream.total,
            )
            continue
        steps_ns = np.diff(stream.header_ns)
        back = np.flatnonzero((steps_ns < 0) & ~jumps(stream)) + 1
        if len(back):
            worst_ms = float(-steps_ns[back - 1].min() * 1e-6)
            yield stream.finding(
                "order",
                Severity.ERROR,
                f"Messages of {stream.sensor.name} are older than the message before them.",
                "sort the messages by header timestamp when the recording is converted",
                **evidence.where(stream, back),
                value=worst_ms,
                unit="ms",
                expected="timestamps that increase",
            )


def duplicates(evidence: Evidence) -> Findings:
    """No two messages have one timestamp."""
    for stream in evidence.streams.values():
        same = np.flatnonzero(np.diff(stream.header_ns) == 0) + 1
        if len(same) and stream.header_ns.any():
            yield stream.finding(
                "duplicates",
                Severity.ERROR,
                f"Messages of {stream.sensor.name} have the timestamp of the message before them.",
                "remove the copies; algorithms divide by the time between messages",
                **evidence.where(stream, same),
                value=float(len(same)),
                unit="messages",
                expected="each timestamp once",
            )


def gaps(evidence: Evidence) -> Findings:
    """No messages are missing."""
    for stream in evidence.streams.values():
        typical_s = period_s(stream)
        if typical_s is None:
            yield NotChecked("gaps", stream.sensor.name, "too few timestamps that increase")
            continue
        steps_s = np.diff(stream.header_ns) * 1e-9
        late = np.flatnonzero((steps_s > GAP_PERIODS * typical_s) & ~jumps(stream)) + 1
        if len(late):
            lost = int(np.round(steps_s[late - 1] / typical_s - 1).sum())
            yield stream.finding(
                "gaps",
                Severity.WARNING,
                f"{stream.sensor.name} has gaps in which about {lost} messages are missing.",
                "record again on a faster disk, or cut the recording before the gap",
                **evidence.where(stream, late),
                value=float(steps_s[late - 1].max()),
                unit="s",
                expected=f"{typical_s * 1e3:.3g} ms between messages",
            )


def clock_jumps(evidence: Evidence) -> Findings:
    """Header times advance as receive times do."""
    for stream in evidence.streams.values():
        at = np.flatnonzero(jumps(stream)) + 1
        if len(at):
            largest_s = float(np.abs(np.diff(_delays_s(stream)))[at - 1].max())
            yield stream.finding(
                "clock-jumps",
                Severity.ERROR,
                f"The clock of {stream.sensor.name} jumps against the recording time.",
                "correct the timestamps after the jump, or cut the recording there",
                **evidence.where(stream, at),
                value=largest_s,
                unit="s",
                expected=f"jumps below {JUMP_S} s",
            )


def clocks(evidence: Evidence) -> Findings:
    """All sensors run on one clock, and so does the recording."""
    streams = [stream for stream in evidence.streams.values() if len(stream.header_ns) and stream.header_ns.any()]
    if not streams:
        return
    common_s = float(np.median([np.median(_delays_s(stream)) for stream in streams]))
    for stream in streams:
        yield from _clock_of(stream, common_s)
    if abs(common_s) > COMMON_S:
        yield Finding(
            "clocks",
            Severity.NOTE,
            "recording",
            f"Messages were recorded {common_s:.4g} s after the time in their headers.",
            "nothing: SLAM Hive uses the headers; tools that use recording time see other times",
            value=common_s,
            unit="s",
            expected=f"less than {COMMON_S:g} s",
        )


def _clock_of(stream: Stream, common_s: float) -> Findings:
    delays_s = _delays_s(stream)
    tenth = max(1, len(delays_s) // 10)
    drift_s = float(np.median(delays_s[-tenth:]) - np.median(delays_s[:tenth]))
    apart_s = float(np.median(delays_s)) - common_s
    if len(delays_s) >= FEWEST_FOR_DRIFT and abs(drift_s) > DRIFT_S and not jumps(stream).any():
        yield stream.finding(
            "clocks",
            Severity.WARNING,
            f"Header and recording time of {stream.sensor.name} drift apart during the recording.",
            "synchronise the clocks (PTP, hardware trigger), or correct the timestamps",
            value=drift_s,
            unit="s",
            expected=f"less than {DRIFT_S} s",
        )
    elif abs(apart_s) > APART_S:
        yield stream.finding(
            "clocks",
            Severity.ERROR,
            f"The clock of {stream.sensor.name} is {apart_s:+.3f} s away from that of the other sensors.",
            "find out the offset of the clocks and correct the header timestamps",
            value=apart_s,
            unit="s",
            expected=f"the same difference within {APART_S} s",
        )


def jumps(stream: Stream) -> Array:
    """Between which neighbours the header clock jumps, (n - 1,) bool."""
    steps_s = (np.diff(stream.header_ns) - np.diff(stream.received_ns)) * 1e-9
    return np.asarray(np.abs(steps_s) > JUMP_S)


def _delays_s(stream: Stream) -> Array:
    return np.asarray((stream.received_ns - stream.header_ns) * 1e-9)
