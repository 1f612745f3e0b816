"""Images of versions: named so that the engine keeps them, saved and loaded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import docker
import docker.errors

from slamhive.errors import InvalidInput
from slamhive.executors.base import ImageMissing
from slamhive.executors.docker.build import get_image
from slamhive.executors.docker.engine import engine_errors

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
