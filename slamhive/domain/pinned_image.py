"""An image that was built elsewhere, named by the digest of its content."""

from __future__ import annotations

import re
from dataclasses import dataclass

from slamhive.errors import InvalidInput

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
        """What an engine pulls and finds."""
        return f"{self.repository}@{self.digest}"

    @property
    def name(self) -> str:
        """The name that the image probably has too, without regard to its content."""
        return f"{self.repository}:{self.tag or 'latest'}"
