"""Images by themselves: size, encoding, calibration, exposure, sharpness, frozen pictures."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Evidence, Findings, Images, Stream
from slamhive.checks.geometry import (
    CENTRE_SHARE,
    NARROWEST_DEG,
    WIDEST_DEG,
    calibrated,
    doubtful_centre,
    doubtful_view_deg,
)
from slamhive.checks.truth_file import transforms_at, usable_gap_s, usable_poses
from slamhive.domain.checks import NotChecked, Severity
from slamhive.domain.sensors import SensorKind

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


def image_size(evidence: Evidence) -> Findings:
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


def _encoding(stream: Stream, images: Images) -> Findings:
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


def intrinsics(evidence: Evidence) -> Findings:
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


def exposure(evidence: Evidence) -> Findings:
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


def sharpness(evidence: Evidence) -> Findings:
    """Images are sharp."""
    for stream in evidence.of_kind(SensorKind.CAMERA):
        images = stream.images
        usable = None if images is None else _not_dark(images)
        if images is None or usable is None or len(usable) < FEWEST_BAD:
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


def _not_dark(images: Images) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    shown = np.isfinite(images.sharpness) & (images.brightness >= DARK) & (images.bright_share <= BRIGHT_SHARE)
    return np.flatnonzero(shown)


def frozen(evidence: Evidence) -> Findings:
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
