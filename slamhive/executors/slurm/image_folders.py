"""The images of a data root as folders, which container runtimes start without root.

``<data>/image-folders/sha256-<digest>/`` holds ``root/`` with the files of the image, and ``image.json`` with what else
the image says. A folder appears in one step, so it is always complete. Equal digest means equal image. ``image.sif``
has the same files as one file, if Apptainer is to have it.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import remedy_of, sweep_folder, temporary_folder

# Turns the archive of ``docker save`` into a folder with the files of the image. Needs neither root nor Docker.
#
# All files belong to whoever unpacks them. Devices are left out, and so are the bits that change the user of a
# program.


_REMOVED = ".wh."
_EMPTIED = ".wh..wh..opq"
"""How a layer says that it removes a file of the layers below, or all files of a folder."""
_FOLDERS = ("dev", "etc", "proc", "sys", "tmp", "slamhive/dataset", "slamhive/result")
_FILES = ("etc/passwd", "etc/group", "etc/hosts", "etc/resolv.conf", "slamhive/config.yaml")
"""What container runtimes mount something on."""
_LARGEST_JSON_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class ArchivedImage:
    """The description of the only image of an archive.

    Attributes:
        identity: The digest of its configuration, by which Docker names the image.
        environment: The variables that it sets.
        labels: Its labels.
        layers: The names of its layers in the archive, the lowest first.
        architecture: That of its programs, such as ``amd64``; empty if it does not say.
    """

    identity: str
    environment: dict[str, str]
    labels: dict[str, str]
    layers: tuple[str, ...]
    architecture: str = ""


def read_image(archive: tarfile.TarFile) -> ArchivedImage:
    """Read the description. Raises InvalidInput if there is not one image."""
    try:
        entries = json.loads(_read(archive, "manifest.json"))
        (entry,) = entries
        raw = _read(archive, entry["Config"])
        description = json.loads(raw)
        config = description.get("config") or {}
        variables = [text.partition("=") for text in config.get("Env") or ()]
        return ArchivedImage(
            "sha256:" + hashlib.sha256(raw).hexdigest(),
            {name: value for name, _, value in variables},
            dict(config.get("Labels") or {}),
            tuple(map(str, entry["Layers"])),
            str(description.get("architecture") or ""),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InvalidInput(f"this is no archive of one image: {error}", "make it with docker save") from None


def unpack_image(archive: tarfile.TarFile, image: ArchivedImage, root: Path) -> None:
    """Write the files of ``image`` below ``root``, an empty folder. Raises InvalidInput, OSError, TarError."""
    for name in image.layers:
        stream = _member(archive, name)
        with tarfile.open(fileobj=stream, mode="r:*") as layer:
            # A layer also says what of the layers below it is removed; what it holds itself stays.
            made: set[Path] = set()
            for member in layer:
                place = _inside(root, member.name)
                if place.name == _EMPTIED:
                    there = place.parent.iterdir() if place.parent.is_dir() else ()
                    for path in [path for path in there if path not in made]:
                        _remove(path)
                elif place.name.startswith(_REMOVED):
                    _remove(place.with_name(place.name.removeprefix(_REMOVED)))
                elif place != root:
                    _place(layer, member, place, root)
                    made.add(place)
    for folder in _FOLDERS:
        _inside(root, folder).mkdir(parents=True, exist_ok=True)
    for file in _FILES:
        _inside(root, file).touch()


def make_mount_point(root: Path, name: str, *, is_folder: bool) -> None:
    """Ensure that there is something at ``name`` below ``root`` to mount on. Raises InvalidInput at a link, OSError."""
    place = _inside(root, name)
    if is_folder:
        place.mkdir(parents=True, exist_ok=True)
    elif not place.exists():
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch()


def _place(layer: tarfile.TarFile, member: tarfile.TarInfo, place: Path, root: Path) -> None:
    """Write one file, folder or link in the place of what lies there."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if not (member.isdir() and place.is_dir() and not place.is_symlink()):
        _remove(place)
    if member.isdir():
        place.mkdir(exist_ok=True)
        place.chmod(member.mode & 0o777 | 0o700)
    elif member.issym():
        place.symlink_to(member.linkname)
    elif member.islnk():
        os.link(_inside(root, member.linkname), place, follow_symlinks=False)
    elif member.isreg():
        source = layer.extractfile(member)
        assert source is not None
        with source, place.open("wb") as target:
            shutil.copyfileobj(source, target, 1 << 20)
        place.chmod(member.mode & 0o777 | 0o600)
        # Python compiles modules again if their time has changed.
        os.utime(place, (member.mtime, member.mtime))


def _inside(root: Path, name: str) -> Path:
    """The place of ``name`` below ``root``. Raises InvalidInput if it leads out, which a link of the image can do."""
    place = root
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", ".")]
    for number, part in enumerate(parts, start=1):
        place = place / part
        if part == ".." or (number < len(parts) and place.is_symlink()):
            raise InvalidInput(f"the image has a file behind a link: {name[:80]!r}", "build the image again")
    return place


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _read(archive: tarfile.TarFile, name: str) -> bytes:
    return _member(archive, name).read(_LARGEST_JSON_BYTES)


def _member(archive: tarfile.TarFile, name: str) -> IO[bytes]:
    found: Any = archive.extractfile(name)
    if found is None:
        raise KeyError(name)
    stream: IO[bytes] = found
    return stream


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
