"""Files with trained weights that a package needs, and that nobody may ship with it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Weights:
    """One file.

    Attributes:
        name: Its name in the data root and in the container.
        licence: The terms of its authors.
        page: Where its authors publish it.
        address: From where it can be downloaded directly; None if it has to be taken from ``page`` by hand.
        sha256: Its checksum in hex; None if none is published. Then the file that is added first counts.
        size_bytes: Its size; None if it is not published.
    """

    name: str
    licence: str
    page: str
    address: str | None = None
    sha256: str | None = None
    size_bytes: int | None = None
