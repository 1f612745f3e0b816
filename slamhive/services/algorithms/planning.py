"""What an import will do: read the folder, choose where the image comes from, draft ``algorithm.yaml``."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from slamhive.domain.package_origin import PackageOrigin
from slamhive.domain.sensors import SensorSetup
from slamhive.errors import InvalidInput
from slamhive.executors.images import ImageTools
from slamhive.foreign.draft import Draft, DraftRequest, draft
from slamhive.foreign.facts import FolderFacts, find_facts
from slamhive.foreign.folder import DOCKERFILE, ForeignFolder, read_folder
from slamhive.services.algorithms.sources import OpenedSource, SourceKind, check_folder, kind_of, package_name


@dataclass(frozen=True, slots=True)
class ImportRequest:
    """What the user asks for.

    Attributes:
        name: Of the package; None for that of the source.
        setup: What the algorithm senses with; None to find out.
        image: The image to use with the folder, by name or as a saved file; None to build or find it.
        replace: Take the place of an imported package of that name.
        executor: The executor that gets the image; None for the one in force.
        builds: Whether an image may be built, or completed by a build. A build executes the steps of others, with the
            network.
    """

    name: str | None = None
    setup: SensorSetup | None = None
    image: str | None = None
    replace: bool = False
    executor: str | None = None
    builds: bool = True


class Way(StrEnum):
    """How an import gets the image."""

    BUILD = "build"
    LOAD = "load"
    TAKE = "take"


@dataclass(frozen=True, slots=True)
class PlannedPackage:
    """What an import will do.

    Attributes:
        name: Of the package.
        source: What is imported.
        request: What the user asked for.
        way: How the image is got, from ``image``: a folder, an archive or a name.
        why: The reason for that, in words.
        folder: What was read; None if the scripts are in the image, which has to be there first.
        facts: What was found in it.
        draft: The drafted ``algorithm.yaml``, with what is known before the image is there.
    """

    name: str
    source: OpenedSource
    request: ImportRequest
    way: Way
    image: str
    why: str
    folder: ForeignFolder | None = None
    facts: FolderFacts | None = None
    draft: Draft | None = None

    @property
    def origin(self) -> PackageOrigin:
        """Where the package comes from, as far as it is known."""
        place = self.source.text if self.source.path is None or self.source.commit else str(self.source.path)
        return PackageOrigin(place, self.source.commit)

    @property
    def content(self) -> dict[str, Any]:
        """The plan as plain JSON."""
        return {
            "name": self.name,
            "source": self.origin.content,
            "kind": self.source.kind.value,
            "image": {"way": self.way.value, "from": self.image, "why": self.why},
            "algorithm_yaml": None if self.draft is None else self.draft.text,
            "notes": [] if self.draft is None else list(self.draft.notes),
            "unknown": [] if self.draft is None else list(self.draft.unknown),
        }


def plan(
    source: OpenedSource, request: ImportRequest, tools: ImageTools, own_images: Collection[str] = ()
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


def _image_of(
    folder: ForeignFolder, facts: FolderFacts, request: ImportRequest, tools: ImageTools, own_images: Collection[str]
) -> tuple[Way, str, str]:
    """How to get the image of a folder: way, from where, and why."""
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
