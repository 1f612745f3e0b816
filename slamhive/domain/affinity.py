"""Which runs are better done one after the other: those that share a variant of a dataset, and among them an image."""

from __future__ import annotations

import hashlib
import json

from slamhive.domain.variant import Variant, variant_to_json

_DATA_DIGITS = 16
_PACKAGE_DIGITS = 8
_BETWEEN = "-"
_AFTER = chr(ord(_BETWEEN) + 1)


def run_affinity(dataset: str, variant: Variant, package: str) -> str:
    """25 characters: equal for runs that see the same data with the same package.

    The first part contains dataset and variant only, so that runs of other packages on the same data are near.
    """
    data = _digest([dataset, variant_to_json(variant)])[:_DATA_DIGITS]
    return f"{data}{_BETWEEN}{_digest(package)[:_PACKAGE_DIGITS]}"


def same_data(affinity: str) -> tuple[str, str]:
    """The affinities of all runs that see the same data: at least the first, below the second."""
    data = affinity[:_DATA_DIGITS]
    return data + _BETWEEN, data + _AFTER


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
