"""Checks whether addresses still give files, many at a time, without downloading them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass

from slamhive.base.clock import monotonic_s
from slamhive.domain.collection import RemoteFile
from slamhive.downloads.download import probe
from slamhive.downloads.web import AccessToken, Interrupted, Refused, Timeouts, Web


@dataclass(frozen=True, slots=True)
class CheckedLink:
    """An address of a file, and the secrets that may be sent to it."""

    address: str
    file: RemoteFile
    token: AccessToken | None = None


@dataclass(frozen=True, slots=True)
class LinkReport:
    """The answer of an address; ``problem`` is None if it gives the file."""

    address: str
    problem: str | None
    size_bytes: int | None
    ranges: bool | None
    duration_s: float


def check_links(
    links: Iterable[CheckedLink],
    timeouts: Timeouts,
    connections: int = 8,
    checked: Callable[[int], None] = lambda _count: None,
) -> list[LinkReport]:
    """Ask each address for one byte; the reports are in the order of ``links``.

    Args:
        links: What to ask.
        timeouts: For each request; redirects count as requests.
        connections: How many are asked at the same time.
        checked: Called with the number of addresses that have answered or failed.
    """
    with ThreadPoolExecutor(connections, thread_name_prefix="links") as pool:
        work = [pool.submit(check_link, link, timeouts) for link in links]
        try:
            for count, _ in enumerate(as_completed(work), start=1):
                checked(count)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [future.result() for future in work]


def check_link(link: CheckedLink, timeouts: Timeouts) -> LinkReport:
    """Ask one address."""
    begun_s = monotonic_s()
    try:
        found = probe(Web(timeouts, link.token), link.address)
    except (Refused, Interrupted) as error:
        return LinkReport(link.address, error.message, None, None, monotonic_s() - begun_s)
    published = link.file.size_bytes
    problem = None
    if published is not None and found.size_bytes not in {None, published}:
        problem = f"offers {found.size_bytes:,} bytes, {published:,} are published"
    return LinkReport(link.address, problem, found.size_bytes, found.ranges, monotonic_s() - begun_s)
