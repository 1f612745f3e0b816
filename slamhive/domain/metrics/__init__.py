"""The metric catalogue: every metric that a run can have, defined once.

Metrics of other packages come in through the entry-point group ``slamhive.metrics``, whose entry points hold a
:class:`Metric` or several of them; ``docs/extend/index.md`` shows one with its evaluator.
"""

from __future__ import annotations

import re
from collections.abc import ItemsView, Iterable, Iterator, Mapping
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.base.registry import Registry
from slamhive.domain.metrics.measured import MEASURED_METRICS
from slamhive.domain.metrics.model import Direction, Group, Metric
from slamhive.domain.metrics.references import MAP_METRICS, REFERENCE_METRICS
from slamhive.domain.metrics.trajectories import TRAJECTORY_METRICS

GROUP = "slamhive.metrics"
"""The entry-point group of metrics from other packages."""
_KEY = re.compile(r"(?!parameter\.|variant\.)[a-z][a-z0-9_]*(\.[a-z0-9_]+)+")
_LONGEST_KEY = 64


def _read(_: str, found: Any) -> Mapping[str, Metric]:
    metrics = [found] if isinstance(found, Metric) else list(found) if isinstance(found, Iterable) else []
    if not metrics or not all(isinstance(entry, Metric) for entry in metrics):
        raise InvalidInput(f"it is neither a Metric nor several of them, but of type {type(found).__name__}")
    for entry in metrics:
        if len(entry.key) > _LONGEST_KEY or not _KEY.fullmatch(entry.key):
            raise InvalidInput(
                f"the metric key {entry.key!r} is not allowed",
                "use two or more parts of small letters, digits and '_', such as 'jerk.mean', 64 characters at most",
            )
        if not entry.needs_protocol:
            raise InvalidInput(f"{entry.key} has needs_protocol=False", "leave that out")
    return {entry.key: entry for entry in metrics}


METRICS: Registry[Metric] = Registry("metric", GROUP, _read)
for _metric in (*TRAJECTORY_METRICS, *REFERENCE_METRICS, *MAP_METRICS, *MEASURED_METRICS):
    METRICS.register(_metric.key, _metric)


class _Catalogue(Mapping[str, Metric]):
    """The metrics by key, in the order in which pages offer them. Plug-ins are loaded on first use."""

    def __getitem__(self, key: str) -> Metric:
        return METRICS.entries[key]

    def __iter__(self) -> Iterator[str]:
        return iter(METRICS.entries)

    def __len__(self) -> int:
        return len(METRICS.entries)

    def items(self) -> ItemsView[str, Metric]:
        """Items of the ``Mapping``, in one look-up: each run that is shown goes through it."""
        return METRICS.entries.items()


CATALOGUE: Mapping[str, Metric] = _Catalogue()


def metric(key: str) -> Metric:
    """The metric called ``key``; raises NotFound with the nearest name, or with what is wrong with its plug-in."""
    return METRICS.get(key)


def described(key: str) -> Metric:
    """The metric called ``key``. One that nothing defines here has its key as label, and no unit.

    Archives and databases hold metrics of plug-ins that are not installed here; they are shown nevertheless.
    """
    known = METRICS.entries.get(key)
    return known or Metric(key, key, "", Direction.NEUTRAL, "The plug-in that defines this metric is not installed.")


def with_unknown(values: Iterable[str]) -> list[Metric]:
    """The metrics with these keys, in the order of the catalogue; those that nothing defines here come last."""
    keys = set(values)
    known = [entry for key, entry in METRICS.entries.items() if key in keys]
    return [*known, *(described(key) for key in sorted(keys - METRICS.entries.keys()))]
