"""Budget of all requests of a server together: memory, disk, and how many of a kind it works on at once.

A limit for each request is not enough: many requests at once would exhaust the machine. So whatever a request brings is
taken out of one :class:`Budget` before it is read, unpacked or parsed, and given back when that has ended.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import InvalidInput, Unavailable

_MOST_SHOWN = 3
_MOST_WAITING = 4
"""Threads that wait serve no pages, so only some do; others are refused at once."""
RETRY_AFTER_S = 5


class Lent(StrEnum):
    """Kinds of things that a budget lends, as messages call them."""

    MEMORY = "memory"
    DISK = "temporary files"
    UNPACKED = "unpacked uploads"
    SUBMISSIONS = "submissions"
    IMAGES = "images"
    IMPORTS = "imports"

    @property
    def is_bytes(self) -> bool:
        """Return whether amounts are bytes; the others are pieces of work at once."""
        return self in (Lent.MEMORY, Lent.DISK, Lent.UNPACKED)

    def in_words(self, amount: int) -> str:
        """``12 MB of memory``, ``2 submissions``."""
        return f"{amount / 1e6:,.0f} MB of {self}" if self.is_bytes else f"{amount} {self}"


class Budget:
    """Lends to shares no more than there is. Safe to use from any thread.

    Args:
        most: How much there is of each kind; without limit of those that are not named.
        clock: Monotonic seconds.
    """

    def __init__(self, most: Mapping[Lent, int], clock: Callable[[], float] = monotonic_s) -> None:
        self.most = dict(most)
        self.clock = clock
        self.changed = threading.Condition()
        self.shares: list[BudgetShare] = []
        self.waiting = 0

    def open_share(self, what: str) -> BudgetShare:
        """A share of what messages call ``what``, which has to be given back."""
        share = BudgetShare(self, what)
        with self.changed:
            self.shares.append(share)
        return share

    @contextmanager
    def share(self, what: str, one_of: Lent | None = None, wait_s: float = 0.0) -> Iterator[BudgetShare]:
        """A share for the block; it counts as ``one_of`` those that are worked on at once. Raises as Share.take."""
        share = self.open_share(what)
        try:
            if one_of is not None:
                share.take(one_of, 1, wait_s)
            yield share
        finally:
            share.give_back()

    def used(self, kind: Lent) -> int:
        """The amount of a kind that is lent now."""
        return sum(share.held[kind] for share in self.shares)

    def holders(self, kind: Lent) -> str:
        """Pieces of work that hold something of a kind, and for how long; nobody's name or token is in it."""
        found = [share for share in self.shares if share.held[kind]]
        words = [f"{share.what}, for {self.clock() - share.since_s:.0f} s" for share in found[:_MOST_SHOWN]]
        more = [f"and {len(found) - _MOST_SHOWN} more"] if len(found) > _MOST_SHOWN else []
        return "; ".join([*words, *more])


class BudgetShare:
    """The part of a budget that one piece of work has taken."""

    def __init__(self, budget: Budget, what: str) -> None:
        self._budget = budget
        self.what = what
        self.since_s = budget.clock()
        self.held: Counter[Lent] = Counter()

    def take(self, kind: Lent, amount: int, wait_s: float = 0.0) -> None:
        """Take some more, after others have given it back if that happens in time.

        Raises InvalidInput for more than there ever is, and Unavailable, saying who holds it, for more than is left.
        """
        budget = self._budget
        most = budget.most.get(kind)
        with budget.changed:
            if most is not None and self.held[kind] + amount > most:
                raise InvalidInput(
                    f"{self.what} needs {kind.in_words(self.held[kind] + amount)}, and all together may have "
                    f"{kind.in_words(most)} here",
                    "send less, or use the command line where the server runs",
                )
            until_s = budget.clock() + wait_s
            while most is not None and budget.used(kind) + amount > most:
                self._wait(kind, most, until_s)
            self.held[kind] += amount

    @contextmanager
    def lend(self, kind: Lent, amount: int, wait_s: float = 0.0) -> Iterator[None]:
        """Take some for the block; raises as :meth:`take`."""
        self.take(kind, amount, wait_s)
        try:
            yield
        finally:
            self.give_back(kind, amount)

    def give_back(self, kind: Lent | None = None, amount: int = 0) -> None:
        """Give an amount of a kind back, or everything: nothing can be taken any more then."""
        with self._budget.changed:
            if kind is not None:
                self.held[kind] -= amount
            else:
                self.held.clear()
                if self in self._budget.shares:
                    self._budget.shares.remove(self)
            self._budget.changed.notify_all()

    def _wait(self, kind: Lent, most: int, until_s: float) -> None:
        budget = self._budget
        left_s = until_s - budget.clock()
        if left_s <= 0 or budget.waiting >= _MOST_WAITING:
            full = (
                f"{budget.used(kind) / 1e6:,.0f} of {kind.in_words(most)} are in use"
                if kind.is_bytes
                else f"this server works on {kind.in_words(most)} at once"
            )
            raise Unavailable(
                f"{self.what} has to wait: {full} ({budget.holders(kind)})",
                f"send it again in {RETRY_AFTER_S} s",
                retry_after_s=RETRY_AFTER_S,
            )
        budget.waiting += 1
        try:
            budget.changed.wait(left_s)
        finally:
            budget.waiting -= 1


def unbounded(what: str) -> BudgetShare:
    """A share of a budget without limits, for the command line, where nobody has to share."""
    return Budget({}).open_share(what)
