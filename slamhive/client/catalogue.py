"""What runs are made of: datasets and algorithms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

D = TypeVar("D")


class Named(Generic[D]):
    """The datasets, or the algorithms, of an installation in the order of their names.

    Args:
        read_all: Reads the documents of all.
        read_one: Reads the document of one name; raises NotFound.
    """

    def __init__(self, read_all: Callable[[], tuple[D, ...]], read_one: Callable[[str], D]) -> None:
        self._read_all = read_all
        self._read_one = read_one

    def __iter__(self) -> Iterator[D]:
        return iter(self._read_all())

    def get(self, name: str) -> D:
        """The document of one name; raises NotFound."""
        return self._read_one(name)
