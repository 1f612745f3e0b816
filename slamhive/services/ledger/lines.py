"""Writing what was stored as lines of the ledger, and reading it again. Rows that were stored together share a line."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from operator import attrgetter
from typing import Any

from slamhive.domain.configuration import Configuration, InputMap
from slamhive.domain.parameters import Parameter
from slamhive.domain.variant import Variant
from slamhive.domain.visibility import NOT_SHARED, Sharing
from slamhive.errors import InvalidInput
from slamhive.schema.ledger import (
    CancelledLine,
    CellRow,
    CellsLine,
    ConfigurationRow,
    ConfigurationsLine,
    LabelLine,
    RunRow,
    RunsLine,
    SharedLine,
    SharedRequest,
)
from slamhive.schema.model import dump
from slamhive.schema.types import defined
from slamhive.services.ledger.book import Book, Line
from slamhive.store.changes import NewRow
from slamhive.store.configuration_records import ConfigurationRecord
from slamhive.store.experiment_records import NewCell, NewConfiguration
from slamhive.store.records import RunRequest

logger = logging.getLogger(__name__)

NOT_A_LINE = (InvalidInput, KeyError, TypeError, ValueError, AttributeError, IndexError)
"""What reading a damaged line may raise."""


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
        definitions = {entry.key: entry for entry in part[0].content.definitions}
        yield _configuration_line(part[0].at, definitions, [(row.id, row.content.configuration) for row in part])


def record_line(record: ConfigurationRecord) -> Line:
    """One configuration as it is stored."""
    return _configuration_line(record.created_at, record.parameters, [(record.id, record.configuration)])


def _configuration_line(
    at: datetime, definitions: Mapping[str, Any], configurations: Iterable[tuple[int, Configuration]]
) -> Line:
    rows = (
        ConfigurationRow(
            number,
            entry.algorithm,
            entry.dataset,
            dict(entry.parameters),
            entry.playback.mode,
            entry.playback.rate,
            dump(Variant, entry.variant),
            dict(entry.sensors),
            *_since_versions(entry),
        )
        for number, entry in configurations
    )
    return {**ConfigurationsLine(at=at, parameters=definitions).content, "configurations": rows}


def _since_versions(entry: Configuration) -> tuple[Any, ...]:
    """Version and map of a configuration, which rows of before did not have and few have now."""
    return () if entry.version is None and entry.map is None else (entry.version, dump(InputMap | None, entry.map))


def configurations_of(line: Line) -> Iterator[LedgerConfiguration]:
    """The configurations of a line, none if it is of another kind; raises InvalidInput."""
    if "configurations" in line:
        stated = ConfigurationsLine.read(line)
        for row in stated.configurations:
            definitions = defined(stated.parameters, row.parameters)
            yield LedgerConfiguration(row.id, row.configuration, definitions, stated.at)


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
    return LabelLine.of(record, label=record.id).content


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
        experiment = None if first.experiment_id is None else experiments[first.experiment_id]
        line = RunsLine(at=part[0].at, request=SharedRequest.of(first, experiment=experiment))
        yield {**line.content, "runs": ([row.id, *_own(row.content)] for row in part)}


_OWN = RunRow._fields[1:]
_SHARED = tuple(
    name for name in RunRequest.__dataclass_fields__ if name not in (*_OWN, "protocol", "stop_when", "held")
)
"""What can be compared as it is. Whether a run is on hold follows from its experiment."""

_shared, _own = attrgetter(*_SHARED), attrgetter(*_OWN)


def runs_of(line: Line) -> Iterator[LedgerRun]:
    """The runs of a line, none if it is of another kind; raises InvalidInput."""
    if "runs" in line:
        stated = RunsLine.read(line)
        shared: dict[str, Any] = dict(stated.request)
        experiment = shared.pop("experiment")
        for number, *own in stated.runs:
            distinct: dict[str, Any] = dict(zip(_OWN, own, strict=True))
            request = RunRequest(**shared, **distinct)
            yield LedgerRun(number, request, experiment, stated.at)


def cell_line(experiment: str, cells: Sequence[NewCell]) -> Line:
    """Cells of the experiment with this uid."""
    rows = (CellRow(cell.number, cell.name, cell.configuration_id, dict(cell.values)) for cell in cells)
    return {"experiment": experiment, "cells": rows}


def cells_of(line: Line) -> list[NewCell]:
    """The cells of a line, none if it is of another kind; raises InvalidInput."""
    return [NewCell(*row) for row in CellsLine.read(line).cells]


def cancelled_line(run_ids: Sequence[int], at: datetime, why: str) -> Line:
    """Runs that were cancelled before they had a folder."""
    return CancelledLine(cancelled=tuple(run_ids), at=at, why=why).content


def shared_line(run_ids: Sequence[int], sharing: Sharing) -> Line:
    """Runs without a folder, with their owner and visibility from now on."""
    return SharedLine(shared=tuple(run_ids), owner=sharing.owner, visibility=sharing.visibility).content


def last_shared(book: Book) -> dict[int, Sharing]:
    """{run: owner and visibility} as they were stated last of runs that had no folder.

    Only admins see the runs of a line that somebody has damaged, as those of a damaged ``sharing.json``.
    """
    found: dict[int, Sharing] = {}
    for line in book.read():
        if "shared" not in line:
            continue
        try:
            stated = SharedLine.read(line)
            sharing = Sharing.of({"owner": stated.owner, "visibility": stated.visibility})
            found.update(dict.fromkeys(stated.shared, sharing))
        except InvalidInput as error:
            logger.warning("%s: a line on who sees runs cannot be used, so only admins see them: %s", book.path, error)
            numbers = line["shared"] if isinstance(line["shared"], list) else []
            found.update((number, NOT_SHARED) for number in numbers if isinstance(number, int))
    return found
