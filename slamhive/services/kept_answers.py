"""Answers to changes that programs asked for with a key of their own, so that a repetition is not done twice.

Each is a file in the data root, since the usual reason to repeat a request is a server that was restarted.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Hashable
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Generic, TypeVar

from cachetools import LRUCache

from slamhive.base.bounds import read_record
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, Unavailable
from slamhive.base.files import make_shared_folder, remedy_of, write_aside

KEPT = timedelta(hours=24)
MOST_KEPT = 10_000
LONGEST_KEY = 255


@dataclass(frozen=True, slots=True)
class KeptAnswer:
    """Answer to the first request: HTTP status and JSON text."""

    status: int
    body: str


class KeptAnswers:
    """The answers of the last 24 hours, one file each.

    Args:
        folder: Where they are.
        owner: Whose they are: callers do not share keys.
        clock: The time.
    """

    def __init__(self, folder: Path, owner: str = "", clock: Callable[[], datetime] = utc_now) -> None:
        self._folder = folder
        self._owner = owner
        self._clock = clock

    def of(self, owner: str) -> KeptAnswers:
        """Those of one caller."""
        return KeptAnswers(self._folder, owner, self._clock)

    def claim(self, key: str, asked: str) -> KeptAnswer | None:
        """Take a key for a change that begins now (None), or find the answer of the first request with this key.

        Args:
            key: What the caller chose; unique for each change.
            asked: Identifies the request.

        Raises:
            InvalidInput: the key is empty or too long, or belongs to another request.
            Conflict: the first request goes on, or was cut off, so that nobody knows what it did.
            Unavailable: the data root cannot be written.
        """
        if not 0 < len(key) <= LONGEST_KEY or not key.isprintable():
            raise InvalidInput(f"the key {key[:40]!r} is not allowed", f"use 1 to {LONGEST_KEY} printable characters")
        self._sweep()
        path = self._path(key)
        try:
            make_shared_folder(self._folder)
            with path.open("x", encoding="utf-8") as stream:
                stream.write(json.dumps({"asked": asked}))
        except FileExistsError:
            return _known(path, key, asked)
        except OSError as error:
            raise Unavailable(f"{path} cannot be written: {error.strerror}", remedy_of(error)) from None
        return None

    def keep(self, key: str, answer: KeptAnswer) -> None:
        """Store the answer to the request that claimed the key."""
        path = self._path(key)
        write_aside(path, json.dumps({**read_record(path), **asdict(answer)}))

    def release(self, key: str) -> None:
        """Give the key back: its request was refused and changed nothing."""
        self._path(key).unlink(missing_ok=True)

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(f"{self._owner}\n{key}".encode()).hexdigest()
        return self._folder / f"{name}.json"

    def _sweep(self) -> None:
        """Remove what is too old, and the oldest of too many."""
        found: list[tuple[float, Path]] = []
        for path in self._folder.glob("*.json"):
            try:
                found.append((path.stat().st_mtime, path))
            except FileNotFoundError:
                continue
        until = (self._clock() - KEPT).timestamp()
        found.sort(reverse=True)
        for place, (written, path) in enumerate(found):
            if written < until or place >= MOST_KEPT - 1:
                path.unlink(missing_ok=True)


def _known(path: Path, key: str, asked: str) -> KeptAnswer | None:
    shown = key[:40]
    try:
        content: dict[str, Any] = read_record(path)
    except InvalidInput:  # its writer has made the file, and not filled it yet
        content = {"asked": asked}
    if content.get("asked") != asked:
        raise InvalidInput(f"the key {shown!r} belongs to another request", "use a new key for each change")
    if "body" not in content:
        raise Conflict(
            f"a request with the key {shown!r} has not ended, or was cut off",
            "wait; if it was cut off, look what it has changed before you use another key",
        )
    return KeptAnswer(int(content["status"]), str(content["body"]))


# Results that take long to read from a large file, kept in memory within a bound.

_Key = TypeVar("_Key", bound=Hashable)
_View = TypeVar("_View")


class KeptViews(Generic[_Key, _View]):
    """Those used last, by a key that changes with the file. Several threads may ask at once.

    Args:
        most_bytes: What they may take in memory together.
        size_bytes: What one takes.
        at_once: How many are read at once; who asks for more waits, so that runs keep their CPU.
    """

    def __init__(self, most_bytes: int, size_bytes: Callable[[_View], int], at_once: int = 2) -> None:
        self._kept: LRUCache[_Key, _View] = LRUCache(most_bytes, size_bytes)
        self._lock = threading.Lock()
        self.turns = threading.BoundedSemaphore(at_once)

    def get(self, key: _Key, read: Callable[[], _View]) -> _View:
        """The view with this key, which ``read`` reads unless it is kept."""
        with self._lock:
            known = self._kept.get(key)
        if known is None:
            with self.turns:
                with self._lock:
                    known = self._kept.get(key)
                if known is None:
                    known = read()
                    self.put(key, known)
        return known

    def put(self, key: _Key, view: _View) -> None:
        """Keep a view that was read with another."""
        with self._lock:
            self._kept[key] = view
