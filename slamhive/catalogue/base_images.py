"""The images that Dockerfiles of packages start from, besides the plain Debian: ``docker/<base>/<part>/Dockerfile``.

A Dockerfile that declares ``ARG RUN_IMAGE`` gets the image of the part ``run`` of its package's base. Parts may start
from each other in the same way.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from slamhive.errors import InvalidInput
from slamhive.files import hash_files

COMPILE_STAGE = "compile.Dockerfile"
"""In packages of ROS 1 with ``image: standard``: the stage ``build``, which leaves what runs in ``/opt/ros1``."""

_ARGUMENT = re.compile(r"^ARG\s+([A-Z][A-Z0-9]*)_IMAGE\b", re.MULTILINE)
_SOURCE = re.compile(r"^ARG\s+\w+=https?://\S*?/([\w.-]+?)(?:\.git)?#([0-9a-f]{7,40})\s*$", re.MULTILINE)
_SHORT_COMMIT = 7


@dataclass(frozen=True, slots=True)
class BaseImage:
    """One part of a base.

    Attributes:
        name: Repository and tag.
        argument: The build argument by which Dockerfiles get it.
        folder: Its Dockerfile and what that copies.
        needs: The parts that it starts from.
        content: The hash of all that it is made from; an image with another one is out of date.
    """

    name: str
    argument: str
    folder: Path
    needs: tuple[BaseImage, ...]
    content: str


def read_dockerfile(*parts: Path) -> str:
    """The text of a Dockerfile that is in one file, or in several that follow each other. Raises InvalidInput."""
    texts = []
    for path in parts:
        try:
            texts.append(path.read_text("utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidInput(f"{path} cannot be read: {error}") from None
    return "".join(texts)


def base_images(dockerfile: str, base: str, project_root: Path) -> tuple[BaseImage, ...]:
    """The parts of ``base`` that the text of a Dockerfile declares. Raises InvalidInput if a part cannot be read."""
    declared = _ARGUMENT.findall(dockerfile)
    folders = {part: project_root / f"docker/{base}/{part.lower()}" for part in declared}
    return tuple(_base_image(base, folder, project_root) for folder in folders.values() if _is_part(folder))


def source_archives(dockerfile: str) -> tuple[str, ...]:
    """The names of the archives that may replace the repositories in the text of a Dockerfile.

    ``ARG SOURCE=https://example.org/A-LOAM#e51f88c`` has ``A-LOAM-e51f88c.tar.xz``: the files of that commit below one
    folder.
    """
    found = _SOURCE.findall(dockerfile)
    return tuple(f"{name}-{commit[:_SHORT_COMMIT]}.tar.xz" for name, commit in found)


def stage_sources(dockerfile: str, archives: Path | None, target: Path) -> None:
    """Copy the archives of ``dockerfile`` that are in ``archives`` to ``target``, which is made. Raises OSError."""
    target.mkdir()
    for name in source_archives(dockerfile) if archives else ():
        if archives is not None and (archives / name).is_file():
            shutil.copy(archives / name, target)


def _is_part(folder: Path) -> bool:
    return (folder / "Dockerfile").is_file()


def _base_image(base: str, folder: Path, project_root: Path) -> BaseImage:
    part = folder.name
    needs = base_images(read_dockerfile(folder / "Dockerfile"), base, project_root)
    content = hashlib.sha256("".join([hash_files(folder), *(image.content for image in needs)]).encode()).hexdigest()
    return BaseImage(f"slam-hive-base:{base}-{part}", f"{part.upper()}_IMAGE", folder, needs, f"sha256:{content}")
