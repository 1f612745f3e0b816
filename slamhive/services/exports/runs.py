"""Runs as a table: selected columns, parameters and metrics."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from slamhive.domain.disturbance import Disturbance
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.trust import Trust
from slamhive.errors import unknown
from slamhive.search.fields import PARAMETER_PREFIX, Kind, Vocabulary
from slamhive.services.exports.table import TableExport, Value
from slamhive.services.json_values import timestamp
from slamhive.store.records import RunRecord

_COLUMNS: dict[str, Callable[[RunRecord], Value]] = {
    "id": lambda run: run.id,
    "algorithm": lambda run: run.algorithm,
    "version": lambda run: run.version_label,
    "dataset": lambda run: run.dataset,
    "trajectory": lambda run: run.trajectory,
    "variant": lambda run: "; ".join(map(str, run.variant)) or None,
    "parameters": lambda run: json.dumps(run.parameters, sort_keys=True),
    "configuration": lambda run: run.configuration_id,
    "experiment": lambda run: run.experiment,
    "executor": lambda run: run.executor,
    "playback": lambda run: f"{run.playback.mode.value} {run.playback.rate:g}",
    "seed": lambda run: run.seed,
    "state": lambda run: run.state.value,
    "reason": lambda run: None if run.reason is None else run.reason.value,
    "verdict": lambda run: None if run.verdict is None else run.verdict.kind.value,
    "trust": lambda run: trust_text(run.trust),
    "disturbed": lambda run: disturbed_text(run.disturbance),
    "owner": lambda run: run.owner,
    "visibility": lambda run: run.seen_by.value,
    "tags": lambda run: ", ".join(run.tags) or None,
    "note": lambda run: run.note,
    "created_at": lambda run: timestamp(run.created_at),
    "started_at": lambda run: timestamp(run.started_at),
    "ended_at": lambda run: timestamp(run.ended_at),
    "protocol": lambda run: None if run.protocol is None else run.protocol.fingerprint,
}


def disturbed_text(found: Disturbance | None) -> str | None:
    """``yes`` or ``no``; None if unknown."""
    return None if found is None else {True: "yes", False: "no", None: None}[found.disturbed]


def trust_text(found: Trust | None) -> str | None:
    """The level of trust; None if unknown."""
    return None if found is None or found.level is None else found.level.value


class RunExport(TableExport[RunRecord]):
    """Values of the selected columns.

    Args:
        columns: Keys of columns, metrics and parameters; raises NotFound for an unknown one.
        vocabulary: The known parameters.
    """

    def __init__(self, columns: Sequence[str], vocabulary: Vocabulary) -> None:
        self._readers = [_reader(key, vocabulary) for key in columns]
        super().__init__(columns, [_is_number(key, vocabulary) for key in columns])

    def cells(self, record: RunRecord) -> Iterator[tuple[Value, ...]]:
        """One row for each run."""
        yield tuple(read(record) for read in self._readers)


def _reader(key: str, vocabulary: Vocabulary) -> Callable[[RunRecord], Value]:
    if key in _COLUMNS:
        return _COLUMNS[key]
    if key in CATALOGUE:
        return lambda run: (run.metrics or {}).get(key)
    name = key.removeprefix(PARAMETER_PREFIX)
    if name not in vocabulary.parameters:
        raise unknown("column", key, [*_COLUMNS, *CATALOGUE, *vocabulary.parameters])
    own_keys = vocabulary.own_keys.get(name, (name,))
    return lambda run: _plain(run.parameters, own_keys)


def _plain(parameters: Mapping[str, Any], own_keys: Sequence[str]) -> Value:
    value = next((parameters[key] for key in own_keys if key in parameters), None)
    return json.dumps(value) if isinstance(value, tuple) else value


def _is_number(key: str, vocabulary: Vocabulary) -> bool:
    if key in _COLUMNS:
        return key in {"id", "configuration", "seed"}
    if key in CATALOGUE:
        return True
    return all(entry.kind is Kind.NUMBER for entry in vocabulary.parameters[key.removeprefix(PARAMETER_PREFIX)])
