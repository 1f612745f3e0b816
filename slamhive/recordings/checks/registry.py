"""All checks, in the order in which their findings are listed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from slamhive.domain.dataset import CheckReport, Dataset, Finding, NotChecked, Severity
from slamhive.recordings.checks import images, inertial, sweeps, timestamps, truth
from slamhive.recordings.checks.collect import collect
from slamhive.recordings.checks.evidence import DatasetEvidence, Findings
from slamhive.recordings.staging import Progress


@dataclass(frozen=True, slots=True)
class Check:
    """A function that judges evidence, and the names of what it checks."""

    names: tuple[str, ...]
    run: Callable[[DatasetEvidence], Findings]


CHECKS = (
    Check(("topics",), timestamps.topics),
    Check(("spans",), timestamps.spans),
    Check(("rates",), timestamps.rates),
    Check(("order",), timestamps.order),
    Check(("duplicates",), timestamps.duplicates),
    Check(("gaps",), timestamps.gaps),
    Check(("clock-jumps",), timestamps.clock_jumps),
    Check(("clocks",), timestamps.clocks),
    Check(truth.CHECKS, truth.ground_truth),
    Check(("gravity",), inertial.gravity),
    Check(("imu-rates",), inertial.angular_rates),
    Check(inertial.CHECKS, inertial.imu_and_truth),
    Check(("image-size", "image-encoding"), images.image_size),
    Check(("intrinsics",), images.intrinsics),
    Check(("image-dark", "image-saturated"), images.exposure),
    Check(("image-blur",), images.sharpness),
    Check(("image-frozen",), images.frozen),
    Check(("stereo-partners", "stereo-sync"), images.synchronisation),
    Check(("stereo-geometry",), images.epipolar),
    Check(("camera-motion", "stereo-scale", "truth-scale"), images.camera_and_truth),
    Check(("depth-values", "depth-scale"), images.depth_values),
    Check(("lidar-empty",), sweeps.empty_sweeps),
    Check(("lidar-ranges",), sweeps.ranges),
    Check(("lidar-point-times",), sweeps.point_times),
    Check(("lidar-direction",), sweeps.direction),
    Check(("lidar-stamp",), sweeps.meaning_of_timestamp),
    Check(("lidar-motion",), sweeps.lidar_and_truth),
)

EXPLAINS: dict[str, tuple[str, ...]] = {
    "clock-jumps": ("clocks", "spans"),
    "image-size": ("intrinsics",),
    "imu-rates": ("imu-axes",),
    "imu-units": ("imu-rates",),
    "stereo-geometry": ("depth-scale", "stereo-scale", "truth-scale"),
    "truth-scale": ("lidar-motion",),
    "truth-orientation": ("camera-motion", "gravity-direction", "imu-axes", "lidar-motion"),
}
"""Findings that follow from another one. They are listed as not checked, so that the cause stands out."""

NAMES = tuple(dict.fromkeys(name for check in CHECKS for name in check.names))


# Checks a dataset: one pass over its recording, then every check on what the pass collected.


def check_dataset(dataset: Dataset, progress: Progress) -> CheckReport:
    """Check ``dataset``.

    Raises:
        InvalidInput: it has no recording, or the recording is damaged.
    """
    evidence = collect(dataset, progress)
    progress(0.95, "checking")
    report = judge(evidence)
    progress(1.0, "done")
    return report


def judge(evidence: DatasetEvidence) -> CheckReport:
    """Every check on ``evidence``; of findings with one name about one sensor, the first stands for all."""
    results = [result for check in CHECKS for result in check.run(evidence)]
    findings: dict[tuple[str, str], Finding] = {}
    for result in results:
        if isinstance(result, Finding):
            findings.setdefault((result.check, result.about), result)
    causes = {other: name for name, others in EXPLAINS.items() for other in others if _among(name, findings)}
    not_checked = [result for result in results if isinstance(result, NotChecked)]
    not_checked += [
        NotChecked(finding.check, finding.about, f"it follows from {causes[finding.check]}: {finding.message}")
        for finding in findings.values()
        if finding.check in causes
    ]
    severities = list(Severity)
    kept = [finding for finding in findings.values() if finding.check not in causes]
    return CheckReport(
        dataset=evidence.dataset.name,
        checksum=evidence.dataset.checksum,
        checks=NAMES,
        findings=tuple(sorted(kept, key=lambda finding: severities.index(finding.severity))),
        not_checked=tuple(not_checked),
    )


def _among(name: str, findings: dict[tuple[str, str], Finding]) -> bool:
    return any(check == name for check, _ in findings)
