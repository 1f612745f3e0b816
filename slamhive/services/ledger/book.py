"""Files of the ledger: JSON lines that any process appends to, sometimes replaced as a whole, and their content."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import stat
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import make_shared_folder, remedy_of, write_aside
from slamhive.documents.archive import (
    AskedLine,
    CancelledLine,
    CellRow,
    CellsLine,
    ConfigurationsLine,
    EndedLine,
    LabelLine,
    LedgerConfigurationLine,
    RunRow,
    RunsLine,
    SharedLine,
    SharedRequest,
)
from slamhive.documents.model import defined, dump
from slamhive.domain.accounts import NOT_SHARED, Sharing
from slamhive.domain.configuration import Configuration, InputMap, Variant
from slamhive.domain.parameters import Parameter
from slamhive.domain.protocol import Protocol
from slamhive.evaluation.job import Artefacts
from slamhive.store.changes import AskedEvaluations, NewRow
from slamhive.store.configuration_listing import ConfigurationRecord
from slamhive.store.records import CellRecord, EndedEvaluation, EvaluationState, NewConfiguration, RunRequest

logger = logging.getLogger(__name__)

Line = dict[str, Any]
"""An object. A value that is an iterator is written as a list, entry by entry, to save memory."""

_encode = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode


class Book:
    """A file of lines. Readers skip a line that a kill or a full disk has truncated.

    Args:
        path: The file, created with its first line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, lines: Iterable[Line]) -> None:
        """Append lines, all or none; raises Unavailable."""
        text = "".join(map(_text, lines)).encode()
        if not text:
            return
        try:
            with self._held() as descriptor:
                end = os.lseek(descriptor, 0, os.SEEK_END)
                cut_off = end > 0 and os.pread(descriptor, 1, end - 1) != b"\n"
                try:
                    _write(descriptor, b"\n" + text if cut_off else text)
                    os.fsync(descriptor)
                except OSError:
                    os.ftruncate(descriptor, end)
                    raise
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None

    def read(self) -> Iterator[Line]:
        """All complete lines, oldest first; raises Unavailable."""
        try:
            with self.path.open("rb") as stream:
                for number, text in enumerate(stream, start=1):
                    line = _decoded(text)
                    if line is not None:
                        yield line
                    elif text.strip():
                        logger.warning("line %d of %s is incomplete and is skipped", number, self.path)
        except FileNotFoundError:
            return
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be read: {error.strerror}", "check rights") from None

    @contextmanager
    def replaced(self) -> Iterator[list[Line]]:
        """Lock the file for the block, then replace its lines by those of the yielded list."""
        lines: list[Line] = []
        try:
            with self._held() as descriptor:
                yield lines
                write_aside(self.path, "".join(map(_text, lines)), stat.S_IMODE(os.fstat(descriptor).st_mode))
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None

    @contextmanager
    def _held(self) -> Iterator[int]:
        """The file, open and locked; the kernel releases the lock when the process dies."""
        while True:
            descriptor = self._open()
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                try:
                    same = os.path.samestat(os.fstat(descriptor), os.lstat(self.path))
                except FileNotFoundError:
                    same = False
                if not same:
                    continue  # replaced while this process waited for the lock
                yield descriptor
                return
            finally:
                os.close(descriptor)

    def _open(self) -> int:
        make_shared_folder(self.path.parent)
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            return os.open(self.path, flags)
        except FileNotFoundError:
            descriptor = os.open(self.path, flags | os.O_CREAT, 0o644)
            # A web server and a worker of different users share the folder through its group.
            if self.path.parent.stat().st_mode & stat.S_IWGRP:
                os.fchmod(descriptor, 0o664)
            return descriptor


def _text(line: Line) -> str:
    parts = []
    for key, value in line.items():
        encoded = f"[{','.join(map(_encode, value))}]" if isinstance(value, Iterator) else _encode(value)
        parts.append(f"{_encode(key)}:{encoded}")
    return f"{{{','.join(parts)}}}\n"


def _write(descriptor: int, text: bytes) -> None:
    view = memoryview(text)
    while view:
        view = view[os.write(descriptor, view) :]


def _decoded(text: bytes) -> Line | None:
    try:
        line = json.loads(text)
    except ValueError:
        return None
    return line if isinstance(line, dict) else None


class LedgerFiles:
    """``<data>/ledger/``.

    Args:
        folder: The folder, created with its first line.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def configurations(self) -> Book:
        """Configurations with their numbers, labels, and deletions."""
        return Book(self.folder / "configurations.jsonl")

    @property
    def runs(self) -> Book:
        """Queued runs, and cancellations."""
        return Book(self.folder / "runs.jsonl")

    @property
    def cells(self) -> Book:
        """Cells of experiments, and the number of cells and runs of each."""
        return Book(self.folder / "cells.jsonl")

    @property
    def evaluations(self) -> Book:
        """Requested evaluations, and how they ended."""
        return Book(self.folder / "evaluations.jsonl")

    @property
    def catalogue(self) -> Book:
        """Algorithms with their versions, and datasets; a small file that is always replaced."""
        return Book(self.folder / "catalogue.jsonl")

    @property
    def searches(self) -> Book:
        """Saved searches; a small file that is always replaced."""
        return Book(self.folder / "searches.jsonl")


# -- what was stored as lines, and lines read again; rows that were stored together share a line -----------------------

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
    variants: dict[int, Any] = {}  # an experiment has few, and the configurations keep them

    def steps(variant: Variant) -> Any:
        if id(variant) not in variants:
            variants[id(variant)] = dump(Variant, variant)
        return variants[id(variant)]

    rows = (
        LedgerConfigurationLine(
            number,
            entry.algorithm,
            entry.dataset,
            dict(entry.parameters),
            entry.playback.mode,
            entry.playback.rate,
            steps(entry.variant),
            dict(entry.sensors),
            # Version and map: rows of before have neither, and few have them now.
            *(() if entry.version is None and entry.map is None else (entry.version, dump(InputMap | None, entry.map))),
        )
        for number, entry in configurations
    )
    return {**ConfigurationsLine(at=at, parameters=definitions).content, "configurations": rows}


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
    """Line with the current notes of users on a configuration."""
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


def cell_line(experiment: str, cells: Sequence[CellRecord]) -> Line:
    """Cells of the experiment with this uid."""
    rows = (CellRow(cell.number, cell.name, cell.configuration_id, dict(cell.values)) for cell in cells)
    return {"experiment": experiment, "cells": rows}


def cells_of(line: Line) -> list[CellRecord]:
    """The cells of a line, none if it is of another kind; raises InvalidInput."""
    return [CellRecord(*row) for row in CellsLine.read(line).cells]


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


# Evaluations.

Key = tuple[int, str, datetime]
"""Run, protocol fingerprint and time of the request, which together identify an evaluation."""


@dataclass
class LedgerEvaluations:
    """All evaluations of the ledger: those ``asked`` for, with protocols, and those that have ``ended``, by run.

    ``asked`` holds what each leaves, and whether it makes its protocol the current one.
    """

    protocols: dict[str, Protocol] = field(default_factory=dict)
    asked: dict[Key, tuple[Artefacts, bool]] = field(default_factory=dict)
    ended: dict[int, dict[Key, EndedEvaluation]] = field(default_factory=lambda: defaultdict(dict))

    def open(self) -> list[AskedEvaluations]:
        """Requested evaluations that have not ended, grouped as they were requested, oldest first."""
        together: dict[tuple[datetime, str, tuple[Artefacts, bool]], list[int]] = defaultdict(list)
        for (run_id, fingerprint, at), how in self.asked.items():
            if (run_id, fingerprint, at) not in self.ended.get(run_id, ()):
                together[at, fingerprint, how].append(run_id)
        return [
            AskedEvaluations(self.protocols[fingerprint], artefacts, at, run_ids, makes_current)
            for (at, fingerprint, (artefacts, makes_current)), run_ids in sorted(
                together.items(), key=lambda entry: entry[0][0]
            )
        ]

    def of(self, run_id: int) -> list[EndedEvaluation]:
        """The ended evaluations of a run, in the order of their requests."""
        return sorted(self.ended.get(run_id, {}).values(), key=lambda entry: entry.created_at)


def asked_line(asked: AskedEvaluations) -> Line:
    """One line for evaluations that were queued together."""
    return AskedLine.of(asked, asked=asked.run_ids).content


def ended_lines(found: Mapping[int, Sequence[EndedEvaluation]]) -> Iterator[Line]:
    """Lines for ended evaluations, by run; the line of the request holds the protocol."""
    for run_id, entries in found.items():
        for entry in entries:
            times = (entry.created_at, entry.started_at, entry.ended_at)
            yield EndedLine.of(entry, ended=run_id, protocol=entry.protocol.fingerprint, times=times).content


def read_evaluations(lines: Iterable[Line]) -> LedgerEvaluations:
    """Read all evaluations in ``lines``; malformed lines are skipped."""
    found = LedgerEvaluations()
    for line in lines:
        try:
            _read(line, found)
        except NOT_A_LINE as error:
            logger.warning("a malformed line of an evaluation is skipped: %r", error)
    return found


def _read(line: Line, found: LedgerEvaluations) -> None:
    if "asked" in line:
        asked = AskedLine.read(line)
        found.protocols[asked.protocol.fingerprint] = asked.protocol
        for run_id in asked.asked:
            how = (Artefacts(asked.artefacts), asked.makes_current)
            found.asked[run_id, asked.protocol.fingerprint, asked.at] = how
        return
    ended = EndedLine.read(line)
    created_at, started_at, ended_at = ended.times
    found.ended[ended.ended][ended.ended, ended.protocol, created_at] = EndedEvaluation(
        protocol=found.protocols[ended.protocol],
        state=EvaluationState(ended.state),
        reason=ended.reason,
        artefacts=Artefacts(ended.artefacts),
        engine=ended.engine,
        created_at=created_at,
        started_at=started_at,
        ended_at=ended_at,
        attempt=ended.attempt,
    )
