"""Checks a dataset: one pass over its recording, then every check on what the pass collected."""

from __future__ import annotations

from slamhive.bags.staging import Progress
from slamhive.checks.collect import collect
from slamhive.checks.evidence import Evidence
from slamhive.checks.registry import CHECKS, EXPLAINS, NAMES
from slamhive.domain.checks import CheckReport, Finding, NotChecked, Severity
from slamhive.domain.dataset import Dataset


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


def judge(evidence: Evidence) -> CheckReport:
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
