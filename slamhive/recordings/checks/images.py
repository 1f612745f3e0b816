"""Images by themselves: size, encoding, calibration, exposure, sharpness, frozen pictures."""

from __future__ import annotations

import numpy as np

from slamhive.domain.dataset import NotChecked, Severity
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.evidence import (
    Array,
    DatasetEvidence,
    Findings,
    ImageEvidence,
    MatchEvidence,
    StreamEvidence,
)
from slamhive.recordings.checks.geometry import (
    CENTRE_SHARE,
    NARROWEST_DEG,
    WIDEST_DEG,
    calibrated,
    doubtful_centre,
    doubtful_view_deg,
    explained_share,
    focal_px,
    matrix,
    misfits,
    typical,
)
from slamhive.recordings.checks.truth import transforms_at, usable_gap_s, usable_poses

DARK, BRIGHT_SHARE = 0.06, 0.5
"""Mean below 15 of 255: features drown in noise. Half of the pixels at the limit: half of the image is lost."""
BLURRED = 0.07
"""Sharp images have 0.12 to 1.2 (EuRoC, KITTI, 7-Scenes, room); a blur of 2 pixels leaves 0.03 to 0.08."""
BAD_SHARE = 0.05
"""Some bad images are normal, when a light is passed or the camera turns fast."""
FEWEST_BAD = 3
FROZEN_IMAGES = 2
"""Equal images in a row: noise makes any two images of a real camera differ."""
MOVED_M, TURNED_RAD = 0.005, 0.005
_DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")


def image_size(evidence: DatasetEvidence) -> Findings:
    """Images have the size and the encoding that the calibration is for."""
    for stream in evidence.of_kind(SensorKind.CAMERA, SensorKind.DEPTH):
        if stream.images is None or not stream.images.shapes:
            continue
        wanted = (int(calibrated(stream.sensor, "width")), int(calibrated(stream.sensor, "height")))
        wrong = {shape: count for shape, count in stream.images.shapes.items() if shape[:2] != wanted}
        if wrong:
            (width, height, _), count = max(wrong.items(), key=lambda entry: entry[1])
            found = "cannot be decoded" if width == 0 else f"have {width}x{height} pixels"
            yield stream.finding(
                "image-size",
                Severity.ERROR,
                f"{sum(wrong.values())} images of {stream.sensor.name} {found}; its calibration is for "
                f"{wanted[0]}x{wanted[1]}.",
                "calibrate for this size: scale width, height, fx, fy, cx and cy alike",
                count=count,
                value=float(width),
                unit="pixels wide",
                expected=f"{wanted[0]}x{wanted[1]}",
            )
        yield from _encoding(stream, stream.images)


def _encoding(stream: StreamEvidence, images: ImageEvidence) -> Findings:
    found = sorted({encoding for _, _, encoding in images.shapes if encoding})
    declared = str(stream.sensor.calibration.get("encoding", ""))
    unfit = stream.sensor.kind is SensorKind.DEPTH and any(encoding not in _DEPTH_ENCODINGS for encoding in found)
    if found and (unfit or (declared and any(encoding != declared for encoding in found))):
        yield stream.finding(
            "image-encoding",
            Severity.ERROR if unfit else Severity.WARNING,
            f"Images of {stream.sensor.name} are {', '.join(found)}; dataset.yaml says {declared or 'nothing'}.",
            "write the encoding of the recording into dataset.yaml; depth is 16UC1 or 32FC1",
            expected=declared or ", ".join(_DEPTH_ENCODINGS),
        )


def intrinsics(evidence: DatasetEvidence) -> Findings:
    """Focal lengths and principal point are possible for the image size."""
    for stream in evidence.of_kind(SensorKind.CAMERA, SensorKind.DEPTH):
        sensor = stream.sensor
        off, angle_deg = doubtful_centre(sensor), doubtful_view_deg(sensor)
        fx, fy, cx, cy = (calibrated(sensor, key) for key in ("fx", "fy", "cx", "cy"))
        if off is not None:
            yield stream.finding(
                "intrinsics",
                Severity.ERROR,
                f"The principal point of {sensor.name}, ({cx:.4g}, {cy:.4g}), is far from the middle of the image.",
                "the calibration is for another size or a cropped image: scale or shift it",
                value=round(off, 3),
                unit="of the image size",
                expected=f"within {CENTRE_SHARE}",
            )
        if angle_deg is not None:
            yield stream.finding(
                "intrinsics",
                Severity.ERROR,
                f"{sensor.name} would see {angle_deg:.0f} deg with fx {fx:.4g} and fy {fy:.4g}.",
                "check fx and fy: they are in pixels of the image size in dataset.yaml",
                value=angle_deg,
                unit="deg",
                expected=f"{NARROWEST_DEG:g} to {WIDEST_DEG:g} deg, fx near fy",
            )


def exposure(evidence: DatasetEvidence) -> Findings:
    """Images are neither dark nor saturated."""
    for stream in evidence.of_kind(SensorKind.CAMERA):
        images = stream.images
        if images is None or not np.isfinite(images.brightness).any():
            yield NotChecked("image-dark", stream.sensor.name, "no image has 8 bits per channel")
            yield NotChecked("image-saturated", stream.sensor.name, "no image has 8 bits per channel")
            continue
        looked_at = np.flatnonzero(np.isfinite(images.brightness))
        dark = looked_at[images.brightness[looked_at] < DARK]
        if len(dark) >= max(FEWEST_BAD, BAD_SHARE * len(looked_at)):
            yield stream.finding(
                "image-dark",
                Severity.WARNING,
                f"{len(dark) / len(looked_at):.0%} of the images of {stream.sensor.name} are dark.",
                "longer exposure or more light; filter the dataset with a step such as gamma",
                **evidence.where(stream, dark),
                value=round(255 * float(images.brightness[dark].mean()), 2),
                unit="of 255, mean grey value",
                expected=f"at least {255 * DARK:.0f}",
            )
        bright = looked_at[images.bright_share[looked_at] > BRIGHT_SHARE]
        if len(bright) >= max(FEWEST_BAD, BAD_SHARE * len(looked_at)):
            yield stream.finding(
                "image-saturated",
                Severity.WARNING,
                f"{len(bright) / len(looked_at):.0%} of the images of {stream.sensor.name} are saturated.",
                "shorter exposure or less gain",
                **evidence.where(stream, bright),
                value=round(100 * float(images.bright_share[bright].mean()), 1),
                unit="% of the pixels at the limit",
                expected=f"at most {BRIGHT_SHARE:.0%}",
            )


def sharpness(evidence: DatasetEvidence) -> Findings:
    """Images are sharp."""
    for stream in evidence.of_kind(SensorKind.CAMERA):
        images = stream.images
        if images is None:
            yield NotChecked("image-blur", stream.sensor.name, "too few images show anything")
            continue
        # Dark and overexposed images show nothing that could be sharp.
        shown = np.isfinite(images.sharpness) & (images.brightness >= DARK) & (images.bright_share <= BRIGHT_SHARE)
        usable = np.flatnonzero(shown)
        if len(usable) < FEWEST_BAD:
            yield NotChecked("image-blur", stream.sensor.name, "too few images show anything")
            continue
        blurred = usable[images.sharpness[usable] < BLURRED]
        if len(blurred) >= max(FEWEST_BAD, BAD_SHARE * len(usable)):
            yield stream.finding(
                "image-blur",
                Severity.WARNING,
                f"{len(blurred) / len(usable):.0%} of the images of {stream.sensor.name} are blurred.",
                "focus the lens; shorter exposure if only fast motion is blurred",
                **evidence.where(stream, blurred),
                value=float(np.median(images.sharpness[blurred])),
                unit="fine over coarse structure",
                expected=f"at least {BLURRED}",
            )


def frozen(evidence: DatasetEvidence) -> Findings:
    """Images change from one to the next while the camera moves."""
    poses = usable_poses(evidence)
    for stream in evidence.of_kind(SensorKind.CAMERA, SensorKind.DEPTH):
        if stream.images is None or stream.total < 2:
            continue
        prints = stream.images.prints
        same = np.flatnonzero(prints[1:] == prints[:-1]) + 1
        same = same[same < len(stream.header_ns)]
        if len(same) and not isinstance(poses, str):
            times_s = stream.header_ns * 1e-9
            before, now = (transforms_at(poses, times_s[index], usable_gap_s(poses)) for index in (same - 1, same))
            moved_m = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
            turned = np.linalg.norm(now[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
            same = same[(moved_m > MOVED_M) | (turned > TURNED_RAD)]
        if len(same) >= FROZEN_IMAGES:
            yield stream.finding(
                "image-frozen",
                Severity.WARNING,
                f"{len(same)} images of {stream.sensor.name} are equal to the image before them.",
                "the driver repeats images: remove the copies",
                **evidence.where(stream, same),
                value=float(len(same)),
                unit="images",
                expected="images that differ",
            )


# Depth images by themselves: valid pixels and plausible distances.


LIKELY_M = (0.2, 60.0)
"""Median depth of a recording: depth cameras see 0.2 to 10 m, rendered outdoor scenes more."""
LEAST_VALID = 0.1


def typical_depth_m(stream: StreamEvidence) -> float | None:
    """Median over the sampled images of the median depth, None without valid pixels."""
    if stream.depths is None or not np.isfinite(stream.depths.median_raw).any():
        return None
    return float(np.nanmedian(stream.depths.median_raw)) / calibrated(stream.sensor, "units_per_m")


def depth_values(evidence: DatasetEvidence) -> Findings:
    """Depth images have values, and these are distances in the range of a depth camera."""
    for stream in evidence.of_kind(SensorKind.DEPTH):
        if stream.depths is None or len(stream.depths.valid_share) == 0:
            yield NotChecked("depth-values", stream.sensor.name, "no depth image can be read")
            continue
        empty = float(np.mean(stream.depths.valid_share < LEAST_VALID))
        if empty > 0.5:
            yield stream.finding(
                "depth-values",
                Severity.WARNING,
                f"{empty:.0%} of the depth images of {stream.sensor.name} have hardly any valid pixel.",
                "check the conversion: 0 means no value",
                value=round(100 * float(np.median(stream.depths.valid_share)), 1),
                unit="% valid",
                expected=f"at least {LEAST_VALID:.0%}",
            )
        typical_m = typical_depth_m(stream)
        if typical_m is not None and not LIKELY_M[0] <= typical_m <= LIKELY_M[1]:
            yield stream.finding(
                "depth-scale",
                Severity.ERROR,
                f"{stream.sensor.name} sees {typical_m:.3g} m as the median depth.",
                "correct units_per_m in dataset.yaml (1000 for mm, 5000 for TUM RGB-D, 1 for 32FC1)",
                value=typical_m,
                unit="m",
                expected=f"{LIKELY_M[0]} m to {LIKELY_M[1]:g} m",
            )


# Pairs of cameras: synchronisation, and whether matched points lie where the calibration says.


APART_S = 0.005
"""Hardware triggers keep cameras within microseconds; at 1 rad/s 5 ms are 2 pixels."""
PARTNER_PERIODS = 0.4
LONELY_SHARE = 0.05
ROW_PX, ROW_SHARE = 1.5, 0.003
"""Distance from where points can be: features are found to 0.5 pixels. The share is of twice the focal length."""
FEWEST_MATCHES = 30
EXPLAINED = 0.5
"""Share of matches that some motion explains when the matches themselves are good."""


def pairs_of(evidence: DatasetEvidence) -> list[tuple[StreamEvidence, StreamEvidence]]:
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


def synchronisation(evidence: DatasetEvidence) -> Findings:
    """The cameras of a pair take their images at the same time."""
    pairs = pairs_of(evidence)
    if not pairs:
        yield NotChecked("stereo-sync", "cameras", "the dataset has no stereo pair and no registered depth")
    for first, second in pairs:
        # Each image's nearest neighbour of the other camera is the one before or the one after it.
        times_ns, others_ns = first.header_ns, np.sort(second.header_ns)
        after = np.clip(np.searchsorted(others_ns, times_ns), 1, max(1, len(others_ns) - 1))
        before_ns, after_ns = others_ns[after - 1], others_ns[np.minimum(after, len(others_ns) - 1)]
        nearer_ns = np.where(np.abs(before_ns - times_ns) <= np.abs(after_ns - times_ns), before_ns, after_ns)
        apart_s = (nearer_ns - times_ns) * 1e-9
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


def epipolar(evidence: DatasetEvidence) -> Findings:
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


def _judge(left: Sensor, right: StreamEvidence, first: Array, second: Array) -> Findings:
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


def _joined(matches: tuple[MatchEvidence, ...]) -> tuple[Array, Array] | None:
    """All matched points of the places together, (n, 2) each, if there are enough."""
    if sum(len(match.first) for match in matches) < FEWEST_MATCHES:
        return None
    return np.vstack([match.first for match in matches]), np.vstack([match.second for match in matches])
