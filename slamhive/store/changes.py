"""Notes on what a transaction has stored that no run folder holds. The ledger receives them after the commit.

Repositories take the notes and :meth:`slamhive.store.store.Store.write` hands them on, so no use case can forget to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Generic, TypeVar

from sqlalchemy import Connection

from slamhive.domain.accounts import NO_SHARING, Sharing
from slamhive.domain.protocol import Protocol
from slamhive.evaluation.job import Artefacts
from slamhive.store.records import CellRecord, NewConfiguration, RunRequest

T = TypeVar("T")

CHANGES_KEY = "slamhive.changes"
MAKER_KEY = "slamhive.maker"
"""What belongs to the account for which a connection stores runs, experiments and analyses: a :class:`Sharing`."""


@dataclass(frozen=True, slots=True)
class NewRow(Generic[T]):
    """A new row: its number, its content, and when it was added."""

    id: int
    content: T
    at: datetime


@dataclass(frozen=True, slots=True)
class AskedEvaluations:
    """Evaluations that were queued together. ``makes_current``: lists show their metrics from then on."""

    protocol: Protocol
    artefacts: Artefacts
    at: datetime
    run_ids: Sequence[int]
    makes_current: bool = False


@dataclass
class Changes:
    """Notes of one transaction.

    ``described``: configurations whose name, note or groups have changed. ``cancelled``: queued runs that were
    cancelled, with when and why. ``asked_to_end``: active runs that a user cancelled. ``cells``: by the number of their
    experiment. ``experiments``: those whose fields changed. ``evaluated``: evaluations that have ended.
    ``started``: experiments and analyses that were asked for, which only the audit log needs. ``uncertain``: the
    transaction was tried more than once, so an earlier attempt may have stored more.
    """

    configurations: list[NewRow[NewConfiguration]] = field(default_factory=list)
    described: set[int] = field(default_factory=set)
    deleted: set[int] = field(default_factory=set)
    runs: list[NewRow[RunRequest]] = field(default_factory=list)
    cancelled: list[tuple[Sequence[int], datetime, str]] = field(default_factory=list)
    asked_to_end: set[int] = field(default_factory=set)
    cells: list[tuple[int, Sequence[CellRecord]]] = field(default_factory=list)
    experiments: set[int] = field(default_factory=set)
    asked_evaluations: list[AskedEvaluations] = field(default_factory=list)
    evaluated: set[int] = field(default_factory=set)
    started: set[str] = field(default_factory=set)
    catalogue: bool = False
    searches: bool = False
    uncertain: bool = False

    def __bool__(self) -> bool:
        return any(getattr(self, name) for name in self.__dataclass_fields__ if name != "started")


Listener = Callable[[Changes], None]


def maker_of(connection: Connection) -> Sharing:
    """Owner and visibility of what is stored; nobody owns what is made without accounts."""
    found = connection.get_execution_options().get(MAKER_KEY)
    return found if isinstance(found, Sharing) else NO_SHARING


def changes_of(connection: Connection) -> Changes:
    """The notes of the transaction of ``connection``."""
    found = connection.get_execution_options().get(CHANGES_KEY, Changes())
    assert isinstance(found, Changes)
    return found
