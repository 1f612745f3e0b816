"""The images of packages: built by the Docker engine of the worker's machine, and named as nodes find them.

With a registry, the name of an image holds a hash of what it is made from. So a worker without Docker knows the name,
and one name never means other content. Without a registry, nodes have to hold the image with its digest already.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from slamhive.domain.algorithm import AlgorithmPackage, RunUser
from slamhive.executors.base import EngineUnavailable, ExecutorContext, ImageMissing, ProgressCallback
from slamhive.packages.image_context import context_hash, dockerfile_of

_HASH_DIGITS = 12


class NodeImages:
    """Finds and builds images.

    Args:
        context: Names the project and the installation.
        registry: Where images are pushed to; empty for none.
    """

    def __init__(self, context: ExecutorContext, registry: str) -> None:
        self._context = context
        self._registry = registry

    def check(self, package: AlgorithmPackage) -> None:
        """Raise ImageMissing for a package that no pod of ours can run."""
        if package.user is not RunUser.WORKER:
            raise ImageMissing(
                f"{package.name} runs as {package.user.in_words}, and pods have the user of the worker only",
                "choose another executor; slamhive doctor --all lists them",
            )

    def has(self, digest: str) -> bool:
        """Return whether the Docker engine of this machine has an image, from which nodes can get it."""
        from slamhive.executors.docker.images import has_image  # noqa: PLC0415 - the SDK takes long to load

        with self._engine() as client:
            return has_image(client, digest)

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The image that a start would use now; None if it has to be built, as far as this machine can see."""
        if not self._registry:
            from slamhive.executors.docker.images import find_image  # noqa: PLC0415 - the SDK takes long to load

            with self._engine() as client:
                return find_image(client, package, self._context.project_root)
        return self.reference(package)

    def reference(self, package: AlgorithmPackage) -> str:
        """The name of the image in the registry. An image that somebody else made keeps the name that it has."""
        root = self._context.project_root
        if dockerfile_of(package, root) is None:
            return package.image
        return f"{self._registry}/{package.image}-{context_hash(package, root)[:_HASH_DIGITS]}"

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Build the image, and push it if there is a registry; its identity. Raises ImageMissing, EngineUnavailable."""
        from slamhive.executors.docker.engine import engine_errors  # noqa: PLC0415 - the SDK takes long to load
        from slamhive.executors.docker.images import make_image, name_image  # noqa: PLC0415 - as above

        reference = self.reference(package)
        with self._engine() as client:
            digest = make_image(client, package, self._context, progress)
            if not self._registry:
                return digest
            if dockerfile_of(package, self._context.project_root) is not None:
                name_image(client, digest, reference)
                repository, _, tag = reference.rpartition(":")
                with engine_errors(f"pushing {reference}", ImageMissing):
                    for event in client.api.push(repository, tag=tag, stream=True, decode=True):
                        if "error" in event:
                            problem = f"{reference} cannot be pushed: {event['error']}"
                            raise ImageMissing(problem, "try docker login, docker push")
                        progress(f"{reference}: {event.get('status', '')} {event.get('progress', '')}".strip())
        return reference

    @contextlib.contextmanager
    def _engine(self) -> Iterator[Any]:
        from slamhive.executors.docker.engine import connect  # noqa: PLC0415 - the SDK takes long to load

        try:
            client = connect()
        except EngineUnavailable as error:
            raise EngineUnavailable(
                f"images of pods are built on this machine: {error.message}",
                "start Docker here, or build elsewhere and set --registry in KUBERNETES_OPTIONS",
            ) from None
        with contextlib.closing(client):
            yield client


def explain_missing(image: str, registry: str, why: str) -> ImageMissing:
    """The error for an image that a node cannot get."""
    if registry:
        return ImageMissing(f"image {image}: {why}", "push it: slamhive algorithm build NAME, where Docker is")
    remedy = "load it there: docker save IMAGE | ctr -n k8s.io images import -, or set --registry"
    return ImageMissing(f"image {image[:19]}: {why}", remedy)
