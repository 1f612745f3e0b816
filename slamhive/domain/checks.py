"""What a check of a dataset finds: findings with a place and a remedy, and what could not be checked."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

VERSION = 1
"""Raised when checks change, so that reports of before are known to be outdated."""


class Severity(StrEnum):
    """How bad a finding is."""

    ERROR = "error"
    """Results on this dataset will be wrong, or runs will fail."""
    WARNING = "warning"
    """Results may be worse than they should be."""
    NOTE = "note"
    """Worth knowing."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a dataset.

    Attributes:
        check: The check that found it, such as ``gaps``.
        severity: How bad it is.
        about: The sensor, or ``groundtruth``.
        message: What was found, in one sentence.
        remedy: What to do about it.
        topic: The topic of the sensor.
        at_s: Where it is first seen, in s from the start of the recording; None if it is everywhere.
        count: In how many places.
        value: What was measured; None if it is no number.
        unit: The unit of ``value``.
        expected: What was expected instead, in words.
    """

    check: str
    severity: Severity
    about: str
    message: str
    remedy: str
    topic: str | None = None
    at_s: float | None = None
    count: int = 1
    value: float | None = None
    unit: str = ""
    expected: str = ""


@dataclass(frozen=True, slots=True)
class NotChecked:
    """A check that could not be done on ``about``, and why."""

    check: str
    about: str
    reason: str


@dataclass(frozen=True, slots=True)
class CheckReport:
    """The result of all checks of one dataset, worst findings first. ``checks`` are the names of all checks."""

    dataset: str
    checksum: str
    checks: tuple[str, ...]
    findings: tuple[Finding, ...]
    not_checked: tuple[NotChecked, ...]
    version: int = VERSION

    def count(self, severity: Severity) -> int:
        """The number of findings of one severity."""
        return sum(finding.severity == severity for finding in self.findings)
