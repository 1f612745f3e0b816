"""Configurations as a table: number of runs, mean and standard deviation of each metric."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from slamhive.services.exports.table import TableExport, Value
from slamhive.store.records import GroupRecord, ProtocolLabel, Spread

HEAD = ("configuration", "algorithm", "dataset", "parameters", "runs", "failed", "protocol", "disturbed")
_NUMBERS = frozenset({"configuration", "runs", "failed", "disturbed"})
_PARTS = ("mean", "std", "n", "min", "max", "median")


class GroupExport(TableExport[GroupRecord]):
    """One row for each configuration and protocol, with columns such as ``ate.rmse.mean`` and ``ate.rmse.std``.

    Args:
        metrics: Keys of the metrics; the standard deviation of a single run is missing.
    """

    def __init__(self, metrics: Sequence[str]) -> None:
        self._metrics = tuple(metrics)
        figures = [f"{key}.{part}" for key in metrics for part in _PARTS]
        super().__init__((*HEAD, *figures), [name in _NUMBERS for name in HEAD] + [True] * len(figures))

    def cells(self, record: GroupRecord) -> Iterator[tuple[Value, ...]]:
        """One row for each protocol."""
        parameters = json.dumps(record.parameters, sort_keys=True)
        for label, figures in by_protocol(record):
            head = (record.configuration_id, record.algorithm, record.dataset, parameters, record.runs, record.failed)
            values = (value for key in self._metrics for value in _parts(figures.get(key)))
            yield (*head, None if label is None else label.fingerprint, record.disturbed, *values)


def by_protocol(group: GroupRecord) -> Iterator[tuple[ProtocolLabel | None, dict[str, Spread]]]:
    """The metrics under each protocol, or without one, together with those that need no protocol."""
    measured = group.figures.get(None, {})
    labels: list[ProtocolLabel | None] = [label for label in group.figures if label is not None]
    for label in labels or [None]:
        yield label, {**measured, **({} if label is None else group.figures[label])}


def _parts(spread: Spread | None) -> tuple[Value, ...]:
    if spread is None:
        return (None,) * len(_PARTS)
    return spread.mean, spread.std, spread.n, spread.minimum, spread.maximum, spread.median
