"""Whether the sensors that ``dataset.yaml`` declares are in the recording, all the time, at their rate."""

from __future__ import annotations

import numpy as np

from slamhive.checks.collect import EXPECTED_TYPES
from slamhive.checks.evidence import Evidence, Findings, Stream
from slamhive.domain.checks import Finding, NotChecked, Severity

LATE_S, LATE_SHARE = 1.0, 0.05
"""A sensor that begins or ends this much after or before the others: start-up takes less than a second."""
RATE_SHARE = 0.1
"""Sensors keep their rate to a per cent; at 10 % players and time synchronisation begin to suffer."""
GAP_PERIODS = 2.5
"""A longer step is a gap: two messages in a row are missing. A single one is lost now and then in many recordings."""
FEWEST_INTERVALS = 8
"""Fewer give no rate."""


def period_s(stream: Stream) -> float | None:
    """Median time between the headers of neighbours, None if there are too few or none that increase."""
    steps = np.diff(stream.header_ns)
    steps = steps[steps > 0]
    return float(np.median(steps) * 1e-9) if len(steps) >= 2 else None


def topics(evidence: Evidence) -> Findings:
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


def spans(evidence: Evidence) -> Findings:
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


def rates(evidence: Evidence) -> Findings:
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
