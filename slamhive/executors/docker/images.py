"""Images of algorithm packages: found, pulled or built, and checked to keep the container contract."""

from __future__ import annotations

import os
import re
import shutil
import tarfile
import tempfile
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from textwrap import shorten
from types import MappingProxyType
from typing import IO, Any, cast

import docker
import docker.errors
from docker.utils.build import tar

from slamhive.base.errors import InvalidInput
from slamhive.base.files import temporary_folder
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.packages import PinnedImage
from slamhive.executors.base import ExecutorContext, ImageMissing, ProgressCallback
from slamhive.executors.build_program import run_program
from slamhive.executors.docker.engine import closing_chunks, engine_errors, labels_of_helper
from slamhive.packages.image_context import (
    CONTENT_LABEL,
    BaseImage,
    BuildContext,
    context_hash,
    dockerfile_of,
    images_of,
    stage_base_context,
    stage_context,
)

# Building images with the engine, whatever they are for: base image, build arguments, progress, staleness.


PUBLIC_BASE = "debian:bookworm-slim"
OWN_BASE = "slam-hive-base:bookworm"
SAME_AS_PUBLIC = ("debian:12-slim", "debian:bookworm", "debian:12")
"""Other names of the same Debian, or of the same with documentation."""
WORKER_IMAGE = "slam-hive-worker:latest"
"""The image of the deployment. It has debootstrap."""
BASE_ARGUMENT = "BASE_IMAGE"
CHECK = "--check"
_MAKING_S = 1800
_REASON_CHARACTERS = 300
_LAST_LINES = 4
_ENGINE_CHATTER = ("--->", "Removing intermediate container", "Removing container")


def get_image(client: docker.DockerClient, name: str) -> Any | None:
    """The image called ``name``, None if the engine does not have it."""
    with engine_errors(f"looking for {name}", ImageMissing):
        try:
            return client.images.get(name)
        except docker.errors.ImageNotFound:
            return None


def content_of(image: Any) -> str | None:
    """The hash of what the image was made from; None for an image that was not built here."""
    return (image.labels or {}).get(CONTENT_LABEL)


def build_image(
    client: docker.DockerClient,
    name: str,
    context: BuildContext,
    content: str,
    project_root: Path,
    progress: ProgressCallback,
) -> str:
    """Build an image from a staged context; returns its digest. Raises ImageMissing naming the step that failed.

    The image has no name yet, so that nobody takes it before the caller has looked into it and called
    :func:`name_image`.

    The build has the host's network: packages come from wherever the host gets them, mirrors and proxies included.

    Args:
        client: The engine.
        name: What it will be called, for messages.
        context: The staged context; a base image is chosen unless its arguments name one.
        content: The hash of what the image is made from, kept as a label.
        project_root: The folder with ``docker/base``.
        progress: Called with each line.
    """
    arguments = dict(context.build_args)
    if BASE_ARGUMENT not in arguments:
        arguments[BASE_ARGUMENT] = choose_base(client, project_root, progress)
    options = {"dockerfile": context.dockerfile, "buildargs": arguments, "labels": {CONTENT_LABEL: content}}
    with packed_context(context.path) as packed:
        return build_packed(client, name, packed, progress, options)


def build_packed(
    client: docker.DockerClient,
    name: str,
    packed: IO[bytes],
    progress: ProgressCallback,
    options: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """Build a packed context; returns the digest. ``options`` are the SDK's. Raises ImageMissing."""
    with engine_errors(f"building {name}", ImageMissing):
        events = client.api.build(
            fileobj=packed, custom_context=True, network_mode="host", rm=True, forcerm=True, decode=True, **options
        )
        # If ``progress`` raises, the connection is closed, and with it the engine ends the build.
        with closing(cast("Generator[dict[str, Any], None, None]", events)) as opened:
            digest = follow_build(opened, name, progress)
    if digest is None:
        raise ImageMissing(f"{name} was built, but the engine does not say where it is", "build it again")
    return digest


@contextmanager
def packed_context(folder: Path, exclude: Iterable[str] = ()) -> Iterator[IO[bytes]]:
    """The files of a folder as the engine takes them; links stay links.

    The archive has no name in the file system, so a killed process leaves nothing. The SDK's own has one.
    """
    with tempfile.TemporaryFile() as archive:
        tar(str(folder), exclude=list(exclude), fileobj=archive)  # type: ignore[arg-type]
        yield archive


def name_image(client: docker.DockerClient, digest: str, name: str) -> None:
    """Call an image ``name`` (repository and tag). Raises ImageMissing."""
    repository, _, tag = name.rpartition(":")
    with engine_errors(f"naming {name}", ImageMissing):
        client.api.tag(digest, repository, tag)


def follow_pull(
    client: docker.DockerClient, repository: str, tag: str, name: str, progress: ProgressCallback
) -> str | None:
    """Pull an image, and pass on how far it is under ``name``; what the engine could not do, None if nothing.

    It reads on to the end, as :func:`follow_build` does.
    """
    problem: str | None = None
    for event in client.api.pull(repository, tag=tag, stream=True, decode=True):
        if "error" in event:
            problem = str(event["error"])
        progress(f"{name}: {event.get('status', '')} {event.get('progress', '')}".strip())
    return problem


def choose_base(client: docker.DockerClient, project_root: Path, progress: ProgressCallback) -> str:
    """The image to build on. Raises ImageMissing that says what is missing.

    It is the public one if the engine has it or a registry offers it. Otherwise one is made: on this machine, or in a
    container of the worker's image where the engine has that. ``progress`` gets the way and the reason for it.
    """
    for name in (PUBLIC_BASE, OWN_BASE, *SAME_AS_PUBLIC):
        if get_image(client, name) is not None:
            return name
    repository, _, tag = PUBLIC_BASE.rpartition(":")
    progress(f"pulling {PUBLIC_BASE}")
    try:
        with engine_errors(f"pulling {PUBLIC_BASE}", ImageMissing):
            client.images.pull(repository, tag=tag)
    except ImageMissing as error:
        progress(f"{error.message}; making {OWN_BASE}")
    else:
        return PUBLIC_BASE
    script = project_root / "docker" / "base" / "make-base.sh"
    with temporary_folder() as folder:
        archive = folder / "base.tar"
        problem = _run_script(script, CHECK, progress)
        if problem is None:
            problem = _run_script(script, str(archive), progress)
        elif get_image(client, WORKER_IMAGE) is not None:
            progress(f"{problem}; so it is made in a container of {WORKER_IMAGE}")
            problem = _make_in_container(client, script, archive)
        if problem is not None:
            raise ImageMissing(f"no registry offers {PUBLIC_BASE}, and it cannot be made here: {problem}")
        repository, _, tag = OWN_BASE.rpartition(":")
        with engine_errors(f"importing {OWN_BASE}", ImageMissing):
            answer = client.api.import_image_from_file(str(archive), repository, tag, changes=['CMD ["/bin/sh"]'])
        if get_image(client, OWN_BASE) is None:
            raise ImageMissing(f"the engine did not take {OWN_BASE}: {answer}", "set BASE_IMAGE")
    return OWN_BASE


def _run_script(script: Path, argument: str, progress: ProgressCallback) -> str | None:
    """Run the script that makes the base, its lines to ``progress``; what went wrong in one line, None if nothing."""
    said: list[str] = []

    def show(line: str) -> None:
        said.append(line)
        progress(f"{OWN_BASE}: {line}")

    return None if run_program(["/bin/sh", str(script), argument], os.environ, show) == 0 else _reason(said)


def _reason(said: list[str]) -> str:
    """The line that says what went wrong: the first error of debootstrap and mmdebstrap, else the last line."""
    errors = [line for line in said if line.startswith("E: ")]
    return shorten((errors or said[-1:] or ["it says nothing"])[0], _REASON_CHARACTERS, placeholder=" …")


def _make_in_container(client: docker.DockerClient, script: Path, archive: Path) -> str | None:
    """Make the base in a container of the worker's image, which has debootstrap; as :func:`_run_script`."""
    command = ["/bin/sh", "-c", script.read_text(encoding="utf-8"), script.name, "/base.tar"]
    options: dict[str, Any] = {"network_mode": "host", "user": "0:0", "labels": labels_of_helper("base", "")}
    mirror = os.environ.get("MIRROR")
    with engine_errors(f"making {OWN_BASE}", ImageMissing):
        environment = {"MIRROR": mirror} if mirror else {}
        container = client.containers.create(WORKER_IMAGE, command, environment=environment, **options)
        try:
            container.start()
            if container.wait(timeout=_MAKING_S)["StatusCode"] != 0:
                return _reason(container.logs().decode(errors="replace").strip().splitlines())
            with closing_chunks(container.get_archive("/base.tar")[0]) as chunks, tempfile.TemporaryFile() as packed:
                for chunk in chunks:
                    packed.write(chunk)
                packed.seek(0)
                with tarfile.open(fileobj=packed) as outer, archive.open("wb") as target:
                    member = outer.extractfile("base.tar")
                    assert member is not None
                    shutil.copyfileobj(member, target)
        finally:
            container.remove(force=True, v=True)
    return None


_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
"""The engine paints red what a step writes to its error output, warnings too."""
_STEP_CHARACTERS = 120
"""A step that is longer is a script. Its beginning says which it is."""


def follow_build(events: Iterable[dict[str, Any]], name: str, progress: ProgressCallback) -> str | None:
    """Pass the lines of a build on; the digest of what was built, None if the engine does not say.

    Raises ImageMissing naming the step that failed and its last lines. It reads on to the end before: an answer that
    is left in the middle keeps its connection.
    """
    problem: str | None = None
    step = "the first step"
    digest: str | None = None
    last: deque[str] = deque(maxlen=_LAST_LINES)
    for event in events:
        for raw in _COLOUR.sub("", str(event.get("stream", ""))).splitlines():
            line = raw.strip()
            if not line or line.startswith(_ENGINE_CHATTER):
                continue
            if line.startswith("Step "):
                step = shorten(line, _STEP_CHARACTERS, placeholder=" …")
                last.clear()
            else:
                last.append(line)
            progress(f"{name}: {line}")
        if "error" in event:
            problem = f"building {name} failed at {step}: {' | '.join([*last, str(event['error'])])}"
        if "ID" in (event.get("aux") or {}):
            digest = str(event["aux"]["ID"])
    if problem is not None:
        raise ImageMissing(problem)
    return digest


# Images that packages name by digest: found, or pulled, and never taken for another one.


_DIGITS = 19
"""``sha256:`` and 12 digits, as Docker shows them."""


def find_pinned(client: docker.DockerClient, pinned: PinnedImage) -> str | None:
    """The id of the image if the engine has exactly this one; None if not.

    An image that came from a registry is known by the digest that it has there, a loaded one by its id.
    """
    for name in (pinned.reference, pinned.digest):
        image = get_image(client, name)
        if image is not None and pinned.digest in _digests(image):
            return str(image.id)
    return None


def pull_pinned(client: docker.DockerClient, package: str, pinned: PinnedImage, progress: ProgressCallback) -> str:
    """Pull the image; its id. Raises ImageMissing, also if the registry has another one under that name only."""
    problem = "the registry does not have it"
    progress(f"pulling {pinned.reference}")
    try:
        with engine_errors(f"pulling {pinned.reference}", ImageMissing):
            problem = follow_pull(client, pinned.repository, pinned.digest, package, progress) or problem
    except ImageMissing as error:
        problem = error.message
    found = find_pinned(client, pinned)
    if found is None:
        raise ImageMissing(
            f"{package} wants the image {pinned.reference}, {_instead(client, pinned)}: {problem}",
            "push or load that image, or correct image in its algorithm.yaml",
        )
    return found


def _instead(client: docker.DockerClient, pinned: PinnedImage) -> str:
    """Describe what the engine has under the same name."""
    image = get_image(client, pinned.name)
    if image is None:
        return "which is not here"
    has = ", ".join(sorted(digest[:_DIGITS] for digest in _digests(image)))
    return f"but {pinned.name} is {has}"


def _digests(image: Any) -> set[str]:
    """The id of an image, and its digests in registries."""
    known = [str(entry).partition("@")[2] for entry in image.attrs.get("RepoDigests") or []]
    return {str(image.id), *filter(None, known)}


MAPPING_SCRIPT = "/slamhive/mapping.py"


def find_image(client: docker.DockerClient, package: AlgorithmPackage, project_root: Path) -> str | None:
    """The digest (image id) that a start would use now; None if the image is missing or out of date.

    A package without a Dockerfile uses an image of the published SLAM Hive, without regard to its labels. A package
    that names an image by digest uses that one and no other.
    """
    if package.pinned_image is not None:
        return find_pinned(client, package.pinned_image)
    image = get_image(client, package.image)
    if image is None:
        return None
    made_here = dockerfile_of(package, project_root) is not None
    if made_here and content_of(image) != context_hash(package, project_root):
        return None
    return str(image.id)


def make_image(
    client: docker.DockerClient, package: AlgorithmPackage, context: ExecutorContext, progress: ProgressCallback
) -> str:
    """Find, pull or build the image of ``package``; returns its digest. Raises ImageMissing."""
    project_root = context.project_root
    found = find_image(client, package, project_root)
    if found is not None:
        return found
    if package.pinned_image is not None:
        digest = pull_pinned(client, package.name, package.pinned_image, progress)
        if (package.folder / "Dockerfile").is_file():
            check_mapping_script(client, digest, package.image, context.installation)
        return digest
    if dockerfile_of(package, project_root) is None:
        name, _, tag = package.image.rpartition(":")
        remedy = f"load it with docker load, or add a Dockerfile to {package.folder}"
        if package.origin is not None:
            again = f"slamhive algorithm import {package.origin.source} --name {package.name} --replace"
            remedy = f"import it again: {again}"
        problem = "the registry does not have it"
        try:
            with engine_errors(f"pulling {package.image}", ImageMissing):
                problem = follow_pull(client, name, tag, package.image, progress) or problem
        except ImageMissing as error:
            problem = error.message
        # It may be here from an earlier time, and do without a registry.
        image = get_image(client, package.image)
        if image is None:
            raise ImageMissing(f"{package.image} cannot be pulled: {problem}", remedy)
        return str(image.id)
    content = context_hash(package, project_root)
    arguments = _make_base_images(client, images_of(package, project_root), context, progress)
    with temporary_folder() as folder:
        staged = stage_context(package, project_root, folder / "context", archives=context.source_archives)
        staged.build_args.update(arguments)
        digest = build_image(client, package.image, staged, content, project_root, progress)
    check_mapping_script(client, digest, package.image, context.installation)
    name_image(client, digest, package.image)
    return digest


def check_mapping_script(client: docker.DockerClient, digest: str, name: str, installation: str) -> None:
    """Raise ImageMissing if the image lacks ``/slamhive/mapping.py``. Nothing of the image is run for it."""
    with engine_errors(f"looking into {name}", ImageMissing):
        labels = labels_of_helper("check", installation)
        container = client.containers.create(digest, command=["true"], network_mode="none", labels=labels)
        try:
            with closing_chunks(container.get_archive(MAPPING_SCRIPT)[0]):
                pass
        except docker.errors.NotFound:
            raise ImageMissing(
                f"image {name} lacks {MAPPING_SCRIPT}", "its Dockerfile must copy the package's slamhive/ to /slamhive"
            ) from None
        finally:
            container.remove(force=True)


def _make_base_images(
    client: docker.DockerClient, images: Iterable[BaseImage], context: ExecutorContext, progress: ProgressCallback
) -> dict[str, str]:
    """Build the images that are missing or out of date; {build argument: digest}. Raises ImageMissing."""
    arguments: dict[str, str] = {}
    for image in images:
        found = get_image(client, image.name)
        if found is not None and content_of(found) == image.content:
            arguments[image.argument] = str(found.id)
            continue
        needed = _make_base_images(client, image.needs, context, progress)
        with temporary_folder() as folder:
            staged = stage_base_context(image, folder / "context", context.source_archives)
            staged.build_args.update(needed)
            digest = build_image(client, image.name, staged, image.content, context.project_root, progress)
        name_image(client, digest, image.name)
        arguments[image.argument] = digest
    return arguments


# Images of versions: named so that the engine keeps them, saved and loaded.


KEPT = "slam-hive-version"
"""The repository of names that keep the images of versions."""

_INSTALLATION_DIGITS = 8
PACKING_TIMEOUT_S = 1800
"""The engine is silent while it packs an image, and while it unpacks one."""


def kept_name(package: str, number: int, installation: str) -> str:
    """The name of the image of a version: installations on one engine number their versions differently."""
    return f"{KEPT}:{package}-{number}-{installation[:_INSTALLATION_DIGITS]}"


def has_image(client: docker.DockerClient, digest: str) -> bool:
    """Return whether the engine has the image with this digest."""
    return digest.startswith("sha256:") and get_image(client, digest) is not None


def forget_image(client: docker.DockerClient, digest: str, name: str) -> None:
    """Remove the name ``name``, and the image if it has no other name. Does nothing if both are gone."""
    for reference in (name, digest):
        image = get_image(client, reference)
        if image is None or (reference == digest and image.tags):  # by its digest, an image loses its only name, too
            continue
        with engine_errors(f"removing {reference[:80]}", InvalidInput):
            try:
                client.api.remove_image(reference)
            except docker.errors.ImageNotFound:
                continue
            except docker.errors.APIError as error:
                if error.status_code != 409:  # 409: a container uses the image
                    raise


def save_image(client: docker.DockerClient, digest: str) -> Iterator[bytes]:
    """Yield the output of ``docker save``. Raises ImageMissing."""
    image = get_image(client, digest)
    if image is None:
        raise ImageMissing(f"image {digest[:19]} is gone", "build it again")
    with engine_errors(f"saving {digest[:19]}", ImageMissing):
        yield from image.save()


def load_image(client: docker.DockerClient, chunks: Iterable[bytes]) -> str:
    """Load what :func:`save_image` gave; the digest. Raises InvalidInput if it is not one image."""
    with engine_errors("loading an image", InvalidInput):
        found: list[Any] = client.images.load(iter(chunks))  # type: ignore[arg-type]
    if len(found) != 1:
        raise InvalidInput(f"the archive holds {len(found)} images, 1 is expected", "export the version again")
    return str(found[0].id)
