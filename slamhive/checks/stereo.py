"""Pairs of cameras: synchronisation, and whether matched points lie where the calibration says."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Array, Evidence, Findings, Matches, Stream
from slamhive.checks.geometry import explained_share, focal_px, matrix, misfits, typical
from slamhive.domain.checks import NotChecked, Severity
from slamhive.domain.sensors import Sensor, SensorKind

APART_S = 0.005
"""Hardware triggers keep cameras within microseconds; at 1 rad/s 5 ms are 2 pixels."""
PARTNER_PERIODS = 0.4
LONELY_SHARE = 0.05
ROW_PX, ROW_SHARE = 1.5, 0.003
"""Distance from where points can be: features are found to 0.5 pixels. The share is of twice the focal length."""
FEWEST_MATCHES = 30
EXPLAINED = 0.5
"""Share of matches that some motion explains when the matches themselves are good."""


def pairs_of(evidence: Evidence) -> list[tuple[Stream, Stream]]:
    """The stereo pairs, and each depth camera with its camera."""
    found = [
        (stream, evidence.streams[stream.partner.name])
        for stream in evidence.of_kind(SensorKind.CAMERA)
        if stream.partner is not None
    ]
    for stream in evidence.of_kind(SensorKind.DEPTH):
        camera = evidence.streams.get(str(stream.sensor.calibration.get("registered_to", "")))
        if camera is not None:
            found.append((camera, stream))
    return [pair for pair in found if len(pair[0].header_ns) and len(pair[1].header_ns)]


def synchronisation(evidence: Evidence) -> Findings:
    """The cameras of a pair take their images at the same time."""
    pairs = pairs_of(evidence)
    if not pairs:
        yield NotChecked("stereo-sync", "cameras", "the dataset has no stereo pair and no registered depth")
    for first, second in pairs:
        apart_s = _nearest_s(first.header_ns, second.header_ns)
        partners = np.abs(apart_s) <= PARTNER_PERIODS / second.sensor.rate_hz
        names = f"{first.sensor.name} and {second.sensor.name}"
        lonely = np.flatnonzero(~partners)
        if len(lonely) > max(1, LONELY_SHARE * len(apart_s)):
            yield second.finding(
                "stereo-partners",
                Severity.WARNING,
                f"{len(lonely)} images of {first.sensor.name} have no partner from {second.sensor.name}.",
                "record both cameras completely; algorithms drop images without a partner",
                **evidence.where(first, lonely),
                value=float(len(lonely)),
                unit="images",
                expected=f"at most {LONELY_SHARE:.0%}",
            )
        typical_s = float(np.median(np.abs(apart_s[partners]))) if partners.any() else 0.0
        if typical_s > APART_S:
            yield second.finding(
                "stereo-sync",
                Severity.ERROR,
                f"Images of {names} are {typical_s * 1e3:.3g} ms apart.",
                "trigger both cameras together, or correct the timestamps of one",
                value=float(np.median(apart_s[partners])),
                unit="s",
                expected=f"at most {APART_S} s",
            )


def _nearest_s(times_ns: Array, others_ns: Array) -> Array:
    """Time from each of ``times_ns`` to the nearest of ``others_ns``, (n,), in s."""
    others_ns = np.sort(others_ns)
    after = np.clip(np.searchsorted(others_ns, times_ns), 1, max(1, len(others_ns) - 1))
    before_ns, after_ns = others_ns[after - 1], others_ns[np.minimum(after, len(others_ns) - 1)]
    nearer = np.where(np.abs(before_ns - times_ns) <= np.abs(after_ns - times_ns), before_ns, after_ns)
    return np.asarray((nearer - times_ns) * 1e-9)


def epipolar(evidence: Evidence) -> Findings:
    """Matched points of a stereo pair lie where intrinsics and extrinsics say."""
    pairs = [pair for pair in pairs_of(evidence) if pair[1].sensor.kind is SensorKind.CAMERA]
    if not pairs:
        yield NotChecked("stereo-geometry", "cameras", "the dataset has no stereo pair")
    for first, second in pairs:
        found = _joined(first.stereo)
        if found is None:
            yield NotChecked(
                "stereo-geometry", second.sensor.name, "its images have too few points in common with the other"
            )
            continue
        yield from _judge(first.sensor, second, *found)


def _judge(left: Sensor, right: Stream, first: Array, second: Array) -> Findings:
    T_right_left = np.linalg.inv(matrix(right.sensor.T_body_sensor)) @ matrix(left.T_body_sensor)
    focal = focal_px(left)
    allowed_px = max(ROW_PX, ROW_SHARE * 2 * focal)
    typical_px = typical(misfits(first, second, T_right_left)) * focal
    if typical_px <= allowed_px:
        return
    if explained_share(first, second, allowed_px / focal) < EXPLAINED:
        yield NotChecked("stereo-geometry", right.sensor.name, "the matches between the images contradict each other")
        return
    swapped_px = typical(misfits(first, second, np.linalg.inv(T_right_left))) * focal
    rectified = bool(left.calibration.get("rectified"))
    if swapped_px <= allowed_px:
        meaning, remedy = "the images or the extrinsics of left and right are swapped", "swap topics or extrinsics"
    elif rectified:
        meaning = "the images are not rectified as dataset.yaml says"
        remedy = "rectify them, or give distortion and extrinsics of the original images"
    else:
        meaning, remedy = "intrinsics or extrinsics are wrong", "calibrate the pair again"
    shown_px = min(typical_px, 1e6)
    yield right.finding(
        "stereo-geometry",
        Severity.ERROR,
        f"Points of {left.name} are {shown_px:.3g} pixels from where they can be in {right.sensor.name}: {meaning}.",
        remedy,
        value=shown_px,
        unit="pixels",
        expected=f"at most {allowed_px:.2g} pixels",
    )


def _joined(matches: tuple[Matches, ...]) -> tuple[Array, Array] | None:
    """All matched points of the places together, (n, 2) each, if there are enough."""
    if sum(len(match.first) for match in matches) < FEWEST_MATCHES:
        return None
    return np.vstack([match.first for match in matches]), np.vstack([match.second for match in matches])
