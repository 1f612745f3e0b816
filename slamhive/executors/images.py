"""Tools of an executor with images for imports of packages that somebody else made."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from slamhive.executors.base import ProgressCallback


@dataclass(frozen=True, slots=True)
class CompletedImage:
    """An image that keeps the container contract.

    Attributes:
        digest: Its digest.
        user: The user that it names; empty for root.
        added: What had to be put on top, in words.
        missing: Modules that the scripts import and the image lacks.
    """

    digest: str
    user: str
    added: tuple[str, ...]
    missing: tuple[str, ...]


class ImageTools(Protocol):
    """Finds, loads, builds and completes images. All methods may raise EngineUnavailable and ImageMissing."""

    def find(self, name: str) -> str | None:
        """The digest of the image called ``name``; None if the engine does not have it."""

    def pull(self, name: str, progress: ProgressCallback) -> str:
        """Get an image from its registry; its digest."""

    def load(self, chunks: Iterable[bytes]) -> str:
        """Take the image of an archive; its digest. Names in the archive must have been removed."""

    def build(self, folder: Path, name: str, progress: ProgressCallback) -> str:
        """Build the Dockerfile of ``folder`` with that folder as its context; the digest."""

    def complete(
        self, digest: str, modules: Collection[str], progress: ProgressCallback, *, builds: bool = True
    ) -> CompletedImage:
        """Ensure that the image has python3 and PyYAML, or put them on top; look for ``modules`` too.

        Without ``builds``, nothing is put on top: raises ImageMissing that says what the image lacks.
        """

    def copy_scripts(self, digest: str, target: Path) -> bool:
        """Copy the plain files of ``/slamhive`` in the image to ``target``; False if it has none."""

    def give_name(self, digest: str, name: str) -> None:
        """Call the image ``name``."""

    def remove(self, name: str) -> None:
        """Take the name from an image, and remove the image unless something else uses it."""
