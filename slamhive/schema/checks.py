"""The report of the checks of a dataset, as JSON."""

from __future__ import annotations

from typing import Annotated

from slamhive.domain import checks as domain
from slamhive.schema.fields import described
from slamhive.schema.model import Document


class Finding(Document):
    """One thing that is wrong with a dataset."""

    check: Annotated[str, described("The check that found it.")]
    severity: Annotated[domain.Severity, described("How bad it is.")]
    about: Annotated[str, described("The sensor, groundtruth or recording.")]
    topic: Annotated[str | None, described("The topic of the sensor.")]
    message: Annotated[str, described("What was found.")]
    remedy: Annotated[str, described("What to do about it.")]
    at_s: Annotated[float | None, described("First place, from the start; null: everywhere.", unit="s")]
    count: Annotated[int, described("In how many places.")]
    value: Annotated[float | None, described("What was measured; null if it is no number.")]
    unit: Annotated[str, described("The unit of the value.")]
    expected: Annotated[str, described("What was expected instead.")]


class NotChecked(Document):
    """A check that could not be done."""

    check: Annotated[str, described("The check.")]
    about: Annotated[str, described("The sensor, or what else it is about.")]
    reason: Annotated[str, described("Why it was not done.")]


class DatasetCheck(Document):
    """The result of all checks of one dataset."""

    dataset: str
    checksum: Annotated[str, described("Of the dataset that was checked.")]
    files: Annotated[str, described("Identifies dataset.yaml and the ground truth that were checked.")]
    version: Annotated[int, described("Of the checks; reports of other versions are outdated.")]
    checks: Annotated[tuple[str, ...], described("The names of all checks.")]
    findings: Annotated[tuple[Finding, ...], described("The worst first.")]
    not_checked: Annotated[tuple[NotChecked, ...], described("What could not be checked, and why.")]

    def count(self, severity: domain.Severity) -> int:
        """The number of findings of one severity."""
        return sum(finding.severity == severity for finding in self.findings)
