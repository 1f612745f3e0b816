"""Downloads that survive cuts, stalls and kills, in parallel spans where the server gives them."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import queue
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from slamhive.domain.collection import RemoteFile
from slamhive.errors import InvalidInput, Unavailable
from slamhive.fetch.ask import probe, receive_span, receive_whole
from slamhive.fetch.failures import Changed, Interrupted, Refused
from slamhive.fetch.part_file import PartFile, Remote, Span, part_file
from slamhive.fetch.web import Timeouts, Token, Web

logger = logging.getLogger(__name__)

Received = Callable[[int, int | None], None]
"""Called from time to time with the bytes that are there, and the size of the file, None if unknown."""

Result = TypeVar("Result")

_TOLD_EVERY_S = 0.2
_PROGRESS_BYTES = 64 * 1024
_SPARE_BYTES = 100_000_000


@dataclass(frozen=True, slots=True)
class Pace:
    """How a download proceeds.

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
    token: Token | None = None,
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

    def __init__(self, file: RemoteFile, parts: PartFile, pace: Pace, token: Token | None, received: Received) -> None:
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
                self._receive_spans(remote, remote.size_bytes)
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

    def _receive_spans(self, remote: Remote, size_bytes: int) -> None:
        waiting: queue.SimpleQueue[Span] = queue.SimpleQueue()
        for span in self._parts.missing(size_bytes, self._pace.span_bytes):
            waiting.put(span)
        self._stop.clear()
        with ThreadPoolExecutor(self._pace.connections, thread_name_prefix="download") as pool:
            work = [pool.submit(self._work, remote, waiting) for _ in range(self._pace.connections)]
            try:
                self._watch(work, size_bytes)
            finally:
                self._stop.set()
        for error in sorted(filter(None, (future.exception() for future in work)), key=_stopped):
            raise error

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


def _stopped(error: BaseException) -> bool:
    return isinstance(error, _Stopped)


def check_space(folder: Path, needed_bytes: int, what: str) -> None:
    """Raise Unavailable unless the disk of ``folder`` has room for ``needed_bytes`` more."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes + _SPARE_BYTES:
        raise Unavailable(
            f"{folder} has {free / 1e6:,.0f} MB free, {what} needs about {(needed_bytes + _SPARE_BYTES) / 1e6:,.0f} MB",
            "free some space, or move the data root (SLAMHIVE_DATA)",
        )
