"""One queue for everything that workers take: runs, evaluations and analyses.

A row waits in its queued state. The first worker that changes it holds it under a lease: an owner, and the time at
which the lease expires unless the owner extends it. Of any number of workers that try, one succeeds, because each
UPDATE repeats the condition under which the row was chosen.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any, ClassVar, Generic, TypeVar

from sqlalchemy import ColumnElement, Table, or_, select, update

from slamhive.store.rows import Repository, changed

K = TypeVar("K", int, str)

NO_LEASE: dict[str, Any] = {"lease_owner": None, "lease_expires_at": None}
"""The columns of a row that nobody holds."""
_SPARE_CANDIDATES = 4
"""Candidates beyond those wanted, in case other workers take some first."""


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to work on rows for a time.

    Attributes:
        owner: The worker.
        now: The time by the clock that decides about leases, see :meth:`slamhive.store.transaction.Transaction.lease`.
        lasts_s: Seconds until it expires unless it is extended.
        recorded_at: The worker's wall clock, for the record; None is ``now``.
    """

    owner: str
    now: datetime
    lasts_s: float
    recorded_at: datetime | None = None

    @property
    def at(self) -> datetime:
        """The time at which the lease was taken, for the record."""
        return self.recorded_at or self.now

    @property
    def columns(self) -> dict[str, Any]:
        """The columns of a row that is held."""
        return {"lease_owner": self.owner, "lease_expires_at": self.now + timedelta(seconds=self.lasts_s)}


class LeaseQueue(Repository, Generic[K]):
    """The queue of one table. A subclass names the table and chooses which row comes next.

    Attributes:
        table: With ``state``, ``attempt``, ``lease_owner`` and ``lease_expires_at``.
        key: The column that callers name rows by.
        queued: The state of rows that wait.
        working: The states in which a row is held.
        released: The state of a row that its worker gives back; None leaves it as it is.
        refunds_attempts: Whether an attempt that its own worker gives back does not count.
    """

    table: ClassVar[Table]
    key: ClassVar[str] = "id"
    queued: ClassVar[StrEnum]
    working: ClassVar[tuple[StrEnum, ...]]
    released: ClassVar[StrEnum | None] = None
    refunds_attempts: ClassVar[bool] = False

    def heartbeat(self, keys: Iterable[K], lease: Lease) -> set[K]:
        """Extend the leases; the rows that the owner still holds. It must let go of all others at once."""
        # Only rows that are still the owner's: a heartbeat that comes late must not take back what another has adopted.
        held = self._held(lease.owner, list(keys))
        self._connection.execute(update(self.table).where(held).values(lease.columns))
        return set(self._column(select(self.table.c[self.key]).where(held)))

    def release(self, keys: Iterable[K], owner: str) -> None:
        """Give rows back, so that the next worker need not wait for the lease to expire."""
        refund = {"attempt": self.table.c.attempt - 1} if self.refunds_attempts else {}
        self._connection.execute(update(self.table).where(self._held(owner, list(keys))).values(self._freed | refund))

    def release_all(self, owner: str) -> None:
        """Give back everything that ``owner``, known to be dead, still holds."""
        self._connection.execute(update(self.table).where(self._held(owner)).values(self._freed))

    def owners(self) -> set[str]:
        """Everyone who holds a row."""
        owner = self.table.c.lease_owner
        held = select(owner).where(owner.is_not(None), self.table.c.state.in_(self.working)).distinct()
        return {str(name) for name in self._connection.execute(held).scalars()}

    @property
    def _freed(self) -> dict[str, Any]:
        return NO_LEASE if self.released is None else {**NO_LEASE, "state": self.released}

    def _held(self, owner: str, keys: Collection[K] | None = None) -> ColumnElement[bool]:
        columns = self.table.c
        held = (columns.lease_owner == owner) & columns.state.in_(self.working)
        return held if keys is None else held & columns[self.key].in_(keys)

    def _orphaned(self, now: datetime) -> ColumnElement[bool]:
        """Rows whose worker gave them back or went silent."""
        columns = self.table.c
        free = or_(columns.lease_owner.is_(None), columns.lease_expires_at < now)
        return columns.state.in_(self.working) & free

    def _waiting(self, now: datetime) -> ColumnElement[bool]:
        """Rows that any worker may take."""
        return or_(self.table.c.state == self.queued, self._orphaned(now))

    def _take(self, key: K, lease: Lease, still: ColumnElement[bool], **values: Any) -> bool:
        """Hold a row if it is ``still`` as it was when it was chosen; whether this worker holds it now."""
        # Compare and set: between the choice and this UPDATE, another worker may have taken the row. The database runs
        # one UPDATE after the other, so ``still`` is true for one of them, and the others match no row.
        taken = {"attempt": self.table.c.attempt + 1, **lease.columns, **values}
        chosen = self.table.c[self.key] == key
        return changed(self._connection, update(self.table).where(chosen, still).values(taken)) == 1

    def _take_oldest(self, free: ColumnElement[bool], lease: Lease, most: int, **values: Any) -> list[K]:
        """Hold up to ``most`` of the ``free`` rows, the oldest first."""
        columns = self.table.c
        candidates = select(columns[self.key]).where(free).order_by(columns.id).limit(most + _SPARE_CANDIDATES)
        taken: list[K] = []
        for key in self._connection.execute(candidates).scalars().all():
            if len(taken) < most and self._take(key, lease, free, **values):
                taken.append(key)
        return taken

    def _end(self, key: K, owner: str, **values: Any) -> bool:
        """Write the end of a row that ``owner`` holds; False if it holds it no more."""
        ended = {**NO_LEASE, **values}
        return changed(self._connection, update(self.table).where(self._held(owner, [key])).values(ended)) == 1
