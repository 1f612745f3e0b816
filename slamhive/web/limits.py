"""Limits of expensive work and of failed sign-ins, by network address."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ipaddress import IPv6Address, ip_address, ip_network

from cachetools import LRUCache

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import TooManyRequests, Unauthenticated

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


# -- failed attempts to sign in: too few to try out passwords ----------------------------------------------------------

WINDOW_S = 900.0
MOST_OF_BOTH = 5
"""Of one name from one network: its owner can still sign in from elsewhere."""
MOST_OF_ADDRESS = 30
MOST_OF_NAME = 100
"""From all networks together. At this rate, guessing a password of twelve letters takes longer than a life."""
_WHAT = "wrong passwords"
_LONGEST_NAME = 64


class SignInLimits:
    """Counts failures in this process, in bounded memory.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = monotonic_s) -> None:
        self._both = RateLimit(MOST_OF_BOTH, WINDOW_S, clock)
        self._address = RateLimit(MOST_OF_ADDRESS, WINDOW_S, clock)
        self._name = RateLimit(MOST_OF_NAME, WINDOW_S, clock)

    @contextmanager
    def attempt(self, name: str, address: str) -> Iterator[None]:
        """Count the attempt, and take it back unless the block raises Unauthenticated; raises TooManyRequests.

        It is counted first, so that attempts at the same time count too.
        """
        name, network = name[:_LONGEST_NAME], network_of(address)
        taken: list[tuple[RateLimit, str]] = []
        try:
            for limit, key in ((self._both, f"{network} {name}"), (self._address, network), (self._name, name)):
                limit.take(key, _WHAT)
                taken.append((limit, key))
            yield
        except Unauthenticated:
            raise
        except BaseException:
            _give_back(taken)
            raise
        else:
            _give_back(taken)


def network_of(address: str) -> str:
    """The addresses that one visitor can choose from: an IPv4 address, or 64 bits of an IPv6 address."""
    try:
        found = ip_address(address)
    except ValueError:
        return address
    if not isinstance(found, IPv6Address):
        return address
    return str(found.ipv4_mapped or ip_network((found, 64), strict=False))


def _give_back(taken: list[tuple[RateLimit, str]]) -> None:
    for limit, key in taken:
        limit.give_back(key)
