"""How often one network address may start expensive work."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

from cachetools import LRUCache

from slamhive.clock import monotonic_s
from slamhive.errors import TooManyRequests

MOST_ADDRESSES = 10_000
CREATIONS, CHECKS = "analyses", "checks"
CHECKS_FOR_EACH = 30
"""Checks per analysis: the editor checks the text while a visitor types."""
HOUR_S = 3600.0


class RateLimit:
    """Limits the calls of each address in a sliding window; counts in this process only.

    Args:
        most: Calls in a window.
        window_s: Length of the window.
        clock: Monotonic seconds.
    """

    def __init__(self, most: int, window_s: float, clock: Callable[[], float] = monotonic_s) -> None:
        self._most = most
        self._window_s = window_s
        self._clock = clock
        self._lock = threading.Lock()
        self._calls: LRUCache[str, deque[float]] = LRUCache(MOST_ADDRESSES)

    def take(self, address: str, what: str) -> None:
        """Count a call. If it exceeds the limit, raise TooManyRequests and do not count it."""
        now = self._clock()
        with self._lock:
            calls = self._calls.setdefault(address, deque())
            while calls and calls[0] <= now - self._window_s:
                calls.popleft()
            if len(calls) >= self._most:
                wait_s = calls[0] + self._window_s - now
                raise TooManyRequests(
                    f"your address has sent {self._most} {what} in {self._window_s / 60:g} min",
                    f"try again in {max(1, round(wait_s / 60))} min",
                    retry_after_s=math.ceil(wait_s),
                )
            calls.append(now)

    def give_back(self, address: str) -> None:
        """Do not count the last call of an address."""
        with self._lock:
            calls = self._calls.get(address)
            if calls:
                calls.pop()


def visitor_limits(analyses_per_hour: int) -> dict[str, RateLimit]:
    """The limits of view-only mode, by name."""
    return {
        CREATIONS: RateLimit(analyses_per_hour, HOUR_S),
        CHECKS: RateLimit(CHECKS_FOR_EACH * analyses_per_hour, HOUR_S),
    }
