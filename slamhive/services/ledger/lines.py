"""The lines of the ledger, out of what was stored, and back. Many rows of a kind share a line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from operator import attrgetter
from typing import Any

from slamhive.domain.configuration import Configuration
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.domain.protocol import protocol_from_content
from slamhive.domain.variant import Variant
from slamhive.errors import InvalidInput
from slamhive.schema.model import dump
from slamhive.schema.record import ConfigurationContent
from slamhive.schema.submission import StopWhen
from slamhive.services.ledger.book import Book, Line
from slamhive.store.changes import NewRow
from slamhive.store.configuration_records import ConfigurationRecord
from slamhive.store.experiment_records import NewCell, NewConfiguration
from slamhive.store.records import RunRequest

NOT_A_LINE = (InvalidInput, KeyError, TypeError, ValueError, AttributeError, IndexError)
"""What reading a line raises that is none of ours."""


@dataclass(frozen=True, slots=True)
class LedgerConfiguration:
    """A configuration with its number."""

    id: int
    configuration: Configuration
    definitions: tuple[Parameter, ...]
    created_at: datetime


@dataclass(frozen=True, slots=True)
class LedgerRun:
    """A run as it was queued. ``experiment`` is the uid of its experiment; the request names no row of one."""

    id: int
    request: RunRequest
    experiment: str | None
    created_at: datetime


def configuration_lines(rows: Sequence[NewRow[NewConfiguration]]) -> Iterator[Line]:
    """Configurations that were stored together; those with the same definitions share a line."""
    for _, alike in groupby(rows, lambda row: (row.content.algorithm_id, id(row.content.definitions), row.at)):
        part = list(alike)
        parameters = {entry.key: [entry.type.value, entry.unit, entry.general] for entry in part[0].content.definitions}
        yield _configuration_line(part[0].at, parameters, [(row.id, row.content.configuration) for row in part])


def record_line(record: ConfigurationRecord) -> Line:
    """One configuration as it is stored."""
    parameters = {key: [entry.type, entry.unit, entry.general] for key, entry in record.parameters.items()}
    return _configuration_line(record.created_at, parameters, [(record.id, record.configuration)])


def _configuration_line(
    at: datetime, parameters: Mapping[str, Any], configurations: Iterable[tuple[int, Configuration]]
) -> Line:
    return {
        "at": at.isoformat(),
        "parameters": parameters,
        "configurations": (
            [
                number,
                entry.algorithm,
                entry.dataset,
                entry.parameters,  # JSON has tuples as lists, as it should
                entry.playback.mode.value,
                entry.playback.rate,
                dump(Variant, entry.variant),
            ]
            for number, entry in configurations
        ),
    }


def configurations_of(line: Line) -> Iterator[LedgerConfiguration]:
    """The configurations of a line, none if it is of another kind; raises one of :data:`NOT_A_LINE`."""
    for number, algorithm, dataset, values, mode, rate, variant in line.get("configurations", ()):
        request = {
            "algorithm": algorithm,
            "dataset": dataset,
            "parameters": values,
            "playback": {"mode": mode, "rate": rate},
            "variant": variant,
        }
        configuration = ConfigurationContent.read(request).configuration
        definitions = tuple(
            Parameter(str(key), ParameterType(kind), configuration.parameters[key], "", str(unit), general=general)
            for key, (kind, unit, general) in line["parameters"].items()
            if key in configuration.parameters
        )
        yield LedgerConfiguration(int(number), configuration, definitions, moment(line["at"]))


def live_configurations(book: Book) -> dict[int, int]:
    """{configuration: number of the line that states it}; those that were deleted since are left out."""
    last: dict[int, int] = {}
    for number, line in enumerate(book.read()):
        last.update((entry[0], number) for entry in line.get("configurations", ()))
        for gone in line.get("deleted", ()):
            last.pop(gone, None)
    return last


def label_line(record: ConfigurationRecord) -> Line:
    """What users say about a configuration now."""
    return {"label": record.id, "name": record.name, "note": record.note, "groups": list(record.groups)}


def run_lines(rows: Sequence[NewRow[RunRequest]], experiments: Mapping[int, str]) -> Iterator[Line]:
    """Runs that were queued together; those that were asked for alike share a line.

    ``experiments``: {number: uid}.
    """
    alike: dict[tuple[Any, ...], list[NewRow[RunRequest]]] = {}
    for row in rows:
        request = row.content
        key = (row.at, id(request.protocol), id(request.stop_when), *_shared(request))
        alike.setdefault(key, []).append(row)
    for part in alike.values():
        first = part[0].content
        yield {
            "at": part[0].at.isoformat(),
            "request": {
                **{name: getattr(first, name) for name in _SHARED if name != "experiment_id"},
                "experiment": None if first.experiment_id is None else experiments[first.experiment_id],
                "protocol": None if first.protocol is None else first.protocol.content,
                "stop_when": first.stop_when.content,
            },
            "runs": ([row.id, *_own(row.content)] for row in part),
        }


_OWN = ("uid", "configuration_id", "seed", "cell", "retry_of")
_SHARED = tuple(
    name for name in RunRequest.__dataclass_fields__ if name not in (*_OWN, "protocol", "stop_when", "held")
)
"""What is JSON as it is. Whether a run is on hold follows from its experiment."""

_shared, _own = attrgetter(*_SHARED), attrgetter(*_OWN)


def runs_of(line: Line) -> Iterator[LedgerRun]:
    """The runs of a line, none if it is of another kind; raises one of :data:`NOT_A_LINE`."""
    for number, *own in line.get("runs", ()):
        asked = dict(line["request"])
        protocol, experiment = asked.pop("protocol"), asked.pop("experiment")
        request = RunRequest(
            **{
                **asked,
                **dict(zip(_OWN, own, strict=True)),
                "protocol": None if protocol is None else protocol_from_content(protocol),
                "stop_when": StopWhen.of(asked["stop_when"]),
            }
        )
        yield LedgerRun(int(number), request, experiment, moment(line["at"]))


def cell_line(experiment: str, cells: Sequence[NewCell]) -> Line:
    """Cells of the experiment with this uid."""
    return {
        "experiment": experiment,
        "cells": ([cell.number, cell.name, cell.configuration_id, dict(cell.values)] for cell in cells),
    }


def cells_of(line: Line) -> list[NewCell]:
    """The cells of a line, none if it is of another kind; raises one of :data:`NOT_A_LINE`."""
    return [
        NewCell(
            int(number),
            str(name),
            int(configuration),
            {str(axis): tuple(value) if isinstance(value, list) else value for axis, value in values.items()},
        )
        for number, name, configuration, values in line.get("cells", ())
    ]


def moment(text: Any) -> datetime:
    """A time with its UTC offset; raises ValueError or TypeError for anything else."""
    at = datetime.fromisoformat(text)
    if at.tzinfo is None:
        raise ValueError(f"{text} lacks its UTC offset")
    return at
