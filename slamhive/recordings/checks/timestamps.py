"""Timestamps of one stream: order, duplicates, gaps, jumps of the clock; and the clocks of all streams together."""

from __future__ import annotations

import numpy as np

from slamhive.domain.dataset import Finding, NotChecked, Severity
from slamhive.recordings.checks.collect import EXPECTED_TYPES
from slamhive.recordings.checks.evidence import Array, DatasetEvidence, Findings, StreamEvidence

# Whether the sensors that ``dataset.yaml`` declares are in the recording, all the time, at their rate.


LATE_S, LATE_SHARE = 1.0, 0.05
"""A sensor that begins or ends this much after or before the others: start-up takes less than a second."""
RATE_SHARE = 0.1
"""Sensors keep their rate to a per cent; at 10 % players and time synchronisation begin to suffer."""
GAP_PERIODS = 2.5
"""A longer step is a gap: two messages in a row are missing. A single one is lost now and then in many recordings."""
FEWEST_INTERVALS = 8
"""Fewer give no rate."""


def period_s(stream: StreamEvidence) -> float | None:
    """Median time between the headers of neighbours, None if there are too few or none that increase."""
    steps = np.diff(stream.header_ns)
    steps = steps[steps > 0]
    return float(np.median(steps) * 1e-9) if len(steps) >= 2 else None


def topics(evidence: DatasetEvidence) -> Findings:
    """Each sensor has a topic with messages of a type that is read."""
    for sensor in evidence.dataset.sensors:
        kind = evidence.topics.get(sensor.topic)
        stream = evidence.streams.get(sensor.name)
        if kind is None or (stream is not None and stream.total == 0):
            present = ", ".join(sorted(evidence.topics)[:10]) or "no topics"
            yield Finding(
                "topics",
                Severity.ERROR,
                sensor.name,
                f"The recording has no messages on {sensor.topic}.",
                f"correct the topic in dataset.yaml, or remove the sensor; the recording has {present}",
                topic=sensor.topic,
                expected=f"messages on {sensor.topic}",
            )
        elif kind not in EXPECTED_TYPES[sensor.kind]:
            wanted = " or ".join(EXPECTED_TYPES[sensor.kind])
            yield Finding(
                "topics",
                Severity.ERROR,
                sensor.name,
                f"{sensor.topic} holds {kind}, which is no message of a sensor of kind {sensor.kind.value}.",
                "correct topic or kind in dataset.yaml, or convert the recording",
                topic=sensor.topic,
                expected=wanted,
            )


def spans(evidence: DatasetEvidence) -> Findings:
    """Each sensor covers the whole recording."""
    allowed_s = max(LATE_S, LATE_SHARE * evidence.span_s)
    for stream in evidence.streams.values():
        if stream.total == 0 or len(stream.received_ns) < stream.total:
            continue
        late_s = (stream.received_ns[0] - evidence.start_ns) * 1e-9
        early_s = (evidence.end_ns - stream.received_ns[-1]) * 1e-9
        spare_s = 2.0 / stream.sensor.rate_hz
        if max(late_s, early_s) <= allowed_s + spare_s:
            continue
        covered = 1.0 - (late_s + early_s) / evidence.span_s
        begins = f"begins {late_s:.1f} s after the recording" if late_s >= early_s else ""
        ends = f"ends {early_s:.1f} s before the recording" if early_s > late_s else ""
        yield stream.finding(
            "spans",
            Severity.WARNING,
            f"{stream.sensor.name} {begins or ends}; it covers {covered:.0%} of it.",
            "cut the recording to the time that all sensors share, or record again",
            at_s=0.0 if late_s >= early_s else evidence.span_s - early_s,
            value=round(100 * covered, 1),
            unit="%",
            expected="all of the recording",
        )


def rates(evidence: DatasetEvidence) -> Findings:
    """The measured rate is the declared one."""
    for stream in evidence.streams.values():
        if stream.total <= FEWEST_INTERVALS:
            yield NotChecked("rates", stream.sensor.name, f"{stream.total} messages give no rate")
            continue
        typical_s = period_s(stream)
        if typical_s is None:
            yield NotChecked("rates", stream.sensor.name, "its timestamps do not increase")
            continue
        steps_s = np.diff(stream.header_ns) * 1e-9
        between_s = steps_s[(steps_s > 0) & (steps_s <= GAP_PERIODS * typical_s)]
        measured_hz, declared_hz = 1.0 / float(between_s.mean()), stream.sensor.rate_hz
        if abs(measured_hz / declared_hz - 1.0) > RATE_SHARE:
            yield stream.finding(
                "rates",
                Severity.WARNING,
                f"{stream.sensor.name} sends at {measured_hz:.4g} Hz, not at {declared_hz:.4g} Hz.",
                f"write rate_hz: {measured_hz:.4g} into dataset.yaml, or look for lost messages",
                value=float(f"{measured_hz:.6g}"),
                unit="Hz",
                expected=f"{declared_hz:.4g} Hz within {RATE_SHARE:.0%}",
            )


JUMP_S = 0.5
"""Header and receive time of neighbours differ by a transport delay, which changes by less than this."""
APART_S = 0.25
"""Delays from measurement to recording differ less than this between sensors: exposure, sweep, transport."""
DRIFT_S = 0.2
"""What two clocks may drift apart during a recording; more than the delays vary."""
COMMON_S = 1.0
FEWEST_FOR_DRIFT = 20


def order(evidence: DatasetEvidence) -> Findings:
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


def duplicates(evidence: DatasetEvidence) -> Findings:
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


def gaps(evidence: DatasetEvidence) -> Findings:
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


def clock_jumps(evidence: DatasetEvidence) -> Findings:
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


def clocks(evidence: DatasetEvidence) -> Findings:
    """All sensors run on one clock, and so does the recording."""
    streams = [stream for stream in evidence.streams.values() if len(stream.header_ns) and stream.header_ns.any()]
    if not streams:
        return
    common_s = float(np.median([np.median(_delays_s(stream)) for stream in streams]))
    for stream in streams:
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


def jumps(stream: StreamEvidence) -> Array:
    """Between which neighbours the header clock jumps, (n - 1,) bool."""
    steps_s = (np.diff(stream.header_ns) - np.diff(stream.received_ns)) * 1e-9
    return np.asarray(np.abs(steps_s) > JUMP_S)


def _delays_s(stream: StreamEvidence) -> Array:
    return np.asarray((stream.received_ns - stream.header_ns) * 1e-9)
