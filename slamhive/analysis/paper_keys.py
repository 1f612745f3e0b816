"""Keys and values of published analysis files in the language of filters and columns."""

from __future__ import annotations

import json
from collections.abc import Sequence

_STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")
_PREFIXES = {
    "dataset_resolution": "variant.resolution.scale",
    "dataset_frequency": "variant.rate.every",
}
_SEEN = {
    "image_width": "image_width",
    "image_height": "image_height",
    "image_frequency": "image_rate_hz",
    "imu_frequency": "imu_rate_hz",
}
"""Columns that say what a run saw, by the general names of parameters that said so."""


def our_key(name: str) -> str:
    """The key of a metric or parameter of the published system.

    ``ate_rmse`` is ``ate.rmse``; in ``general+nFeatures``, the name of the parameter follows the plus sign. Size and
    rate of images are columns of their own, because datasets and steps give them here.
    """
    kind, _, statistic = name.partition("_")
    if (kind in {"ate", "rpe"} and statistic in _STATISTICS) or name in {"cpu_mean", "cpu_max", "ram_max"}:
        return f"{kind}.{statistic}"
    prefix, plus, rest = name.partition("+")
    return _PREFIXES.get(prefix, _SEEN.get(rest, rest)) if plus else name


def any_of(key: str, names: Sequence[str]) -> str:
    """A filter for runs with any of these names."""
    return "(" + " or ".join(f"{key} = {quoted(name)}" for name in names) + ")"


def quoted(value: str) -> str:
    """A value in the filter language: numbers and plain words as they are, all others in quotes."""
    try:
        float(value)
    except ValueError:
        plain = value.replace("_", "").replace("-", "").replace(".", "").isalnum()
        return value if plain else json.dumps(value, ensure_ascii=False)
    return value
