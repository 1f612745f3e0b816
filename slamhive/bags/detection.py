"""The result of an importer's look at a folder."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Detection:
    """Whether a folder has a format: ``found`` is the evidence for it, ``missing`` what it lacks; both in words."""

    found: tuple[str, ...]
    missing: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether the folder can be converted."""
        return bool(self.found) and not self.missing
