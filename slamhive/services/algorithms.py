"""Algorithm packages that somebody else made: imported from a folder, a repository, an image or an archive; removed."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import re
import shutil
import subprocess
import tarfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

from slamhive.base.clock import utc_now
from slamhive.base.debian import install_command
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import remedy_of, temporary_folder
from slamhive.base.settings import Settings
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.names import check_name
from slamhive.domain.packages import PackageOrigin
from slamhive.domain.sensors import SensorSetup
from slamhive.executors.base import ImageTools
from slamhive.packages.algorithm_file import ALGORITHM_FILE, load_algorithms
from slamhive.packages.published.draft import DraftRequest, PackageDraft, described, draft
from slamhive.packages.published.facts import FolderFacts, find_facts
from slamhive.packages.published.folder import (
    DOCKERFILE,
    SCRIPTS,
    ForeignFolder,
    copy_plain_files,
    copy_scripts,
    looks_foreign,
    read_folder,
)
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.executors import Executors

logger = logging.getLogger(__name__)

# Sources: a folder, a Git repository, an archive of an image, or the name of an image.

_GIT = re.compile(r"(?:https?|ssh|git|file)://\S+|[\w.-]+@[\w.-]+:\S+")
_REFERENCE = re.compile(r"[A-Za-z0-9][\w./-]{0,200}")
_IMAGE = re.compile(r"[a-z0-9][\w./:@-]{0,254}")
_NAME_PARTS = re.compile(r"[^A-Za-z0-9_.-]+")
_GIT_S = 1800
_SHOWN = 8
_GIT_SETTINGS = ("core.hooksPath=/dev/null", "protocol.ext.allow=never", "core.fsmonitor=false")
_GIT_PLACES = frozenset({"GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_PREFIX"})
_GIT_VARIABLES = {"GIT_TERMINAL_PROMPT": "0", "GIT_LFS_SKIP_SMUDGE": "1", "LC_ALL": "C"}


class SourceKind(StrEnum):
    """Kind of a source."""

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
    """Classify ``source``; raises NotFound or InvalidInput."""
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
        raise InvalidInput(f"{source!r} is not a folder, Git address, image or archive")
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
    try:
        done = run_git(arguments)
    except subprocess.TimeoutExpired:
        problem = f"{_without_secret(address)} did not answer within {_GIT_S} s"
        raise Unavailable(problem, "try again, or import a folder") from None
    if done.returncode != 0:
        said = git_reason(done).replace(address, "the address")
        problem = f"{_without_secret(address)} cannot be fetched: {_without_secret(said)}"
        raise Unavailable(problem, "check the address, or import a folder")
    return done.stdout


def run_git(
    arguments: Sequence[str], variables: Mapping[str, str] = MappingProxyType({})
) -> subprocess.CompletedProcess[str]:
    """Run Git without hooks and questions. Raises Unavailable if it is not installed, TimeoutExpired.

    ``variables`` come on top of the environment. A repository that a hook works in plays no role.
    """
    settings = [part for setting in _GIT_SETTINGS for part in ("-c", setting)]
    inherited = {key: value for key, value in os.environ.items() if key not in _GIT_PLACES}
    try:
        return subprocess.run(
            ["git", *settings, *arguments],  # noqa: S607 - the git of the user
            env={**inherited, **_GIT_VARIABLES, **variables},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=_GIT_S,
        )
    except FileNotFoundError:
        raise Unavailable("git is not installed", f"{install_command(['git'])}, or import a folder") from None


def git_reason(done: subprocess.CompletedProcess[str]) -> str:
    """The last line of Git, which says why it failed."""
    return (done.stderr.strip().splitlines() or ["git gives no reason"])[-1]


def check_folder(path: Path) -> None:
    """Raise InvalidInput if ``path`` is no folder of one algorithm; names those that it holds."""
    if looks_foreign(path):
        return
    inside = sorted(
        entry.name for entry in path.iterdir() if looks_foreign(entry) or (entry / ALGORITHM_FILE).is_file()
    )
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


# Plans.


@dataclass(frozen=True, slots=True)
class PackageImportRequest:
    """Request of a user to import a package.

    Attributes:
        name: Of the package; None for that of the source.
        setup: What the algorithm senses with; None to find out.
        image: The image to use with the folder, by name or as a saved file; None to build or find it.
        replace: Take the place of an imported package of that name.
        executor: The executor that gets the image; None for the one in force.
        builds: Whether an image may be built, or completed by a build. A build executes the steps of others, with the
            network.
        place: What the package remembers as its source; None for the source itself. What was sent to a server has
            no place that would mean anything to somebody.
    """

    name: str | None = None
    setup: SensorSetup | None = None
    image: str | None = None
    replace: bool = False
    executor: str | None = None
    builds: bool = True
    place: str | None = None


class Way(StrEnum):
    """Way in which an import gets the image."""

    BUILD = "build"
    LOAD = "load"
    TAKE = "take"


@dataclass(frozen=True, slots=True)
class PlannedPackage:
    """Plan of an import.

    Attributes:
        name: Of the package.
        source: What is imported.
        request: What the user asked for.
        way: How the image is got, from ``image``: a folder, an archive or a name.
        why: The reason for that, in words.
        folder: What was read; None if the scripts are in the image, which has to be there first.
        facts: What was found in it.
        draft: The drafted ``algorithm.yaml``, with what is known before the image is there.
        algorithms: Those of a folder that is a package of SLAM Hive, with an ``algorithm.yaml`` of its own.
    """

    name: str
    source: OpenedSource
    request: PackageImportRequest
    way: Way
    image: str
    why: str
    folder: ForeignFolder | None = None
    facts: FolderFacts | None = None
    draft: PackageDraft | None = None
    algorithms: tuple[Algorithm, ...] = ()

    @property
    def origin(self) -> PackageOrigin:
        """Where the package comes from, as far as it is known."""
        place = self.source.text if self.source.path is None or self.source.commit else str(self.source.path)
        return PackageOrigin(self.request.place or place, self.source.commit)

    @property
    def text(self) -> str | None:
        """The ``algorithm.yaml`` that the package has or will have; None if the image has to be there first."""
        if self.algorithms:
            return (self.algorithms[0].package.folder / ALGORITHM_FILE).read_text(encoding="utf-8")
        return None if self.draft is None else self.draft.text

    @property
    def content(self) -> dict[str, Any]:
        """The plan as plain JSON."""
        return {
            "name": self.name,
            "source": self.origin.content,
            "kind": self.source.kind.value,
            "image": {"way": self.way.value, "from": self.image, "why": self.why},
            "algorithms": [algorithm.name for algorithm in self.algorithms],
            "algorithm_yaml": self.text,
            "notes": [] if self.draft is None else list(self.draft.notes),
            "unknown": [] if self.draft is None else list(self.draft.unknown),
        }


def plan(
    source: OpenedSource, request: PackageImportRequest, tools: ImageTools, own_images: Collection[str] = ()
) -> PlannedPackage:
    """Say what an import of ``source`` will do; changes nothing. Raises InvalidInput, ImageMissing.

    ``own_images`` are the names of images that belong to packages which are here already: no import takes one unasked.
    """
    name = request.name or package_name(source)
    if source.path is None or source.kind is SourceKind.ARCHIVE:
        way = Way.TAKE if source.path is None else Way.LOAD
        image = source.text if source.path is None else str(source.path)
        return PlannedPackage(name, source, request, way, image, "its scripts are in the image")
    check_folder(source.path)
    folder = read_folder(source.path)
    facts = find_facts(folder)
    way, image, why = _image_of(folder, facts, request, tools, own_images)
    planned = PlannedPackage(name, source, request, way, image, why, folder, facts)
    drafted = draft(folder, facts, DraftRequest(name, planned.origin, request.setup))
    return PlannedPackage(name, source, request, way, image, why, folder, facts, drafted)


def plan_own(source: OpenedSource, request: PackageImportRequest) -> PlannedPackage | None:
    """Say what an import of a package of SLAM Hive will do; None for a source that is none. Raises InvalidInput."""
    if source.path is None or not (source.path / ALGORITHM_FILE).is_file():
        return None
    algorithms = load_algorithms(source.path)
    name = algorithms[0].package.name
    for option, asked in (("name", request.name), ("image", request.image), ("setup", request.setup)):
        if asked not in (None, name):
            raise InvalidInput(
                f"the algorithm.yaml of the package {name} says all about it, so --{option} {asked} has no effect",
                f"leave --{option} out, or change the file",
            )
    why = "it is a package of SLAM Hive, with an algorithm.yaml of its own"
    return PlannedPackage(name, source, request, Way.BUILD, str(source.path), why, algorithms=algorithms)


def _image_of(
    folder: ForeignFolder,
    facts: FolderFacts,
    request: PackageImportRequest,
    tools: ImageTools,
    own_images: Collection[str],
) -> tuple[Way, str, str]:
    """Decide how to get the image of a folder: way, from where, and why."""
    if request.image is not None:
        is_file = kind_of(request.image) is SourceKind.ARCHIVE
        place = str(Path(request.image).expanduser().resolve()) if is_file else request.image
        return (Way.LOAD if is_file else Way.TAKE), place, "as you asked"
    if folder.archive is not None:
        return Way.LOAD, str(folder.archive), "the folder holds it"
    published = f"slam-hive-algorithm:{folder.path.name.lower()}"
    missing = facts.dockerfile.missing if facts.dockerfile is not None else ()
    empty = facts.dockerfile.empty if facts.dockerfile is not None else ()
    if facts.dockerfile is not None and not missing and not empty:
        return Way.BUILD, str(folder.path / DOCKERFILE), "the folder holds all that it copies"
    if published not in own_images and tools.find(published) is not None:
        return Way.TAKE, published, "the engine has an image of that name"
    problem = f"{folder.path} has no {DOCKERFILE}"
    if missing:
        problem = (
            f"{folder.path / DOCKERFILE} line {missing[0][1]} copies {missing[0][0]}, which the folder does not hold"
        )
    remedy = "give the image: --image NAME, or --image FILE.tar from docker save"
    if empty and not missing:
        place, line = empty[0]
        problem = f"{folder.path / DOCKERFILE} line {line} copies {place}, which is an empty link of Git"
        remedy = f"fetch it with `git submodule update --init --recursive`, or {remedy}"
    if published in own_images:
        problem += f", and image {published} belongs to another package"
    raise InvalidInput(problem, remedy)


# Archives that ``docker save`` wrote. They may come from anywhere, so the names in them are not taken over.

_BLOCK_BYTES = 1 << 20
_MOST_TEXT_BYTES = 10_000_000
_MANIFEST, _INDEX, _NAMES = "manifest.json", "index.json", "repositories"
_TOLD_EVERY = 100_000_000
_TAR_BLOCK = 512


class ImageArchive:
    """A saved image, read as a stream.

    Args:
        path: The archive, compressed or not.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checksum = ""

    @property
    def images(self) -> int | None:
        """The number of images in the archive; None if it is no saved image. Raises InvalidInput if it is damaged."""
        with self._reading(), tarfile.open(self.path, mode="r:*") as archive:
            for member in archive:
                if member.name == _MANIFEST and member.isreg():
                    content = self._json(archive, member)
                    return len(content) if isinstance(content, list) else 0
        return None

    def check(self) -> None:
        """Raise InvalidInput unless the archive holds one image."""
        count = self.images
        if count is None:
            raise InvalidInput(f"{self.path} is not a saved image: it lacks {_MANIFEST}", "make it with docker save")
        if count != 1:
            raise InvalidInput(f"{self.path} holds {count} images, 1 is expected", "save one by itself")

    def chunks(self, progress: Callable[[str], None]) -> Iterator[bytes]:
        """The archive without the names of images; afterwards ``checksum`` is that of the file as it is.

        Loading it as it is would give its names to the image, and take them from images that are here.
        """
        total = self.path.stat().st_size
        with self._reading(), self.path.open("rb") as file:
            counted = _Counted(file, lambda done: progress(f"loaded {done / 1e6:.0f} of {total / 1e6:.0f} MB"))
            with tarfile.open(fileobj=counted, mode="r|*") as archive:
                for member in archive:
                    if member.name == _NAMES:
                        continue
                    content: IO[bytes] | None = archive.extractfile(member) if member.isreg() else None
                    if content is not None and member.name in (_MANIFEST, _INDEX):
                        text = json.dumps(_nameless(self._json(archive, member))).encode()
                        member.size, content = len(text), io.BytesIO(text)
                    yield member.tobuf(tarfile.GNU_FORMAT)
                    if content is None:
                        continue
                    while block := content.read(_BLOCK_BYTES):
                        yield block
                    yield b"\0" * (-member.size % _TAR_BLOCK)
            yield b"\0" * 2 * _TAR_BLOCK
            while counted.read(_BLOCK_BYTES):
                pass
            self.checksum = f"sha256:{counted.digest.hexdigest()}"

    def _json(self, archive: tarfile.TarFile, member: tarfile.TarInfo) -> Any:
        stream = archive.extractfile(member)
        assert stream is not None
        try:
            return json.loads(stream.read(_MOST_TEXT_BYTES))
        except (ValueError, RecursionError):
            raise InvalidInput(f"{self.path}: {member.name} is damaged", "save the image again") from None

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (tarfile.TarError, EOFError, zlib.error, OSError, OverflowError) as error:
            raise InvalidInput(f"{self.path} cannot be read as an archive: {error}", "save the image again") from None


def _nameless(content: Any) -> Any:
    """The manifest or index of an archive without names."""
    if isinstance(content, list):
        return [{**entry, "RepoTags": None} if isinstance(entry, dict) else entry for entry in content]
    if isinstance(content, dict) and isinstance(content.get("manifests"), list):
        entries = [entry for entry in content["manifests"] if isinstance(entry, dict)]
        return {**content, "manifests": [{**entry, "annotations": {}} for entry in entries]}
    return content


class _Counted(io.RawIOBase):
    """Reads a file, takes its checksum, and reports how far it came."""

    def __init__(self, file: IO[bytes], report: Callable[[int], None]) -> None:
        self._file = file
        self._report = report
        self._done = 0
        self.digest = hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        """The next bytes."""
        data = self._file.read(size)
        self.digest.update(data)
        if (self._done + len(data)) // _TOLD_EVERY > self._done // _TOLD_EVERY:
            self._report(self._done + len(data))
        self._done += len(data)
        return data


# Imports.

Progress = Callable[[str], None]
_KEPT_DOCKERFILE = "Dockerfile.imported"
"""Another name than ``Dockerfile``: the image is taken as it is, and not built by ours."""


@dataclass(frozen=True, slots=True)
class ImportedPackage:
    """Result of an import: the algorithms, and one line for each remark."""

    algorithms: tuple[Algorithm, ...]
    notes: tuple[str, ...]


class AlgorithmImports:
    """Imports packages.

    Args:
        settings: Where the packages go.
        catalogue: Knows the names that are taken.
        executors: Have the images.
    """

    def __init__(self, settings: Settings, catalogue: Catalogue, executors: Executors) -> None:
        self._settings = settings
        self._catalogue = catalogue
        self._executors = executors

    @contextmanager
    def planned(self, source: str, request: PackageImportRequest) -> Iterator[PlannedPackage]:
        """Say what an import will do, and keep its source for the block. A repository is fetched, nothing is executed.

        Raises NotFound, InvalidInput, Conflict for a name that is taken, Unavailable.
        """
        packages = [algorithm.package for algorithm in self._catalogue.algorithms()]
        own = {entry.image for entry in packages if entry.folder.parent != self._settings.algorithms_folder}
        with opened(source) as found:
            result = plan_own(found, request) or plan(found, request, self._tools(request.executor), own)

            # No name of the package, or of one of its algorithms, may be taken.
            name = check_name("package", result.name)
            here = (self._settings.algorithms_folder / name).exists()
            if here and not result.request.replace:
                problem = f"a package {name!r} was imported already"
                raise Conflict(problem, "--replace takes its place, or choose --name")
            others = [entry for entry in self._catalogue.algorithms() if not here or entry.package.name != name]
            taken = {*(entry.package.name for entry in others), *(entry.name for entry in others)}
            for wanted in (name, *(entry.name for entry in result.algorithms)):
                if wanted in taken:
                    remedy = "change it in its algorithm.yaml" if result.algorithms else "choose another --name"
                    raise Conflict(f"{wanted!r} is the name of an algorithm here already", remedy)
            yield result

    def perform(self, planned: PlannedPackage, progress: Progress) -> ImportedPackage:
        """Get the image, complete it, and make the package. A failure leaves no package behind."""
        check_writable(self._settings)
        if planned.algorithms:
            return self._perform_own(planned, progress)
        tools = self._tools(planned.request.executor)
        checksum: str | None = None
        if planned.way is Way.BUILD:
            if not planned.request.builds:
                problem = f"{planned.name} has no image, and none is built of its Dockerfile"
                raise InvalidInput(problem, "save its image")
            digest = tools.build(Path(planned.image).parent, planned.name, progress)
        elif planned.way is Way.TAKE:
            digest = tools.find(planned.image) or tools.pull(planned.image, progress)
        else:
            archive = ImageArchive(Path(planned.image))
            archive.check()
            digest, checksum = tools.load(archive.chunks(progress)), archive.checksum
        root = self._settings.algorithms_folder
        try:
            root.mkdir(parents=True, exist_ok=True)
            with temporary_folder(".import-", root) as aside:
                folder, scripts = _scripts_of(planned, digest, tools, aside)
                modules = find_facts(scripts).modules
                image = tools.complete(digest, modules, progress, builds=planned.request.builds)
                # Only now is all known that algorithm.yaml says.
                now = utc_now().isoformat(timespec="seconds")
                origin = replace(
                    planned.origin, checksum=checksum, image=image.digest, added=image.added, imported_at=now
                )
                request = DraftRequest(planned.name, origin, planned.request.setup, image.user)
                drafted = draft(scripts, find_facts(scripts), request)
                (folder / ALGORITHM_FILE).write_text(drafted.text, encoding="utf-8")
                load_algorithms(folder)
                tools.give_name(image.digest, f"slam-hive-algorithm:{planned.name}")
                _put(folder, root / planned.name)
        except OSError as error:
            raise Unavailable(f"{root} cannot be written: {error.strerror or error}", remedy_of(error)) from None
        notes = list(described(drafted))
        if image.added:
            notes.append(f"put on top of the image, since the container contract needs it: {', '.join(image.added)}")
        if image.missing:
            notes.append(f"the scripts import {', '.join(image.missing)}, which the image lacks")
        return ImportedPackage(load_algorithms(root / planned.name), tuple(notes))

    def _perform_own(self, planned: PlannedPackage, progress: Progress) -> ImportedPackage:
        """Copy a package of SLAM Hive, build it as the command ``algorithm build`` does, and put it in its place."""
        assert planned.source.path is not None
        executor = self._executors.get(self._executors.choose(planned.request.executor))
        root = self._settings.algorithms_folder
        try:
            root.mkdir(parents=True, exist_ok=True)
            with temporary_folder(".import-", root) as aside:
                folder = aside / planned.name
                notes = copy_plain_files(planned.source.path, folder)
                executor.build(load_algorithms(folder)[0].package, progress)
                _put(folder, root / planned.name)
        except OSError as error:
            raise Unavailable(f"{root} cannot be written: {error.strerror or error}", remedy_of(error)) from None
        return ImportedPackage(load_algorithms(root / planned.name), notes)

    def remove(self, name: str, executor: str | None = None) -> str | None:
        """Remove an imported package and the name of its image; in words what could not be removed.

        Runs keep their results. Raises NotFound, and InvalidInput for a package that was not imported.
        """
        check_writable(self._settings)
        folder = self._settings.algorithms_folder / check_name("package", name)
        if not folder.is_dir():
            package = self._catalogue.package(name)
            raise InvalidInput(f"{name} was not imported", f"remove its folder {package.folder}")
        shutil.rmtree(folder)
        try:
            self._tools(executor).remove(f"slam-hive-algorithm:{name}")
        except SlamHiveError as error:
            return f"its image stays: {error.message}"
        return None

    def _tools(self, executor: str | None = None) -> ImageTools:
        return self._executors.get(self._executors.choose(executor)).image_tools()


def _scripts_of(planned: PlannedPackage, digest: str, tools: ImageTools, aside: Path) -> tuple[Path, ForeignFolder]:
    """The folder of the new package with its scripts, and what was read of them."""
    folder = aside / "package"
    if planned.folder is not None:
        copy_scripts(planned.folder.path, folder / SCRIPTS)
        if planned.folder.dockerfile is not None:
            (folder / _KEPT_DOCKERFILE).write_text(planned.folder.dockerfile, encoding="utf-8")
        return folder, planned.folder
    inside = aside / "image"
    if not tools.copy_scripts(digest, inside / SCRIPTS):
        raise InvalidInput(
            f"image {planned.image} holds no /slamhive/mapping.py",
            "give the folder that holds slamhive/mapping.py, and the image with --image",
        )
    copy_scripts(inside, folder / SCRIPTS)
    return folder, read_folder(inside)


def _put(folder: Path, target: Path) -> None:
    """Move the complete package to its place."""
    if target.exists():
        shutil.rmtree(target)
    folder.rename(target)
