"""Keeps the controller's copies of the files of a run up to date while the run goes on.

What has only grown is sent from where the controller's copy ends; anything else is sent as a whole.
"""

from __future__ import annotations

import os
import stat
import tarfile
import time
import zlib
from pathlib import Path
from typing import Any, Callable, Dict, List, NamedTuple, Optional
from urllib.parse import quote

from slamhive.executors.node_store.on_node.cache import sha256_of
from slamhive.executors.node_store.on_node.connection import (
    FROM_HEADER,
    SHA256_HEADER,
    TOTAL_HEADER,
    Away,
    Connection,
    NodeRefused,
    patiently,
)
from slamhive.executors.packing import Bounds, add_folder

MOST_BODY_BYTES = 8_000_000
"""The controller takes no longer body in one request."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 5.0
_CONFLICT = 409


class Watched(NamedTuple):
    """A file, or all files of a folder, that the controller has a copy of.

    Attributes:
        place: Its name for the controller.
        path: Where it is on the node.
        interval_s: It is looked at no more often.
        change: Changes the content before it is sent, such as times by the offset of the clock; None if nothing does.
    """

    place: str
    path: Path
    interval_s: float = 0.1
    change: Optional[Callable[[bytes], bytes]] = None


class _Copy:
    """The controller's copy of one file."""

    def __init__(self) -> None:
        self.size_bytes = 0
        self.crc = 0
        self.seen = None  # type: Any
        self.sent = False


class Mirror:
    """Sends what has changed. Not safe to share between threads.

    Args:
        connection: To the controller.
        watched: What it has copies of.

    Attributes:
        wanted: What the controller said last that it wants of the run: empty, or ``{"stop_s": grace}``.
    """

    def __init__(self, connection: Connection, watched: List[Watched]) -> None:
        self._connection = connection
        self._watched = watched
        self._copies = {}  # type: Dict[str, _Copy]
        self._due_s = {}  # type: Dict[str, float]
        self._pause_s = _FIRST_PAUSE_S
        self._away_until_s = 0.0
        self.wanted = {}  # type: Dict[str, Any]

    def look(self) -> None:
        """Send what has changed and is due; later, if the controller is away. Raises Refused."""
        if time.monotonic() < self._away_until_s:
            return
        try:
            for watched in self._watched:
                if time.monotonic() >= self._due_s.get(watched.place, 0.0):
                    self._due_s[watched.place] = time.monotonic() + watched.interval_s
                    self._send(watched)
        except Away:
            self._away_until_s = time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
            return
        self._pause_s = _FIRST_PAUSE_S

    def finish(self) -> None:
        """Send everything that has changed, whether it is due or not. Raises Away, Refused."""
        for watched in self._watched:
            self._send(watched)

    def ask(self) -> None:
        """Hear what the controller wants, though nothing has changed. Raises Away, Refused."""
        self._hear(self._connection.ask("GET", "wanted"))

    def _send(self, watched: Watched) -> None:
        if not watched.path.is_dir():
            self._send_file(watched.place, watched.path, watched.change)
            return
        names = sorted(os.listdir(str(watched.path)))
        for name in names:
            self._send_file(watched.place + "/" + name, watched.path / name, watched.change)
        for place in [place for place in self._copies if place.startswith(watched.place + "/")]:
            if place[len(watched.place) + 1 :] not in names:
                self._hear(self._connection.ask("DELETE", _address(place)))
                del self._copies[place]

    def _send_file(self, place: str, path: Path, change: Optional[Callable[[bytes], bytes]]) -> None:
        copy = self._copies.setdefault(place, _Copy())
        try:
            status = path.lstat()
        except OSError:
            return
        found = (status.st_ino, status.st_size, status.st_mtime_ns)
        if not stat.S_ISREG(status.st_mode) or found == copy.seen:
            return
        content = _read(path)
        if content is None:
            return
        if change is not None:
            content = change(content)
        grown = len(content) >= copy.size_bytes and zlib.crc32(content[: copy.size_bytes]) == copy.crc
        begin = copy.size_bytes if copy.sent and copy.size_bytes and grown else 0
        if not (copy.sent and begin == len(content)):
            while True:
                piece = content[begin : begin + MOST_BODY_BYTES]
                headers = {FROM_HEADER: str(begin)} if begin else {}
                try:
                    self._hear(self._connection.ask("PUT", _address(place), piece, headers))
                except NodeRefused as refused:
                    # A controller that was killed may have lost the end of its copy.
                    if refused.status != _CONFLICT or not begin:
                        raise
                    begin = 0
                    continue
                begin += len(piece)
                if begin >= len(content):
                    break
        copy.size_bytes, copy.crc, copy.sent, copy.seen = len(content), zlib.crc32(content), True, found

    def _hear(self, answer: Dict[str, Any]) -> None:
        self.wanted = answer.get("wanted") or {}


def _address(place: str) -> str:
    return "state/" + quote(place)


def _read(path: Path) -> Optional[bytes]:
    """The content; None if it cannot be read. A link that was put in its place meanwhile is not followed."""
    try:
        descriptor = os.open(str(path), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as stream:
            return stream.read(100_000_000)
    except OSError:
        return None


# Sends the results of a run as one archive: in pieces, for as long as it takes, whoever is restarted meanwhile.


RESULT_FILE = "result.tar"
_DAMAGED = 422
_MOST_TIMES = 3

_Question = Callable[[], Dict[str, Any]]


class Output(NamedTuple):
    """An output of a run on the node. None for no bound; what exceeds it is left out."""

    name: str
    folder: Path
    max_bytes: Optional[int] = None
    max_files: Optional[int] = None


def pack_results(outputs: List[Output], archive: Path) -> None:
    """Write one archive of all outputs, each in a folder with its name. It appears in one step. Raises OSError."""
    aside = archive.with_name("." + archive.name)
    with aside.open("wb") as stream:
        with tarfile.open(fileobj=stream, mode="w|") as opened:
            for output in outputs:
                add_folder(opened, output.folder, output.name + "/", Bounds(output.max_bytes, output.max_files))
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(str(aside), str(archive))


def send_results(
    connection: Connection,
    archive: Path,
    patience_s: Optional[float] = None,
    given_up: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Send the archive, from where an earlier attempt has ended. Raises Refused, OSError, and Away if it gives up.

    Args:
        connection: To the controller.
        archive: What :func:`pack_results` wrote.
        patience_s: For how long the controller may be away at a time; None for as long as it takes.
        given_up: Whether to end although there is time left.
        sleep: Waits (s).
    """
    for attempt in range(_MOST_TIMES):
        try:
            _send(connection, archive, lambda call: patiently(call, patience_s, given_up, sleep))
        except NodeRefused as refused:
            # An answer that was lost leaves the two of them with different ideas of what has arrived.
            if refused.status not in (_CONFLICT, _DAMAGED) or attempt == _MOST_TIMES - 1:
                raise
        else:
            return


def _send(connection: Connection, archive: Path, patient: Callable[[_Question], Dict[str, Any]]) -> None:
    total, sha256 = archive.stat().st_size, sha256_of(archive)
    have = _have(patient(lambda: connection.ask("GET", "result")), sha256)
    with archive.open("rb") as stream:
        while have < total:
            piece = os.pread(stream.fileno(), MOST_BODY_BYTES, have)
            headers = {FROM_HEADER: str(have), TOTAL_HEADER: str(total), SHA256_HEADER: sha256}
            have = _have(patient(_put(connection, piece, headers)), sha256)


def _put(connection: Connection, piece: bytes, headers: Dict[str, str]) -> _Question:
    return lambda: connection.ask("PUT", "result", piece, headers)


def _have(answer: Dict[str, Any], sha256: str) -> int:
    """Return the bytes of this archive that the controller has; nothing if it holds a part of another one."""
    return int(str(answer.get("have", 0))) if answer.get("sha256") == sha256 else 0
