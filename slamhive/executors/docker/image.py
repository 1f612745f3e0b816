"""Images of algorithm packages: found, pulled or built, and checked to keep the container contract."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import docker
import docker.errors

from slamhive.catalogue.base_images import BaseImage
from slamhive.catalogue.image_context import context_hash, dockerfile_of, images_of, stage_base_context, stage_context
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ExecutorContext, ImageMissing, ProgressCallback
from slamhive.executors.docker.build import build_image, content_of, follow_pull, get_image, name_image
from slamhive.executors.docker.engine import closing_chunks, engine_errors, labels_of_helper
from slamhive.executors.docker.pinned import find_pinned, pull_pinned
from slamhive.files import temporary_folder

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
        return _pull(client, package, progress)
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


def _pull(client: docker.DockerClient, package: AlgorithmPackage, progress: ProgressCallback) -> str:
    name, _, tag = package.image.rpartition(":")
    remedy = f"load it with docker load, or add a Dockerfile to {package.folder}"
    if package.origin is not None:
        remedy = f"import it again: slamhive algorithm import {package.origin.source} --name {package.name} --replace"
    problem = "the registry does not have it"
    try:
        with engine_errors(f"pulling {package.image}", ImageMissing):
            problem = follow_pull(client, name, tag, package.image, progress) or problem
    except ImageMissing as error:
        problem = error.message
    image = get_image(client, package.image)
    if image is None:
        raise ImageMissing(f"{package.image} cannot be pulled: {problem}", remedy)
    return str(image.id)
