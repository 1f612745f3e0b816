"""How often one network address may ask for something that costs."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable

from slamhive.clock import monotonic_s
from slamhive.errors import Unavailable

MOST_ADDRESSES = 10_000
CREATIONS, CHECKS = "analyses", "checks"
CHECKS_FOR_EACH = 30
"""An editor checks the text while it is typed."""
HOUR_S = 3600.0


class RateLimit:
    """So many in a sliding window for each address, kept in this process alone.

    Args:
        most: How many.
        window_s: In which time.
        clock: Monotonic seconds.
    """

    def __init__(self, most: int, window_s: float, clock: Callable[[], float] = monotonic_s) -> None:
        self._most = most
        self._window_s = window_s
        self._clock = clock
        self._lock = threading.Lock()
        self._seen: OrderedDict[str, deque[float]] = OrderedDict()

    def take(self, address: str, what: str) -> None:
        """Count one; raises Unavailable, and counts nothing, if that is one too many."""
        now = self._clock()
        with self._lock:
            seen = self._seen.setdefault(address, deque())
            self._seen.move_to_end(address)
            while len(self._seen) > MOST_ADDRESSES:
                self._seen.popitem(last=False)
            while seen and seen[0] <= now - self._window_s:
                seen.popleft()
            if len(seen) >= self._most:
                wait_s = seen[0] + self._window_s - now
                raise Unavailable(
                    f"{self._most} {what} in {self._window_s / 60:g} min came from your address",
                    f"try again in {max(1, round(wait_s / 60))} min",
                )
            seen.append(now)


def visitor_limits(analyses_per_hour: int) -> dict[str, RateLimit]:
    """The limits of view-only mode, by name."""
    return {
        CREATIONS: RateLimit(analyses_per_hour, HOUR_S),
        CHECKS: RateLimit(CHECKS_FOR_EACH * analyses_per_hour, HOUR_S),
    }
