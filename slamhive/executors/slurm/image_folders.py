"""The images of a data root as folders, which container runtimes start without root.

``<data>/image-folders/sha256-<digest>/`` holds ``root/`` with the files of the image, and ``image.json`` with what else
the image says. A folder appears in one step, so it is always complete. Equal digest means equal image. ``image.sif``
has the same files as one file, if Apptainer is to have it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from slamhive.errors import InvalidInput, Unavailable
from slamhive.executors.slurm.docker_archive import ArchivedImage, read_image, unpack_image
from slamhive.files import remedy_of, sweep_folder, temporary_folder

_STAGED = ".image-"
_DESCRIPTION = "image.json"
_SIF = "image.sif"
_PREFIX = "sha256:"


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """An image that has been unpacked, with the variables and labels that it sets.

    ``architecture`` is that of its programs, such as ``amd64``; empty if nobody knows. ``sif`` is the image as one
    file; None if there is none.
    """

    root: Path
    environment: dict[str, str]
    labels: dict[str, str]
    architecture: str = ""
    sif: Path | None = None


class ImageFolders:
    """All image folders of a data root, which must lie on the file system that the nodes share."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "image-folders"

    def find(self, identity: str) -> ImageFolder | None:
        """The image with this digest; None if it has not been unpacked, or if it is no digest."""
        if not identity.startswith(_PREFIX):
            return None
        folder = self._of(identity)
        try:
            content = json.loads((folder / _DESCRIPTION).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        architecture = content.get("architecture", "")  # earlier versions did not record it
        sif = folder / _SIF
        found = sif if sif.exists() else None
        return ImageFolder(folder / "root", content["environment"], content["labels"], architecture, found)

    def with_label(self, label: str, value: str) -> str | None:
        """The digest of an image whose label has this value; None if there is none."""
        for folder in sorted(self._folder.glob("sha256-*")):
            identity = folder.name.replace("-", ":", 1)
            found = self.find(identity)
            if found is not None and found.labels.get(label) == value:
                return identity
        return None

    def add(self, chunks: Iterable[bytes], identity: str | None = None) -> str:
        """Unpack what ``docker save`` wrote, unless it is there; the digest.

        Args:
            chunks: The archive.
            identity: The name of the image in its engine; None for the digest of its configuration.

        Raises:
            InvalidInput: It is no archive of one image.
            Unavailable: The disk is full, or cannot be written.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with temporary_folder(_STAGED, self._folder) as staged, tempfile.TemporaryFile(dir=self._folder) as file:
                for chunk in chunks:
                    file.write(chunk)
                file.seek(0)
                with tarfile.open(fileobj=file) as archive:
                    image = read_image(archive)
                    identity = identity or image.identity
                    with self._locked(identity):
                        if self.find(identity) is None:
                            self._unpack(archive, image, staged / "image", identity)
        except tarfile.TarError as error:
            raise InvalidInput(f"the archive of the image cannot be read: {error}", "export the image again") from None
        except OSError as error:
            raise Unavailable(f"{self._folder} cannot be written: {error.strerror}", remedy_of(error)) from None
        return identity

    def pack(self, identity: str, write: Callable[[Path, Path], None]) -> None:
        """Also have an image that has been unpacked as one file, unless it is there.

        ``write`` gets the folder and the place of the file, and raises what is wrong.
        """
        folder = self._of(identity)
        with self._locked(identity):
            if not (folder / _SIF).exists():
                aside = folder / f".{_SIF}"
                aside.unlink(missing_ok=True)  # that of a killed process
                write(folder / "root", aside)
                aside.rename(folder / _SIF)

    def remove(self, identity: str) -> None:
        """Remove the image; nothing if it is not there."""
        folder = self._of(identity)
        # Without its description it is no image any more, also if the rest cannot be removed.
        (folder / _DESCRIPTION).unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove what killed processes have left of images that they unpacked."""
        for staged in self._folder.glob(f"{_STAGED}*"):
            sweep_folder(staged)

    def _unpack(self, archive: tarfile.TarFile, image: ArchivedImage, staged: Path, identity: str) -> None:
        root = staged / "root"
        root.mkdir(parents=True)
        unpack_image(archive, image, root)
        (staged / _DESCRIPTION).write_text(json.dumps(asdict(image)), encoding="utf-8")
        target = self._of(identity)
        shutil.rmtree(target, ignore_errors=True)  # the remains of one that was being removed
        staged.rename(target)

    @contextlib.contextmanager
    def _locked(self, identity: str) -> Iterator[None]:
        """One process at a time unpacks an image; the kernel frees the lock of a killed one."""
        name = f".{self._of(identity).name}.lock"
        descriptor = os.open(self._folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)

    def _of(self, identity: str) -> Path:
        return self._folder / f"sha256-{identity.removeprefix(_PREFIX)}"
