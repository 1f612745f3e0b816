"""Choose the next run of a slot: prefer runs on the same data, for a while; skip engines that do not answer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from slamhive.clock import monotonic_s
from slamhive.domain.affinity import same_data
from slamhive.errors import SlamHiveError
from slamhive.executors.base import Executor
from slamhive.store.records import RunRecord

MOST_IN_A_ROW = 20
"""After this many runs on the same data, the oldest run in the queue is next."""


class Turns:
    """Remembers the latest runs of one slot."""

    def __init__(self) -> None:
        self._affinity = ""
        self._in_a_row = 0

    @property
    def near(self) -> str:
        """The preferred affinity of the next run; empty if the oldest run is due."""
        return self._affinity if self._in_a_row < MOST_IN_A_ROW else ""

    def took(self, run: RunRecord) -> None:
        """Note that the slot has claimed ``run``."""
        asked = self.near
        again = bool(asked) and bool(run.affinity) and same_data(asked) == same_data(run.affinity)
        self._in_a_row = self._in_a_row + 1 if again else 1
        self._affinity = run.affinity


class AbsentExecutors:
    """Executors that do not answer: their runs stay in the queue, others continue. Thread-safe.

    Args:
        executors: The executor for a name.
        pause_s: Time before an executor is asked again.
        clock: Monotonic seconds.
    """

    def __init__(
        self, executors: Callable[[str], Executor], pause_s: float, clock: Callable[[], float] = monotonic_s
    ) -> None:
        self._executors = executors
        self._pause_s = pause_s
        self._clock = clock
        self._lock = threading.Lock()
        self._ask_at_s: dict[str, float] = {}

    def note(self, name: str) -> None:
        """Note that the executor ``name`` does not answer."""
        with self._lock:
            self._ask_at_s[name] = self._clock() + self._pause_s

    def names(self) -> tuple[str, ...]:
        """The executors that still do not answer; asks those whose pause is over."""
        with self._lock:
            due = [name for name, at_s in self._ask_at_s.items() if self._clock() >= at_s]
        for name in due:
            if self._executors(name).unavailable_because() is None:
                with self._lock:
                    self._ask_at_s.pop(name, None)
            else:
                self.note(name)
        with self._lock:
            return tuple(sorted(self._ask_at_s))


class OneAtATime:
    """Lets one run at a time use an executor that cannot have several. Safe to share between threads.

    Args:
        executors: The executor for a name.
    """

    def __init__(self, executors: Callable[[str], Executor]) -> None:
        self._executors = executors
        self._lock = threading.Lock()
        self._turns: dict[str, threading.Lock] = {}

    def busy(self) -> tuple[str, ...]:
        """The executors whose only place is taken."""
        with self._lock:
            return tuple(sorted(name for name, turn in self._turns.items() if turn.locked()))

    def turn(self, name: str) -> AbstractContextManager[Any]:
        """Held while a run uses the executor ``name``. If two slots have claimed a run each, one of them waits here."""
        try:
            several = self._executors(name).capabilities.several_at_once
        except SlamHiveError:
            several = True  # whoever drives the run meets the same error, and ends the run with it
        if several:
            return nullcontext()
        with self._lock:
            return self._turns.setdefault(name, threading.Lock())
