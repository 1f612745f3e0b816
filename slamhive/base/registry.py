"""One registry for each seam: what ships with SLAM Hive, and what plug-ins add to it.

A plug-in is an installed package with entry points. Each entry point is loaded by itself on first use of its registry.
One that cannot be loaded is logged once and listed by :meth:`Registry.origins`; all others go on working.
"""

from __future__ import annotations

import inspect
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from slamhive import __version__
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, one_line, unknown

logger = logging.getLogger(__name__)

_SEE = "see docs/extend/index.md"

T = TypeVar("T")
Reader = Callable[[str, Any], Mapping[str, T]]
"""Checks what the entry point of a name holds. Returns the entries by name, or raises InvalidInput with the reason."""


@dataclass(frozen=True, slots=True)
class PluginOrigin:
    """Where one entry of a registry comes from.

    Attributes:
        seam: What the entry is: ``dataset importer``.
        name: What users call it.
        package: The distribution that holds it.
        version: Of that distribution.
        entry_point: ``module:attribute``; empty for what ships with SLAM Hive.
        problem: Why it cannot be used; None if it can.
        remedy: What to do about the problem.
    """

    seam: str
    name: str
    package: str = "slamhive"
    version: str = __version__
    entry_point: str = ""
    problem: str | None = None
    remedy: str | None = None

    @property
    def is_plugin(self) -> bool:
        """Tell if it comes from another package."""
        return bool(self.entry_point)

    def __str__(self) -> str:
        source = f"{self.package} {self.version} ({self.entry_point})"
        if self.problem is None:
            return f"{self.seam} {self.name!r} of {source}"
        return f"{self.seam} {self.name!r} of {source} cannot be used: {self.problem}"


class Registry(Generic[T]):
    """Named implementations of one seam.

    Args:
        seam: The word for one entry, as messages use it (``"dataset importer"``).
        group: The entry-point group of plug-ins; None if the seam takes none.
        read: Checks what an entry point holds; without it, any object will do.
    """

    def __init__(self, seam: str, group: str | None = None, read: Reader[T] | None = None) -> None:
        self.seam = seam
        self.group = group
        self._read: Reader[T] = read or (lambda name, found: {name: found})
        self._entries: dict[str, T] = {}
        self._origins: dict[str, PluginOrigin] = {}
        self._broken: list[PluginOrigin] = []
        self._lock = threading.RLock()
        self._loading = False
        self._loaded = group is None

    def register(self, name: str, entry: T) -> T:
        """Add an ``entry`` that ships with SLAM Hive; raises Conflict if the name is taken.

        It takes no lock: modules register while they are being imported, and another thread may hold the lock and wait
        for that import.
        """
        if self._entries.setdefault(name, entry) is not entry:
            raise Conflict(f"{self.seam} {name!r} is registered already")
        self._origins[name] = PluginOrigin(self.seam, name)
        return entry

    @property
    def entries(self) -> Mapping[str, T]:
        """All entries by name, in the order in which they were registered."""
        self._load_plugins()
        return MappingProxyType(self._entries)

    def get(self, name: str) -> T:
        """The entry called ``name``; raises NotFound that lists the choices, or says why a plug-in is broken."""
        try:
            return self.entries[name]
        except KeyError:
            self.refuse_broken(name)
            raise unknown(self.seam, name, list(self._entries)) from None

    def refuse_broken(self, name: str) -> None:
        """Raise NotFound with the reason if all that is called ``name`` is a broken plug-in."""
        if name in self.entries:
            return
        for origin in self._broken:
            if origin.name == name:
                raise NotFound(str(origin), origin.remedy)

    def names(self) -> list[str]:
        """All names, sorted."""
        return sorted(self.entries)

    def __iter__(self) -> Iterator[tuple[str, T]]:
        return iter(sorted(self.entries.items(), key=lambda item: item[0]))

    def origins(self) -> list[PluginOrigin]:
        """Where each entry comes from, by name; broken plug-ins stand beside those that work."""
        self._load_plugins()
        return sorted([*self._origins.values(), *self._broken], key=lambda origin: origin.name)

    def is_plugin(self, name: str) -> bool:
        """Tell if the entry called ``name`` comes from another package."""
        return self._origins[name].is_plugin

    def drop(self, name: str, error: Exception) -> None:
        """Take the plug-in ``name`` out again: it was loaded, and could not be put to use for ``error``."""
        origin = self._origins.pop(name)
        del self._entries[name]
        self._note_broken(origin, error)

    def _load_plugins(self) -> None:
        if self._loaded:
            return
        with self._lock:
            if self._loaded or self._loading:  # a plug-in that asks for this registry while it is being imported
                return
            self._loading = True
            for point in sorted(entry_points(group=self.group or ""), key=_in_order):
                self._load(point)
            self._loaded = True

    def _load(self, point: EntryPoint) -> None:
        package, version = (point.dist.name, point.dist.version) if point.dist else ("an unknown package", "")
        origin = PluginOrigin(self.seam, point.name, package, version, point.value)
        try:
            found = self._read(point.name, point.load())
            self._refuse_taken(found)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in can raise anything; the others must go on
            self._note_broken(origin, error)
            return
        for name, entry in found.items():
            self._origins[name] = PluginOrigin(self.seam, name, package, version, point.value)
            self._entries[name] = entry

    def _refuse_taken(self, names: Iterable[str]) -> None:
        for name in names:
            if name in self._entries:
                raise Conflict(f"the name {name!r} is taken by {self._origins[name].package}", "give it another name")

    def _note_broken(self, origin: PluginOrigin, error: BaseException) -> None:
        problem, remedy = one_line(f"{type(error).__name__}: {error}"), None
        if isinstance(error, SlamHiveError):
            problem, remedy = error.message, error.remedy
        elif isinstance(error, ImportError):
            remedy = "install what it needs"
        remedy = f"{remedy or 'update it'}, or remove it: pip uninstall {origin.package}"
        broken = replace(origin, problem=problem, remedy=remedy)
        self._broken.append(broken)
        logger.warning("%s; %s", broken, remedy)


def instances_of(kind: type[Any], named_by: str | None = None) -> Reader[Any]:
    """Reads entry points that hold an instance of a class, or an object with the members of a protocol.

    Args:
        kind: The class, or a protocol that can be checked at run time.
        named_by: The attribute that must hold the name of the entry point.
    """

    def read(name: str, found: Any) -> dict[str, Any]:
        if isinstance(found, type):
            raise InvalidInput(
                f"it is the class {found.__name__}, not an object", "let the entry point name an instance"
            )
        if not isinstance(found, kind):
            missing = ", ".join(sorted(entry for entry in _members(kind) if not hasattr(found, entry)))
            without = f" without {missing}" if missing else ""
            raise InvalidInput(f"it is no {kind.__name__}, but of type {type(found).__name__}{without}", _SEE)
        _check_name(name, found, named_by)
        return {name: found}

    return read


def subclasses_of(kind: type[Any], named_by: str | None = None) -> Reader[Any]:
    """Reads entry points that hold a subclass of ``kind``; ``named_by`` as for :func:`instances_of`."""

    def read(name: str, found: Any) -> dict[str, Any]:
        if not (isinstance(found, type) and issubclass(found, kind)):
            raise InvalidInput(f"it is no subclass of {kind.__name__}, but {found!r}", _SEE)
        if inspect.isabstract(found):
            missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
            raise InvalidInput(f"the class {found.__name__} lacks {missing}", _SEE)
        _check_name(name, found, named_by)
        return {name: found}

    return read


def _check_name(name: str, found: Any, named_by: str | None) -> None:
    own = name if named_by is None else getattr(found, named_by, None)
    if own != name:
        raise InvalidInput(f"its {named_by} is {own!r}, its entry point is called {name!r}", "give both the same name")


def _members(kind: type[Any]) -> frozenset[str]:
    """The public methods and attributes of a class or protocol."""
    names = (name for base in kind.__mro__ for name in (*vars(base), *vars(base).get("__annotations__", {})))
    return frozenset(name for name in names if not name.startswith("_"))


def _in_order(point: EntryPoint) -> tuple[str, str]:
    """Of two packages that announce one name, the same one wins each time."""
    return point.name, point.dist.name if point.dist else ""
