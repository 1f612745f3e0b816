"""The build context of an algorithm image: files of the package, of the runtime and of the host."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import slamhive
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import hash_files
from slamhive.domain.algorithm import AlgorithmPackage, Base

# The images that Dockerfiles of packages start from, besides the plain Debian: ``docker/<base>/<part>/Dockerfile``.
#
# A Dockerfile that declares ``ARG RUN_IMAGE`` gets the image of the part ``run`` of its package's base. Parts may
# start from each other in the same way.


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
    images = []
    for folder in folders.values():
        if (folder / "Dockerfile").is_file():
            needs = base_images(read_dockerfile(folder / "Dockerfile"), base, project_root)
            whole = "".join([hash_files(folder), *(image.content for image in needs)])
            content = f"sha256:{hashlib.sha256(whole.encode()).hexdigest()}"
            part = folder.name
            images.append(BaseImage(f"slam-hive-base:{base}-{part}", f"{part.upper()}_IMAGE", folder, needs, content))
    return tuple(images)


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


HOST_CERTIFICATES = Path("/usr/local/share/ca-certificates")
"""Where Debian and Ubuntu keep the certificates of private authorities."""

RUNTIME_PARTS = (
    "__init__.py",
    *(f"base/{name}.py" for name in ("__init__", "debian", "errors", "files", "bounds", "strict_yaml")),
    "runtime",
)
"""What runs inside the images: the runtime and the modules that it imports."""

RENDERING_PARTS = (
    "__init__.py",
    "base/__init__.py",
    "base/errors.py",
    "base/files.py",
    "runtime/__init__.py",
    "runtime/paths.py",
    "runtime/trajectory.py",
    "recordings/__init__.py",
    "recordings/geometry.py",
    "recordings/room",
)
"""The code that renders images on which the ``prepare.py`` of a package can train."""

CONTENT_LABEL = "slamhive.content"
"""The label of an image that holds what :func:`context_hash` was when it was built."""

BASE_SCRIPT = "docker/base/install-runtime.sh"
STANDARD_DOCKERFILES = {Base.PYTHON: "docker/algorithm/Dockerfile", Base.ROS1: "docker/ros1/Dockerfile"}
"""What makes the images of packages with ``image: standard``."""

_PASSED_ON = ("PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL")
_LEFT_OUT = shutil.ignore_patterns("__pycache__", "*.pyc")


@dataclass(frozen=True, slots=True)
class BuildContext:
    """A staged context: its folder, the Dockerfile's path in it, and the build arguments."""

    path: Path
    dockerfile: str
    build_args: dict[str, str]


def dockerfile_of(package: AlgorithmPackage, project_root: Path) -> str | None:
    """The Dockerfile of a package; None if somebody else makes its image. Raises InvalidInput if it cannot be read.

    The standard one of ROS 1 goes on from the package's own stage that compiles. A package whose image is named by
    digest may keep the Dockerfile that made it; nothing is built from that here.
    """
    if package.pinned_image is not None:
        return None
    parts = [package.folder / "Dockerfile"]
    if package.standard_image:
        parts = [project_root / STANDARD_DOCKERFILES[package.base]]
        if package.base is Base.ROS1:
            parts.insert(0, package.folder / COMPILE_STAGE)
    return read_dockerfile(*parts) if all(path.is_file() for path in parts) else None


def images_of(package: AlgorithmPackage, project_root: Path) -> tuple[BaseImage, ...]:
    """The parts of its base that the Dockerfile of a package starts from."""
    dockerfile = dockerfile_of(package, project_root)
    return () if dockerfile is None else base_images(dockerfile, package.base, project_root)


def stage_context(
    package: AlgorithmPackage,
    project_root: Path,
    target: Path,
    certificates: Path = HOST_CERTIFICATES,
    environment: Mapping[str, str] = os.environ,
    archives: Path | None = None,
) -> BuildContext:
    """Write the build context of a package to ``target``, which must not exist.

    Args:
        package: With ``image: standard`` or a Dockerfile of its own.
        project_root: Folder with ``docker``.
        target: The context; ``docker/base/README.md`` explains its layout.
        certificates: Folder whose ``*.crt`` files the image trusts during the build; may be absent.
        environment: Its ``BASE_IMAGE`` and index settings of pip become build arguments.
        archives: Folder with sources as archives, for hosts that do not reach the repositories.

    Raises:
        InvalidInput: the package has no Dockerfile.
        Unavailable: the disk refuses.
    """
    dockerfile = dockerfile_of(package, project_root)
    if dockerfile is None:
        raise InvalidInput(f"{package.folder} has no Dockerfile", "add one, or load the image with docker load")
    source = Path(slamhive.__file__).parent
    try:
        shutil.copytree(package.folder, target / "package", ignore=_LEFT_OUT)
        (target / "Dockerfile").write_text(dockerfile, "utf-8")
        copy_parts(source, RUNTIME_PARTS, target / "runtime" / "slamhive")
        copy_parts(source, RENDERING_PARTS, target / "rendering" / "slamhive")
        _stage_certificates(certificates, target / "base")
        shutil.copy(project_root / BASE_SCRIPT, target / "base")
        shutil.copy(source / "runtime" / "requirements.txt", target / "base")
        stage_sources(dockerfile, archives, target / "sources")
        _set_plain_modes(target)
    except OSError as error:
        raise Unavailable(f"the build context {target} cannot be made: {error}", "check space and rights") from None
    arguments = build_arguments(environment)
    if package.standard_image and package.system_packages:
        arguments["SYSTEM_PACKAGES"] = " ".join(package.system_packages)
    return BuildContext(target, "Dockerfile", arguments)


def stage_base_context(image: BaseImage, target: Path, archives: Path | None = None) -> BuildContext:
    """Write the build context of a part of a base to ``target``, which must not exist. Raises Unavailable."""
    try:
        shutil.copytree(image.folder, target / "part", ignore=_LEFT_OUT)
        _stage_certificates(HOST_CERTIFICATES, target / "base")
        stage_sources(read_dockerfile(image.folder / "Dockerfile"), archives, target / "sources")
        _set_plain_modes(target)
    except OSError as error:
        raise Unavailable(f"the build context {target} cannot be made: {error}", "check space and rights") from None
    return BuildContext(target, "part/Dockerfile", build_arguments())


def build_arguments(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The build arguments that the host's environment names: base image and pip's index settings."""
    return {key: environment[key] for key in ("BASE_IMAGE", *_PASSED_ON) if environment.get(key)}


def context_hash(package: AlgorithmPackage, project_root: Path) -> str:
    """SHA-256 of everything that goes into an image; an image with another hash is out of date."""
    source = Path(slamhive.__file__).parent
    standard = (STANDARD_DOCKERFILES[package.base],) if package.standard_image else ()
    project_parts = (BASE_SCRIPT, *standard)
    parts = [hash_files(package.folder), hash_files(source, RUNTIME_PARTS), hash_files(project_root, project_parts)]
    if (package.folder / "prepare.py").is_file():
        parts.append(hash_files(source, RENDERING_PARTS))
    parts += [image.content for image in images_of(package, project_root)]
    return "sha256:" + hashlib.sha256("".join(parts).encode()).hexdigest()


def copy_parts(source: Path, parts: tuple[str, ...], target: Path) -> None:
    """Copy files and folders below ``source`` to the same places below ``target``. Raises OSError."""
    for part in parts:
        copy = target / part
        copy.parent.mkdir(parents=True, exist_ok=True)
        if (source / part).is_dir():
            shutil.copytree(source / part, copy, ignore=_LEFT_OUT)
        else:
            shutil.copy(source / part, copy)


def _stage_certificates(certificates: Path, base: Path) -> None:
    (base / "ca-certificates").mkdir(parents=True)
    for certificate in sorted(certificates.glob("*.crt")):
        shutil.copy(certificate, base / "ca-certificates")


def _set_plain_modes(folder: Path) -> None:
    """Make files readable by any user, whatever the umask of the checkout: runs have the controller's user id."""
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)
