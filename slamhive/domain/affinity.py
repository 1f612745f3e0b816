"""Which runs should follow each other: those with the same variant of a dataset, and among them the same image."""

from __future__ import annotations

import hashlib
import json

from slamhive.domain.variant import Variant

_DATA_DIGITS = 16
_PACKAGE_DIGITS = 8
_BETWEEN = "-"
_AFTER = chr(ord(_BETWEEN) + 1)


def run_affinity(dataset: str, variant: Variant, package: str) -> str:
    """25 characters that are equal for runs of one package on the same data.

    The first part depends on dataset and variant only, so that runs of other packages on the same data sort next to it.
    """
    steps = [{"kind": step.kind, "sensors": step.sensors, "options": step.options} for step in variant]
    data = _digest([dataset, steps])[:_DATA_DIGITS]
    return f"{data}{_BETWEEN}{_digest(package)[:_PACKAGE_DIGITS]}"


def same_data(affinity: str) -> tuple[str, str]:
    """Bounds of the affinities of all runs on the same data: at least the first, below the second."""
    data = affinity[:_DATA_DIGITS]
    return data + _BETWEEN, data + _AFTER


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
