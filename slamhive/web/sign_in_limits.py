"""How often names and addresses may be wrong when they sign in, so that passwords cannot be tried out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ipaddress import IPv6Address, ip_address, ip_network

from slamhive.clock import monotonic_s
from slamhive.errors import Unauthenticated
from slamhive.web.rates import RateLimit

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
    """What one visitor can choose addresses from: an IPv4 address, or 64 bits of an IPv6 address."""
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
