"""Downloads that survive cuts, stalls and kills, in parallel spans where the server gives them; checks of addresses."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import queue
import re
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Conflict, InvalidInput, Unavailable
from slamhive.base.files import remedy_of, write_aside
from slamhive.documents.catalogue import LinkReportDocument
from slamhive.domain.collection import RemoteFile
from slamhive.downloads.web import AccessToken, Changed, Interrupted, Refused, Timeouts, Web, body

if TYPE_CHECKING:
    import requests

# A file of which parts have been received: ``NAME.part`` with its bytes, ``NAME.part.json`` with what is there.
#
# Both survive a kill. The list is written after the bytes that it names, so it never promises too much.


Span = tuple[int, int]
"""First byte, and the one after the last."""

_SAVE_EVERY_S = 1.0


@dataclass(frozen=True, slots=True)
class Remote:
    """Offer of an address: its size in bytes (None if it does not say), whether it gives ranges, and its version.

    ``version`` is the ETag or the date of the last change; empty if the server states neither.
    """

    address: str
    size_bytes: int | None
    ranges: bool
    version: str


class PartFile:
    """The parts of one file. Threads may write different spans at the same time.

    Args:
        target: The name of the complete file.
    """

    def __init__(self, target: Path) -> None:
        self.path = target.with_name(f"{target.name}.part")
        self._list = target.with_name(f"{target.name}.part.json")
        self._lock = threading.Lock()
        self._done: list[Span] = []
        self._origin: dict[str, object] = {}
        self._saved_s = monotonic_s()
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._file)
            raise Conflict(f"{target.name} is being downloaded by another process", "wait for it to end") from None
        try:
            content = json.loads(self._list.read_text(encoding="utf-8"))
            done = [(int(start), int(end)) for start, end in content.pop("done")]
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return
        size = os.fstat(self._file).st_size
        if all(0 <= start < end <= size for start, end in done):
            self._done, self._origin = _merged(done), content

    @property
    def done_bytes(self) -> int:
        """Number of bytes that are there."""
        with self._lock:
            return sum(end - start for start, end in self._done)

    def begin(self, remote: Remote, *, trusted: bool) -> None:
        """Keep what is there if it belongs to ``remote``, else empty the file.

        ``trusted``: a checksum will prove the whole, so parts of another address with the same size are welcome.
        """
        origin: dict[str, object] = {
            "address": remote.address,
            "version": remote.version,
            "size_bytes": remote.size_bytes,
        }
        same = origin == self._origin and bool(remote.version)
        proved = trusted and self._origin.get("size_bytes") == remote.size_bytes is not None
        if not remote.ranges or not (same or proved):
            self._done = []
            self._truncate()
        self._origin = origin
        self.save()

    def missing(self, size_bytes: int, longest: int) -> Iterator[Span]:
        """Missing bytes, in spans of at most ``longest`` bytes."""
        with self._lock:
            bounds = [*self._done, (size_bytes, size_bytes)]
        position = 0
        for start, end in bounds:
            for begin in range(position, start, longest):
                yield begin, min(begin + longest, start)
            position = end

    def write(self, start: int, data: bytes) -> None:
        """Put ``data`` at ``start``; raises Unavailable if the disk refuses."""
        try:
            view, place = memoryview(data), start
            while view:
                count = os.pwrite(self._file, view, place)
                view, place = view[count:], place + count
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None
        with self._lock:
            self._done = _merged([*self._done, (start, start + len(data))])
            due = monotonic_s() - self._saved_s > _SAVE_EVERY_S
        if due:
            self.save()

    def save(self) -> None:
        """Bring the bytes to the disk, then the list of what is there."""
        self._saved_s = monotonic_s()
        with self._lock:
            done = list(self._done)
        os.fdatasync(self._file)
        write_aside(self._list, json.dumps({**self._origin, "done": done}))

    def forget(self) -> None:
        """Empty the file."""
        with self._lock:
            self._done = []
        self._truncate()
        self.save()

    def finish(self, target: Path) -> None:
        """Give the file its name."""
        os.fsync(self._file)
        self.path.rename(target)
        self._list.unlink(missing_ok=True)

    def discard(self) -> None:
        """Remove everything."""
        self.path.unlink(missing_ok=True)
        self._list.unlink(missing_ok=True)

    def close(self) -> None:
        """Release the lock."""
        os.close(self._file)

    def _truncate(self) -> None:
        os.ftruncate(self._file, 0)


@contextmanager
def part_file(target: Path) -> Iterator[PartFile]:
    """The parts of ``target``; what is there is listed when the block ends, however it ends."""
    parts = PartFile(target)
    try:
        yield parts
    finally:
        parts.close()


def _merged(spans: list[Span]) -> list[Span]:
    merged: list[Span] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((start, end))
    return merged


# What an address offers, and one span of its bytes.


PIECE_BYTES = 256 * 1024
_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)")

Receive = Callable[[int, bytes], None]
"""Called with the place of some bytes in the file, and the bytes; may raise to end the transfer."""


def probe(web: Web, address: str) -> Remote:
    """Ask for the first byte: the server shows its size, its version and whether it gives ranges.

    Raises:
        Refused: the address gives no file.
        Interrupted: it may later.
    """
    with web.get(address, {"Range": "bytes=0-0"}) as response:
        if response.status_code == 416:
            raise Refused(f"{address} is empty")
        if "text/html" in response.headers.get("Content-Type", "").lower():
            raise Refused(f"{address} answers with a web page, not with a file: it has moved, or wants a login")
        if response.status_code == 206:
            _, _, size = content_range(response)
            return Remote(address, size, ranges=size is not None, version=version_of(response))
        length = response.headers.get("Content-Length", "")
        return Remote(address, int(length) if length.isdecimal() else None, ranges=False, version=version_of(response))


def receive_span(web: Web, remote: Remote, span: Span, receive: Receive) -> None:
    """Request one span and hand its bytes over; raises Changed, Refused or Interrupted."""
    start, end = span
    headers = {"Range": f"bytes={start}-{end - 1}"}
    if remote.version and not remote.version.startswith("W/"):
        headers["If-Range"] = remote.version
    with web.get(remote.address, headers) as response:
        if response.status_code != 206 or version_of(response) != remote.version:
            raise Changed(f"the file at {remote.address} has changed")
        first, last, size = content_range(response)
        if size != remote.size_bytes or first != start or last >= end:
            raise Changed(f"the file at {remote.address} has changed: it sends bytes {first} to {last} of {size}")
        _receive(response, (start, end), remote, receive)


def receive_whole(web: Web, remote: Remote, receive: Receive) -> None:
    """Request the whole file from a server without ranges; raises as :func:`receive_span`."""
    with web.get(remote.address) as response:
        if response.status_code != 200 or version_of(response) != remote.version:
            raise Changed(f"the file at {remote.address} has changed")
        end = remote.size_bytes
        _receive(response, (0, end), remote, receive)


def content_range(response: requests.Response) -> tuple[int, int, int | None]:
    """First and last byte and size of the file from ``Content-Range``; raises Refused if it makes no sense."""
    found = _RANGE.fullmatch(response.headers.get("Content-Range", "").strip())
    if found is None or int(found[2]) < int(found[1]):
        raise Refused(f"{response.url} answers with a range that makes no sense")
    return int(found[1]), int(found[2]), None if found[3] == "*" else int(found[3])


def version_of(response: requests.Response) -> str:
    """The ETag, or the date of the last change; empty without both."""
    return response.headers.get("ETag", "") or response.headers.get("Last-Modified", "")


def _receive(response: requests.Response, span: tuple[int, int | None], remote: Remote, receive: Receive) -> None:
    place, end = span
    for piece in body(response, PIECE_BYTES):
        if end is not None and place + len(piece) > end:
            raise Refused(f"{remote.address} sends more bytes than it announced")
        receive(place, piece)
        place += len(piece)
    if end is not None and place < end:
        raise Interrupted(f"{remote.address} sends fewer bytes than it announced")


logger = logging.getLogger(__name__)

Received = Callable[[int, int | None], None]
"""Called from time to time with the bytes that are there, and the size of the file, None if unknown."""

Result = TypeVar("Result")

_TOLD_EVERY_S = 0.2
_PROGRESS_BYTES = 64 * 1024
_SPARE_BYTES = 100_000_000


@dataclass(frozen=True, slots=True)
class Pace:
    """Progress of a download.

    ``attempts`` is how often it may fail in a row without new bytes. The pause after a failure doubles from
    ``first_pause_s``; a server that asks to wait longer than ``longest_pause_s`` ends the download.
    """

    connections: int = 4
    span_bytes: int = 32 * 1024 * 1024
    attempts: int = 5
    first_pause_s: float = 1.0
    longest_pause_s: float = 120.0
    timeouts: Timeouts = field(default_factory=Timeouts)


def download(
    file: RemoteFile,
    target: Path,
    pace: Pace,
    token: AccessToken | None = None,
    received: Received = lambda _done, _size: None,
) -> None:
    """Make ``target`` the complete and checked file, continuing what an earlier call left.

    A file is put together from two addresses only if a checksum will prove it.

    Raises:
        Unavailable: no address gives the file; the disk is full.
        InvalidInput: what was received is not what was published.
        Conflict: another process is downloading it.
    """
    if target.exists():
        check_file(target, file, str(target))
        return
    problems: list[str] = []
    with part_file(target) as parts:
        for address in file.addresses:
            try:
                _Transfer(replace(file, addresses=(address,)), parts, pace, token, received).run()
                break
            except (Refused, Changed) as error:
                problems.append(error.message)
            except Interrupted as error:
                problems.append(error.message)
                if parts.done_bytes and file.checksum is None:
                    raise Unavailable(
                        f"{error.message}, after {parts.done_bytes / 1e6:,.1f} MB of {target.name}",
                        "run the command again: it continues where it stopped",
                    ) from None
        else:
            if not parts.done_bytes:
                parts.discard()
            raise Unavailable(
                f"{target.name} cannot be downloaded: {'; '.join(problems)}",
                "slamhive dataset links checks all addresses",
            )
        try:
            check_file(parts.path, file, target.name)
        except InvalidInput:
            parts.discard()
            raise
        parts.finish(target)


def check_file(path: Path, file: RemoteFile, name: str | None = None) -> None:
    """Compare size and checksum with those that are published; raises InvalidInput. ``name`` is for messages."""
    name = name or path.name
    size = path.stat().st_size
    if file.size_bytes is not None and size != file.size_bytes:
        raise InvalidInput(
            f"{name} has {size:,} bytes, {file.size_bytes:,} are published", "remove it, and download it again"
        )
    if file.checksum is None:
        return
    kind, _, wanted = file.checksum.partition(":")
    with path.open("rb") as stream:
        found = hashlib.file_digest(stream, kind).hexdigest()
    if found != wanted:
        raise InvalidInput(f"{name} has the {kind} checksum {found}, {wanted} is published", "download it again")


class _Transfer:
    """The transfer of a file from its only address."""

    def __init__(
        self, file: RemoteFile, parts: PartFile, pace: Pace, token: AccessToken | None, received: Received
    ) -> None:
        self._file = file
        self._parts = parts
        self._pace = pace
        self._token = token
        self._received = received
        self._stop = threading.Event()

    def run(self) -> None:
        """Receive all; a file that changes meanwhile is started again once."""
        try:
            self._receive_all()
        except Changed as error:
            logger.warning("%s; starting again", error)
            self._parts.forget()
            self._receive_all()

    def _receive_all(self) -> None:
        web = self._web()
        remote = self._patiently(lambda: probe(web, self._file.addresses[0]))
        self._check(remote)
        self._parts.begin(remote, trusted=self._file.checksum is not None)
        try:
            if remote.ranges and remote.size_bytes is not None:
                waiting: queue.SimpleQueue[Span] = queue.SimpleQueue()
                for span in self._parts.missing(remote.size_bytes, self._pace.span_bytes):
                    waiting.put(span)
                self._stop.clear()
                with ThreadPoolExecutor(self._pace.connections, thread_name_prefix="download") as pool:
                    work = [pool.submit(self._work, remote, waiting) for _ in range(self._pace.connections)]
                    try:
                        self._watch(work, remote.size_bytes)
                    finally:
                        self._stop.set()
                # That the others were stopped says less than the error that made them stop.
                errors = filter(None, (future.exception() for future in work))
                for error in sorted(errors, key=lambda error: isinstance(error, _Stopped)):
                    raise error
            else:
                self._patiently(lambda: self._receive_stream(web, remote))
        finally:
            self._parts.save()
        self._received(self._parts.done_bytes, remote.size_bytes)

    def _check(self, remote: Remote) -> None:
        published, size = self._file.size_bytes, remote.size_bytes
        if published is not None and size is not None and size != published:
            raise Refused(f"{remote.address} offers {size:,} bytes, {published:,} are published")
        expected = size or self._file.estimate_bytes or 0
        check_space(self._parts.path.parent, expected - self._parts.done_bytes, self._file.name)

    def _receive_stream(self, web: Web, remote: Remote) -> None:
        """Without ranges, every attempt begins at the start."""
        self._parts.forget()

        def receive(place: int, data: bytes) -> None:
            self._write(place, data)
            self._received(place + len(data), remote.size_bytes)

        receive_whole(web, remote, receive)

    def _watch(self, work: list[Future[None]], size_bytes: int) -> None:
        """Report until all are done, or one has failed."""
        running = True
        while running:
            done, rest = wait(work, _TOLD_EVERY_S, FIRST_EXCEPTION)
            running = bool(rest) and all(future.exception() is None for future in done)
            self._received(self._parts.done_bytes, size_bytes)

    def _work(self, remote: Remote, waiting: queue.SimpleQueue[Span]) -> None:
        """Receive one span after the other."""
        web = self._web()
        with contextlib.suppress(queue.Empty):
            while not self._stop.is_set():
                self._receive_one(web, remote, waiting.get_nowait())

    def _receive_one(self, web: Web, remote: Remote, span: Span) -> None:
        """Receive the rest of a span; another attempt begins where the last one ended."""
        place, end = span

        def receive(at: int, data: bytes) -> None:
            nonlocal place
            self._write(at, data)
            place = at + len(data)

        self._patiently(lambda: receive_span(web, remote, (place, end), receive))

    def _write(self, place: int, data: bytes) -> None:
        if self._stop.is_set():
            raise _Stopped("the download was stopped")
        self._parts.write(place, data)

    def _web(self) -> Web:
        return Web(self._pace.timeouts, self._token)

    def _patiently(self, work: Callable[[], Result]) -> Result:
        """Try again after failures that may pass; raises Interrupted after too many in a row without new bytes."""
        failures = 0
        while True:
            before = self._parts.done_bytes
            try:
                return work()
            except Interrupted as error:
                failures = 1 if self._parts.done_bytes - before >= _PROGRESS_BYTES else failures + 1
                pause_s = self._pace.first_pause_s * 2 ** (failures - 1) if error.wait_s is None else error.wait_s
                if pause_s > self._pace.longest_pause_s:
                    raise Interrupted(f"{error.message}, and asks to wait {pause_s:.0f} s") from None
                if failures >= self._pace.attempts or self._stop.wait(pause_s):
                    raise
                logger.info("%s; trying again", error)


class _Stopped(Unavailable):
    """Another thread has failed."""


def check_space(folder: Path, needed_bytes: int, what: str) -> None:
    """Raise Unavailable unless the disk of ``folder`` has room for ``needed_bytes`` more."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes + _SPARE_BYTES:
        raise Unavailable(
            f"{folder} has {free / 1e6:,.0f} MB free, {what} needs about {(needed_bytes + _SPARE_BYTES) / 1e6:,.0f} MB",
            "free some space, or move the data root (SLAMHIVE_DATA)",
        )


# The words for a transfer: how much is there, how fast it is, how long it will take.


_WINDOW_S = 15.0


class Speed:
    """The speed of a transfer over the last seconds.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = monotonic_s) -> None:
        self._clock = clock
        self._samples: deque[tuple[float, int]] = deque()

    def words(self, done_bytes: int, size_bytes: int | None) -> str:
        """``1.2 of 12.7 GB, 25.0 MB/s, 7 min left``."""
        now_s = self._clock()
        self._samples.append((now_s, done_bytes))
        while now_s - self._samples[0][0] > _WINDOW_S and len(self._samples) > 2:
            self._samples.popleft()
        since_s, before = self._samples[0]
        parts = [f"{done_bytes / 1e6:,.1f}" + ("" if size_bytes is None else f" of {size_bytes / 1e6:,.1f}") + " MB"]
        if now_s > since_s and done_bytes > before:
            bytes_per_s = (done_bytes - before) / (now_s - since_s)
            parts.append(f"{bytes_per_s / 1e6:,.1f} MB/s")
            if size_bytes is not None:
                parts.append(f"{_span((size_bytes - done_bytes) / bytes_per_s)} left")
        return ", ".join(parts)


def _span(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


# -- checks whether addresses still give files, many at a time, without downloading them -------------------------------


@dataclass(frozen=True, slots=True)
class CheckedLink:
    """An address of a file, and the secrets that may be sent to it."""

    address: str
    file: RemoteFile
    token: AccessToken | None = None


def check_links(
    links: Iterable[CheckedLink],
    timeouts: Timeouts,
    connections: int = 8,
    checked: Callable[[int], None] = lambda _count: None,
) -> list[LinkReportDocument]:
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


def check_link(link: CheckedLink, timeouts: Timeouts) -> LinkReportDocument:
    """Ask one address."""
    begun_s = monotonic_s()
    try:
        found = probe(Web(timeouts, link.token), link.address)
    except (Refused, Interrupted) as error:
        return LinkReportDocument(
            address=link.address,
            problem=error.message,
            size_bytes=None,
            ranges=None,
            duration_s=monotonic_s() - begun_s,
        )
    published = link.file.size_bytes
    problem = None
    if published is not None and found.size_bytes not in {None, published}:
        problem = f"offers {found.size_bytes:,} bytes, {published:,} are published"
    return LinkReportDocument(
        address=link.address,
        problem=problem,
        size_bytes=found.size_bytes,
        ranges=found.ranges,
        duration_s=monotonic_s() - begun_s,
    )
