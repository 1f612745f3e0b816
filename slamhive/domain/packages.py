"""Names of package versions: ``aloam@2``."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from typing import Any

from slamhive.base.errors import InvalidInput

VERSION_SIGN = "@"
"""Between the name of an algorithm or package and the number of a version: ``aloam@2``."""

_VERSIONED = re.compile(r"(?P<name>[^@]+)@(?P<number>[1-9][0-9]{0,8})", re.ASCII)


def version_label(name: str, number: int) -> str:
    """Name of a version: ``aloam@2``."""
    return f"{name}{VERSION_SIGN}{number}"


def split_version(text: str) -> tuple[str, int | None]:
    """``aloam@2`` as name and number of a version; None for a name alone. Raises InvalidInput for anything else."""
    if VERSION_SIGN not in text:
        return text, None
    found = _VERSIONED.fullmatch(text)
    if found is None:
        raise InvalidInput(f"{text!r} names no version", "write NAME@NUMBER, for example aloam@2")
    return found["name"], int(found["number"])


# Where an imported package comes from.


UNKNOWN = "unknown"
"""What an import writes for a text that it did not find."""


@dataclass(frozen=True, slots=True)
class PackageOrigin:
    """Where an imported package comes from.

    Attributes:
        source: The folder, address, image or archive that was imported.
        commit: The commit of a Git repository.
        checksum: Of the archive that held the image.
        image: The digest of the image.
        added: What was put on top of the image, since the contract needs it.
        imported_at: When, in UTC.
    """

    source: str
    commit: str | None = None
    checksum: str | None = None
    image: str | None = None
    added: tuple[str, ...] = ()
    imported_at: str | None = None

    @property
    def content(self) -> dict[str, Any]:
        """Return the known fields as plain JSON."""
        known = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {key: list(value) if isinstance(value, tuple) else value for key, value in known.items() if value}

    @property
    def public(self) -> PackageOrigin:
        """The origin without the place of a folder or archive on this machine."""
        is_path = self.source.startswith("/")
        return replace(self, source=self.source.rstrip("/").rpartition("/")[2]) if is_path else self

    @property
    def words(self) -> str:
        """The origin in a line of text."""
        parts = [self.source]
        parts += [f"commit {self.commit[:12]}"] if self.commit else []
        parts += [f"checksum {self.checksum[:19]}"] if self.checksum else []
        parts += [f"image {self.image[:19]}"] if self.image else []
        return ", ".join(parts)


# An image that was built elsewhere, named by the digest of its content.


_HOST = r"(?:[A-Za-z0-9][A-Za-z0-9.-]*(?::[0-9]{1,5})?/)?"
_PATH = r"[a-z0-9]+(?:[._/-]+[a-z0-9]+)*"
_TAG = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}"
_PINNED = re.compile(rf"({_HOST}{_PATH})(?::({_TAG}))?@(sha256:[0-9a-f]{{64}})")
_MOST_CHARACTERS = 500


@dataclass(frozen=True, slots=True)
class PinnedImage:
    """An image that was built elsewhere.

    Attributes:
        repository: Registry and name, without a tag.
        tag: The tag that was stated; it says nothing about the content.
        digest: ``sha256:`` and 64 hex digits: the digest in the registry, or the id of an image that was loaded.
    """

    repository: str
    digest: str
    tag: str | None = None

    @classmethod
    def parse(cls, text: str) -> PinnedImage:
        """Read ``NAME@sha256:...`` or ``NAME:TAG@sha256:...``; raises InvalidInput."""
        found = _PINNED.fullmatch(text) if len(text) <= _MOST_CHARACTERS else None
        if found is None:
            raise InvalidInput(
                f"{text[:80]!r} names no image by its digest", "write NAME@sha256: and the 64 hex digits of its digest"
            )
        return cls(found[1], found[3], found[2])

    @property
    def reference(self) -> str:
        """Reference that an engine pulls and finds."""
        return f"{self.repository}@{self.digest}"

    @property
    def name(self) -> str:
        """The name that the image probably has too, without regard to its content."""
        return f"{self.repository}:{self.tag or 'latest'}"


# Files with trained weights that a package needs, and that nobody may ship with it.


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
