"""What an importer says of a folder it has looked at."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Detection:
    """Whether a folder is in one format: ``found`` speaks for it, ``missing`` is needed and absent; both in words."""

    found: tuple[str, ...]
    missing: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """The folder can be converted as it is."""
        return bool(self.found) and not self.missing
