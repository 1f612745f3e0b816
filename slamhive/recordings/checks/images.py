"""Images: size, encoding, exposure and sharpness of each; stereo and depth; their motion against ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from slamhive.domain.dataset import Finding, NotChecked, Severity
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.collect_images import WIDTH_PX
from slamhive.recordings.checks.evidence import (
    TRUTH,
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
    depth_of,
    depths_by_triangulation,
    doubtful_centre,
    doubtful_view_deg,
    explained_share,
    focal_px,
    matrix,
    misfits,
    typical,
)
from slamhive.recordings.checks.truth import transforms_at, usable_gap_s, usable_poses, with_quats
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import inverse_quats

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


# The motion that images show against ground truth and extrinsics; the scales of depth, stereo and ground truth.
#
# Given the motion of the body and the extrinsics, a point of an image can only reappear on a segment of the next image.
# Where points are elsewhere, although some other motion explains them, ground truth or extrinsics contradict the
# images. The motion has a length too: points of known depth show whether depth, stereo baseline and ground truth have
# one scale.


FEWEST_FOLLOWED, FEWEST_PLACES = 20, 3
LEAST_MOVED_PX = 4.0
"""Median shift of points between the images; with less there is no motion to compare."""
ALLOWED_SHARE, ALLOWED_PX = 0.25, 1.5
"""Distance from where a point can be: that share of its shift, and noise of features in an image of 640 pixels."""
SUSPICIOUS, COLLAPSE = 0.25, 0.5
"""From this share of what is allowed, a mistake is reported that explains at least half of the distance."""
SCALE_RANGE = (0.75, 1.33)
"""Median ratio of two lengths. Units and depth factors are off by 5 at least, baselines in a wrong unit by 10."""
FEWEST_LENGTHS = 30


def camera_and_truth(evidence: DatasetEvidence) -> Findings:
    """Compare each camera's motion with that of the ground truth."""
    poses = usable_poses(evidence)
    for stream in evidence.of_kind(SensorKind.CAMERA):
        if evidence.is_follower(stream):
            continue
        moves = poses if isinstance(poses, str) else _moves(stream, poses)
        if isinstance(poses, str) or isinstance(moves, str):
            yield NotChecked("camera-motion", stream.sensor.name, str(moves))
            yield from _scales(evidence, stream, [], str(moves))
            continue
        wrong = list(_directions(stream, poses, moves))
        yield from wrong
        contradicts = any(isinstance(entry, Finding) for entry in wrong)
        yield from _scales(evidence, stream, [] if contradicts else moves, "the motion contradicts the ground truth")


@dataclass(frozen=True, eq=False)
class _Move:
    """Matches, and the motion between them by ground truth and extrinsics (4, 4)."""

    matches: MatchEvidence
    T_second_first: Array


def _moves(stream: StreamEvidence, poses: Trajectory) -> list[_Move] | str:
    """The places with enough matches, enough motion in the image, and ground truth; or why there are too few."""
    if not stream.motion:
        return "the camera model is not known, or there are too few images"
    least = LEAST_MOVED_PX / focal_px(stream.sensor)
    moving = [
        match
        for match in stream.motion
        if len(match.first) >= FEWEST_FOLLOWED and np.median(np.linalg.norm(match.second - match.first, axis=1)) > least
    ]
    motions = _relative(moving, poses, matrix(stream.sensor.T_body_sensor))
    moves = [_Move(match, T) for match, T in zip(moving, motions, strict=True) if np.isfinite(T).all()]
    return moves if len(moves) >= FEWEST_PLACES else "the image hardly changes where the ground truth has poses"


def _relative(matches: list[MatchEvidence], poses: Trajectory, T_body_camera: Array) -> list[Array]:
    if not matches:
        return []
    gap_s = usable_gap_s(poses)
    first, second = (
        transforms_at(poses, np.array([getattr(match, which) for match in matches]) * 1e-9, gap_s) @ T_body_camera
        for which in ("first_ns", "second_ns")
    )
    return [
        np.linalg.inv(after) @ before
        if np.isfinite(before).all() and np.isfinite(after).all()
        else np.full((4, 4), np.nan)
        for before, after in zip(first, second, strict=True)
    ]


def _excess(moves: list[_Move], sensor: Sensor) -> float:
    """Median over places of the distance of points from where they can be, over what is allowed; 1 is the limit."""
    ratios = []
    focal = focal_px(sensor)
    noise_px = ALLOWED_PX * max(1.0, calibrated(sensor, "width") / WIDTH_PX)
    for move in moves:
        first, second = move.matches.first, move.matches.second
        apart_px = typical(misfits(first, second, move.T_second_first)) * focal
        shift_px = float(np.median(np.linalg.norm(second - first, axis=1))) * focal
        ratios.append(apart_px / (noise_px + ALLOWED_SHARE * shift_px))
    return float(np.median(ratios))


def _directions(stream: StreamEvidence, poses: Trajectory, moves: list[_Move]) -> Findings:
    name = stream.sensor.name
    excess = _excess(moves, stream.sensor)
    if excess <= SUSPICIOUS:
        return
    known = _explanation(stream.sensor, poses, [move.matches for move in moves], COLLAPSE * excess)
    if known is None and excess <= 1.0:
        return
    tolerance = 2 * ALLOWED_PX / focal_px(stream.sensor)
    explained = [explained_share(move.matches.first, move.matches.second, tolerance) for move in moves]
    if float(np.median(explained)) < EXPLAINED:
        yield NotChecked("camera-motion", name, "the matches between the images contradict each other")
        return
    about, what, remedy = known or (
        name,
        "the extrinsics are wrong",
        "correct T_body_sensor in dataset.yaml, or the frame of the ground truth",
    )
    yield Finding(
        "camera-motion" if about == name else "truth-orientation",
        Severity.ERROR,
        about,
        f"The images of {name} move otherwise than ground truth and extrinsics say: {what}.",
        remedy,
        topic=stream.sensor.topic if about == name else None,
        value=min(excess, 1e6),
        unit="times the allowed distance",
        expected="at most 1",
    )


def _explanation(
    sensor: Sensor, poses: Trajectory, matches: list[MatchEvidence], most: float
) -> tuple[str, str, str] | None:
    """Subject of a contradiction, the mistake that lowers it to ``most``, and the remedy; None without one."""
    T_body_camera = matrix(sensor.T_body_sensor)
    wxyz = with_quats(poses, np.roll(poses.quats_xyzw, -1, axis=1))
    inverse = with_quats(poses, inverse_quats(poses.quats_xyzw))
    tried = [
        (poses, np.linalg.inv(T_body_camera), sensor.name, "T_body_sensor is inverted", "invert it in dataset.yaml"),
        (wxyz, T_body_camera, TRUTH, "its quaternions are in the order w x y z", "write qx qy qz qw in its file"),
        (inverse, T_body_camera, TRUTH, "its orientations are inverted", "invert them in its file"),
        (
            poses,
            np.eye(4),
            sensor.name,
            "the ground truth is that of the camera",
            "write the identity as T_body_sensor",
        ),
    ]
    remedy = "turn T_body_sensor in dataset.yaml"
    # The 23 rotations that turn axes onto axes, without the identity.
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.eye(4)
        turn[:3, :3] = np.diag(signs)[:, order]
        if np.linalg.det(turn) < 0 or np.array_equal(turn, np.eye(4)):
            continue
        angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(turn[:3, :3]) - 1) / 2, -1.0, 1.0)))
        what = f"the camera is turned by about {angle_deg:.0f} deg"
        tried.append((poses, turn @ T_body_camera, sensor.name, what, remedy))
    for other, T, about, what, remedy in tried:
        motions = _relative(matches, other, T)
        moves = [_Move(match, motion) for match, motion in zip(matches, motions, strict=True)]
        if _excess(moves, sensor) <= most:
            return about, what, remedy
    return None


def _scales(evidence: DatasetEvidence, stream: StreamEvidence, moves: list[_Move], reason: str) -> Findings:
    """Compare the lengths that depth images, stereo baseline and ground truth give for the same points."""
    depth = depth_of(stream.sensor, evidence.dataset)
    by_motion = [
        (move, depths_by_triangulation(move.matches.first, move.matches.second, move.T_second_first)) for move in moves
    ]
    depth_over_truth = _ratio([(_metres(move.matches, depth), Z) for move, Z in by_motion])
    stereo_over_truth = _ratio([(move.matches.stereo_depths_m, Z) for move, Z in by_motion])
    depth_over_stereo = _ratio([(_metres(match, depth), match.stereo_depths_m) for match in stream.motion])
    if depth is not None:
        # Stereo and ground truth tell of the depth only where they agree with each other.
        if depth_over_truth is None and depth_over_stereo is None:
            yield NotChecked("depth-scale", depth.name, "too few points have a depth and move enough")
        elif depth_over_stereo is not None and _off(depth_over_stereo) and not _off(stereo_over_truth):
            yield _scale_finding("depth-scale", depth.name, depth_over_stereo, "the stereo baseline")
        elif depth_over_stereo is None and depth_over_truth is not None and _off(depth_over_truth):
            yield _scale_finding("depth-scale", depth.name, depth_over_truth, "the ground truth")
    if stereo_over_truth is None and depth_over_truth is None:
        yield NotChecked("truth-scale", TRUTH, reason if not moves else "too few points have a depth and move enough")
    elif _off(stereo_over_truth) and (depth_over_truth is None or _off(depth_over_truth)):
        yield _scale_finding("truth-scale", TRUTH, 1.0 / (stereo_over_truth or 1.0), "the stereo baseline")
    elif _off(stereo_over_truth) and stream.partner is not None:
        yield _scale_finding("stereo-scale", stream.partner.name, stereo_over_truth or 1.0, "depth and ground truth")


def _scale_finding(check: str, about: str, ratio: float, other: str) -> Finding:
    remedy = {
        "depth-scale": "correct units_per_m in dataset.yaml (1000 for mm, 5000 for TUM RGB-D)",
        "truth-scale": "write the positions of the ground truth in metres",
        "stereo-scale": "correct the baseline in T_body_sensor, in metres",
    }[check]
    what = {"depth-scale": "Depths", "truth-scale": "Motions of the ground truth", "stereo-scale": "Stereo depths"}[
        check
    ]
    return Finding(
        check,
        Severity.ERROR,
        about,
        f"{what} are {ratio:.3g} times those by {other}.",
        remedy,
        value=ratio,
        unit="times",
        expected=f"{SCALE_RANGE[0]} to {SCALE_RANGE[1]}",
    )


def _off(ratio: float | None) -> bool:
    return ratio is not None and not SCALE_RANGE[0] <= ratio <= SCALE_RANGE[1]


def _metres(match: MatchEvidence, depth: Sensor | None) -> Array | None:
    if depth is None or match.depths_raw is None:
        return None
    return np.where(match.depths_raw > 0, match.depths_raw / calibrated(depth, "units_per_m"), np.nan)


def _ratio(pairs: list[tuple[Array | None, Array | None]]) -> float | None:
    """Median ratio of the first to the second depths of all points that have both; None if there are few."""
    ratios = [first / second for first, second in pairs if first is not None and second is not None]
    known = np.concatenate(ratios) if ratios else np.zeros(0)
    known = known[np.isfinite(known) & (known > 0)]
    return float(np.median(known)) if len(known) >= FEWEST_LENGTHS else None
