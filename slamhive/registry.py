"""One registry for every seam: importers, executors, evaluators and whatever plug-ins add to them."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Generic, TypeVar

from slamhive.errors import Conflict, unknown

T = TypeVar("T")


class Registry(Generic[T]):
    """Named implementations of one seam.

    Built-in implementations call :meth:`register`; installed plug-ins are found through the entry-point group
    ``slamhive.<seam>`` on first use, so that both come through the same door.

    Args:
        kind: The word for one entry, as used in messages (``"dataset importer"``).
        group: The entry-point group that plug-ins announce themselves in, or None.
    """

    def __init__(self, kind: str, group: str | None = None) -> None:
        self.kind = kind
        self._group = group
        self._entries: dict[str, T] = {}
        self._plugins_loaded = group is None

    def register(self, name: str, entry: T) -> T:
        """Add ``entry`` under ``name``; a name can be taken once."""
        if name in self._entries:
            raise Conflict(f"{self.kind} {name!r} is registered already")
        self._entries[name] = entry
        return entry

    def get(self, name: str) -> T:
        """The entry called ``name``; raises NotFound that lists the choices."""
        self._load_plugins()
        try:
            return self._entries[name]
        except KeyError:
            raise unknown(self.kind, name, list(self._entries)) from None

    def names(self) -> list[str]:
        """All names, sorted."""
        self._load_plugins()
        return sorted(self._entries)

    def __iter__(self) -> Iterator[tuple[str, T]]:
        self._load_plugins()
        return iter(sorted(self._entries.items(), key=lambda item: item[0]))

    def _load_plugins(self) -> None:
        if self._plugins_loaded or self._group is None:
            return
        self._plugins_loaded = True
        for point in entry_points(group=self._group):
            if point.name not in self._entries:
                self._entries[point.name] = point.load()
