"""Images that packages name by digest: found, or pulled, and never taken for another one."""

from __future__ import annotations

from typing import Any

import docker

from slamhive.domain.pinned_image import PinnedImage
from slamhive.executors.base import ImageMissing, ProgressCallback
from slamhive.executors.docker.build import follow_pull, get_image
from slamhive.executors.docker.engine import engine_errors

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
