"""What takes long to read from a large file and is looked at again: kept in memory, within a bound."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from cachetools import LRUCache

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
