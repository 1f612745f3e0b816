"""Where an imported package comes from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

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
        """What is known, as plain JSON."""
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
