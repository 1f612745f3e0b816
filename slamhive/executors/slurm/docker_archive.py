"""Turns the archive of ``docker save`` into a folder with the files of the image. Needs neither root nor Docker.

All files belong to whoever unpacks them. Devices are left out, and so are the bits that change the user of a program.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from slamhive.errors import InvalidInput

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
            _apply(layer, root)
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


def _apply(layer: tarfile.TarFile, root: Path) -> None:
    made: set[Path] = set()
    for member in layer:
        place = _inside(root, member.name)
        if place.name == _EMPTIED:
            for path in [path for path in _children(place.parent) if path not in made]:
                _remove(path)
        elif place.name.startswith(_REMOVED):
            _remove(place.with_name(place.name.removeprefix(_REMOVED)))
        elif place != root:
            _place(layer, member, place, root)
            made.add(place)


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


def _children(folder: Path) -> Iterator[Path]:
    return folder.iterdir() if folder.is_dir() else iter(())


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
