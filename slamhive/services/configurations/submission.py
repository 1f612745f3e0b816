"""What a request for runs implies: rules without effect, and the protocol."""

from __future__ import annotations

from collections.abc import Iterable

from slamhive.domain.algorithm import Algorithm
from slamhive.schema.limits import StopWhen


def unwatchable(rules: StopWhen, algorithms: Iterable[Algorithm]) -> str | None:
    """Which of the rules cannot be watched for which algorithms, in words; None if all can."""
    silent = sorted({entry.name for entry in algorithms if not entry.package.reports_tracking})
    if rules.lost_tracking_s is None or not silent:
        return None
    does = "does" if len(silent) == 1 else "do"
    return f"lost_tracking_s has no effect on {', '.join(silent)}, which {does} not say which frames are tracked"
