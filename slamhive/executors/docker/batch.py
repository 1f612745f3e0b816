"""Runs a batch of evaluations in a container of the evaluation image. It is hardened like a run, and always removed."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

import docker
import docker.errors
import requests
from docker.types import Mount

from slamhive.base.errors import Unavailable
from slamhive.base.files import temporary_folder
from slamhive.domain.algorithm import RunUser
from slamhive.evaluation.image_context import EvaluationContext
from slamhive.evaluation.process import EvaluationBatch, LineCallback, LineFeed
from slamhive.executors.base import EngineUnavailable, ExecutorContext
from slamhive.executors.docker.containers import container_user
from slamhive.executors.docker.engine import (
    HARDENING,
    connect,
    engine_errors,
    labels_of_helper,
    traits_of,
)
from slamhive.executors.docker.images import build_image, content_of, get_image, name_image
from slamhive.packages.image_context import HOST_CERTIFICATES, BuildContext, build_arguments

logger = logging.getLogger(__name__)

_PIDS = 512
_KEPT_LINES = 4
_EXIT_WAIT_S = 10


class DockerStarter:
    """Starts the evaluation image; see :class:`slamhive.evaluation.process.BatchStarter`.

    Args:
        context: Names the installation, for the labels of containers.
        image: Used as it is; without it, the evaluation image is built and used.
    """

    isolated = True

    def __init__(self, context: ExecutorContext, image: str | None = None) -> None:
        self._context = context
        self._image = image

    def prepare(self, progress: LineCallback) -> None:
        """Build the evaluation image unless the engine has one made from just this code."""
        with contextlib.closing(connect()) as client:
            self._ensure_image(client, progress)

    def run_batch(self, batch: EvaluationBatch, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Run the batch to its end, handing over its lines; how it ended if not well, in one line."""
        last: deque[str] = deque(maxlen=_KEPT_LINES)

        def take(line: str) -> None:
            last.append(line.strip())
            on_line(line)

        with contextlib.closing(connect()) as client:
            image = self._image or self._ensure_image(client, logger.debug)
            mounts = [
                Mount(entry.target, str(entry.source.resolve()), type="bind", read_only=entry.read_only)
                for entry in batch.mounts
            ]
            with engine_errors("making the evaluation container", Unavailable):
                try:
                    container: Any = client.containers.create(
                        image,
                        [batch.job],
                        mounts=mounts,
                        labels=labels_of_helper("evaluation", self._context.installation),
                        environment={"HOME": "/tmp"},  # noqa: S108 - the container's own; evo writes settings there
                        user=container_user(RunUser.WORKER, rootless=traits_of(client).rootless),
                        pids_limit=_PIDS,
                        cpuset_cpus=None if batch.cores is None else ",".join(map(str, batch.cores)),
                        **HARDENING,
                    )
                except docker.errors.ImageNotFound:
                    raise Unavailable(f"image {image} was removed from outside", "try again") from None
            try:
                feed = LineFeed(_lines_of(_started(container)))
                return feed.follow(batch.timeout_s, take, stopping) or _how_it_ended(container, last)
            finally:
                with engine_errors("removing the evaluation container", EngineUnavailable):
                    container.remove(force=True, v=True)

    def _ensure_image(self, client: docker.DockerClient, progress: LineCallback) -> str:
        """Build the evaluation image unless the engine has it; its name."""
        root = self._context.project_root
        evaluation = EvaluationContext(root)
        name, content = evaluation.image, evaluation.content
        image = get_image(client, name)
        if image is not None and content_of(image) == content:
            return name
        logger.info("building %s", name)
        with temporary_folder() as folder:
            context = BuildContext(folder / "context", "Dockerfile", build_arguments())
            context.path.mkdir()
            evaluation.stage(context.path, sorted(HOST_CERTIFICATES.glob("*.crt")))
            digest = build_image(client, name, context, content, root, progress)
        name_image(client, digest, name)
        return name


def _started(container: Any) -> Any:
    """Start the container and return its output, which the reader closes."""
    with engine_errors("starting the evaluation", Unavailable):
        # Attached before the start: following the log instead loses the last words of a short container.
        output = container.attach(stdout=True, stderr=False, stream=True)
        try:
            container.start()
        except BaseException:
            _hang_up(output)
            raise
        return output


def _lines_of(output: Any) -> Iterator[str]:
    """The lines of an attached standard output. A broken connection ends them too; the exit code says how it went.

    The engine ends the output with the container. The reader closes it, so that nobody else closes it while it is read.
    """
    rest = b""
    try:
        for chunk in output:
            *whole, rest = (rest + chunk).split(b"\n")
            for line in whole:
                yield line.decode(errors="replace")
    except (requests.exceptions.RequestException, docker.errors.APIError, OSError):
        pass
    finally:
        _hang_up(output)
    if rest:
        yield rest.decode(errors="replace")


def _hang_up(output: Any) -> None:
    """Close the connection of an attached output. The SDK closes the socket but not the file that holds it."""
    with contextlib.suppress(OSError):  # the engine has hung up already
        output.close()
    output._response.close()


def _how_it_ended(container: Any, last: deque[str]) -> str | None:
    try:
        with engine_errors("waiting for the evaluation", EngineUnavailable):
            exit_code = int(container.wait(timeout=_EXIT_WAIT_S)["StatusCode"])
            if exit_code == 0:
                return None
            errors = container.logs(stdout=False, stderr=True, tail=_KEPT_LINES).decode(errors="replace")
    except EngineUnavailable as error:
        return str(error)
    said = " | ".join(errors.strip().splitlines() or last)
    return f"exit code {exit_code}: {said}" if said else f"exit code {exit_code}"
