"""What the source of an import is: a folder, a Git repository, an archive of an image, or the name of an image."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slamhive.debian import install_command
from slamhive.errors import InvalidInput, NotFound, Unavailable
from slamhive.files import temporary_folder
from slamhive.foreign.folder import looks_foreign

_GIT = re.compile(r"(?:https?|ssh|git|file)://\S+|[\w.-]+@[\w.-]+:\S+")
_REFERENCE = re.compile(r"[A-Za-z0-9][\w./-]{0,200}")
_IMAGE = re.compile(r"[a-z0-9][\w./:@-]{0,254}")
_NAME_PARTS = re.compile(r"[^A-Za-z0-9_.-]+")
_GIT_S = 1800
_SHOWN = 8
_GIT_SETTINGS = ("core.hooksPath=/dev/null", "protocol.ext.allow=never", "core.fsmonitor=false")
_GIT_VARIABLES = {"GIT_TERMINAL_PROMPT": "0", "GIT_LFS_SKIP_SMUDGE": "1", "LC_ALL": "C"}


class SourceKind(StrEnum):
    """What a source is."""

    FOLDER = "folder"
    REPOSITORY = "Git repository"
    ARCHIVE = "archive"
    IMAGE = "image"


@dataclass(frozen=True, slots=True)
class OpenedSource:
    """A source at hand.

    Attributes:
        kind: What it is.
        text: As the user gave it, without what follows ``#``.
        path: The folder or archive; None for an image.
        commit: Of a repository.
    """

    kind: SourceKind
    text: str
    path: Path | None = None
    commit: str | None = None


def kind_of(source: str) -> SourceKind:
    """What ``source`` is; raises NotFound or InvalidInput."""
    if _GIT.fullmatch(source):
        return SourceKind.REPOSITORY
    path = Path(source or "-").expanduser()
    if path.is_dir():
        return SourceKind.FOLDER
    if path.is_file():
        return SourceKind.ARCHIVE
    if source.startswith((".", "/", "~")) or source.endswith(".tar"):
        raise NotFound(f"{source} does not exist", "name a folder, a Git address, an image or a saved image")
    if not _IMAGE.fullmatch(source):
        raise InvalidInput(f"{source!r} is no folder, Git address, image or archive")
    return SourceKind.IMAGE


@contextmanager
def opened(source: str) -> Iterator[OpenedSource]:
    """Make a source available for the block; a repository is fetched. Nothing in it is executed."""
    kind = kind_of(source)
    if kind is SourceKind.REPOSITORY:
        address, _, reference = source.partition("#")
        with temporary_folder() as folder:
            path = folder / "repository"
            yield OpenedSource(kind, _without_secret(address), path, fetch(address, reference or "HEAD", path))
        return
    path = Path(source).expanduser()
    yield OpenedSource(kind, source, None if kind is SourceKind.IMAGE else path.resolve())


def fetch(address: str, reference: str, target: Path) -> str:
    """Fetch one commit of a repository without history, submodules and hooks; the commit. Raises Unavailable."""
    if not _REFERENCE.fullmatch(reference):
        raise InvalidInput(f"{reference!r} names no commit, tag or branch", "write ADDRESS#COMMIT")
    _git(["init", "--quiet", str(target)], address)
    _git(["-C", str(target), "fetch", "--quiet", "--depth=1", "--no-tags", "--", address, reference], address)
    _git(["-C", str(target), "checkout", "--quiet", "FETCH_HEAD"], address)
    return _git(["-C", str(target), "rev-parse", "HEAD"], address).strip()


def _without_secret(address: str) -> str:
    """An address without the user and password that it may hold."""
    return re.sub(r"(?<=://)[^/@]*@", "", address)


def _git(arguments: list[str], address: str) -> str:
    settings = [part for setting in _GIT_SETTINGS for part in ("-c", setting)]
    environment = {**os.environ, **_GIT_VARIABLES}
    try:
        done = subprocess.run(
            ["git", *settings, *arguments],  # noqa: S607 - the git of the user
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=_GIT_S,
        )
    except FileNotFoundError:
        raise Unavailable("git is not installed", f"{install_command(['git'])}, or import a folder") from None
    except subprocess.TimeoutExpired:
        problem = f"{_without_secret(address)} did not answer within {_GIT_S} s"
        raise Unavailable(problem, "try again, or import a folder") from None
    if done.returncode != 0:
        said = (done.stderr.strip().splitlines() or ["git gives no reason"])[-1].replace(address, "the address")
        problem = f"{_without_secret(address)} cannot be fetched: {_without_secret(said)}"
        raise Unavailable(problem, "check the address, or import a folder")
    return done.stdout


def check_folder(path: Path) -> None:
    """Raise InvalidInput if ``path`` is no folder of one algorithm; names those that it holds."""
    if (path / "algorithm.yaml").is_file():
        raise InvalidInput(
            f"{path} has an algorithm.yaml: it is a package of SLAM Hive already", "copy it to the folder algorithms/"
        )
    if looks_foreign(path):
        return
    inside = sorted(entry.name for entry in path.iterdir() if looks_foreign(entry))
    if inside:
        more = "" if len(inside) <= _SHOWN else f" and {len(inside) - _SHOWN} more"
        raise InvalidInput(
            f"{path} holds several algorithms: {', '.join(inside[:_SHOWN])}{more}", "import each of these folders"
        )


def package_name(source: OpenedSource) -> str:
    """The name of a package that the user did not name: of the folder or repository, or the tag of the image."""
    if source.kind is SourceKind.IMAGE:
        last = source.text.partition("@")[0].rpartition("/")[2]
        name = last.partition(":")[2] or last
    elif source.kind is SourceKind.REPOSITORY:
        name = re.split(r"[/:]", source.text.rstrip("/"))[-1].removesuffix(".git")
    else:
        assert source.path is not None
        is_archive = source.kind is SourceKind.ARCHIVE
        name = source.path.name.partition(".tar")[0] if is_archive else source.path.name
        name = source.path.parent.name if name == "image" else name
    return _NAME_PARTS.sub("-", name).strip("-_.").replace("..", "-")[:64] or "algorithm"
