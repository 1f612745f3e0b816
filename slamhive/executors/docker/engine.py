"""The connection to a Docker engine, and what its errors mean to us."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import re
import uuid
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast

import docker
import docker.errors
import requests
import urllib3

from slamhive.base.errors import SlamHiveError
from slamhive.base.machine import boot_id
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.docker.address import engine_address, socket_path, trouble_with
from slamhive.executors.host import worker_identity

KEY_LABEL = "slamhive.key"
RUN_LABEL = "slamhive.run"
INSTALLATION_LABEL = "slamhive.installation"
GPU_LABEL = "slamhive.gpu"
"""Holds the UUID of the GPU that a run has."""

BOOT_LABEL = "slamhive.boot"
"""In which boot of this machine the container of a run was created and started."""

OWNER_LABEL = "slamhive.owner"
"""The process that a container serves. Containers of runs do not have it: they outlive their worker."""

_TIMEOUT_S = 60
_PODMAN_INFO = "/v4.0.0/libpod/info"
_NAME_LIMIT = 63
_SERVER_ERROR = 500
_UNSET_TIME = "0001-"

HARDENING: dict[str, Any] = {
    "cap_drop": ["ALL"],
    "security_opt": ["no-new-privileges"],
    "network_mode": "none",
    "init": True,
    "shm_size": 256 * 1024 * 1024,
}
"""What every container of ours is started with. ROS 2 moves images through /dev/shm; its default of 64 MB is short."""


@dataclass(frozen=True, slots=True)
class EngineTraits:
    """Traits that differ between engines, and change the options of containers.

    Attributes:
        rootless: The engine runs in a user namespace, whose root is the user of the engine. All other users of a
            container are numbers that own nothing on this machine.
        limits_cpu: Its kernel limits the CPU time of a container. Otherwise the engine refuses containers with such a
            limit.
    """

    rootless: bool = False
    limits_cpu: bool = True

    @classmethod
    def of(cls, information: Mapping[str, Any]) -> EngineTraits:
        """The traits of an engine that reports this of itself (:func:`information_of`)."""
        options = information.get("SecurityOptions") or []
        return cls("name=rootless" in options, bool(information.get("CpuCfsQuota", True)))


PLAIN_ENGINE = EngineTraits()
"""An engine that root runs, on a kernel with all controllers."""


def traits_of(client: docker.DockerClient) -> EngineTraits:
    """Ask the engine what it is. Raises EngineUnavailable."""
    return EngineTraits.of(information_of(client))


def information_of(client: docker.DockerClient) -> dict[str, Any]:
    """Return what the engine reports of itself and its kernel (``docker info``), for Podman in the words of Docker.

    Podman has a field of its own for running without root. On control groups version 2 it says that CPU time cannot be
    limited, whatever its kernel can (4.3), so its own interface is asked which controllers it has.
    Raises EngineUnavailable.
    """
    with engine_errors("asking the Docker engine", EngineUnavailable):
        info: dict[str, Any] = client.info()
    if not info.get("Rootless"):
        return info
    options = [*(info.get("SecurityOptions") or []), "name=rootless"]
    with engine_errors("asking Podman", EngineUnavailable):
        host = client.api.get(f"{client.api.base_url}{_PODMAN_INFO}", timeout=_TIMEOUT_S).json().get("host", {})
    return {**info, "SecurityOptions": options, "CpuCfsQuota": "cpu" in host.get("cgroupControllers", [])}


def labels_of_helper(purpose: str, installation: str) -> dict[str, str]:
    """The labels of a container that serves this process, and is of no use after it."""
    return {
        KEY_LABEL: f"{purpose}-{uuid.uuid4().hex}",
        OWNER_LABEL: worker_identity(),
        INSTALLATION_LABEL: installation,
    }


@contextmanager
def engine_errors(doing: str, failure: type[SlamHiveError]) -> Iterator[None]:
    """Turn the SDK's errors into ours: EngineUnavailable if nobody answers, ``failure`` if the engine refuses.

    Args:
        doing: What was being done, for the message (``"starting run 7"``).
        failure: The error for a refusal.
    """
    try:
        yield
    except (requests.exceptions.ConnectionError, requests.exceptions.Timeout) as error:
        raise _no_answer(doing, error) from None
    except (requests.exceptions.ChunkedEncodingError, urllib3.exceptions.HTTPError) as error:
        raise _no_answer(doing, error) from None
    except docker.errors.APIError as error:
        raise failure(f"{doing}: {error.explanation or error}") from None
    except docker.errors.DockerException as error:
        raise _no_answer(doing, error) from None


def statistics_of(container: Any) -> dict[str, Any]:
    """One reading of a container's statistics; empty once it has ended. Podman then sends no JSON at all."""
    with engine_errors("reading statistics", EngineUnavailable):
        try:
            stats: dict[str, Any] = container.stats(stream=False, one_shot=True)
        except (docker.errors.NotFound, requests.exceptions.JSONDecodeError):
            return {}
    return stats


def connect(timeout_s: int = _TIMEOUT_S) -> docker.DockerClient:
    """A client of the engine of this user (:func:`engine_address`). Raises EngineUnavailable.

    ``timeout_s``: how long the engine may be silent.
    """
    address = engine_address()
    path = socket_path(address)
    # The SDK would leave its own socket open where nobody listens.
    trouble = None if path is None else trouble_with(path)
    if trouble is not None:
        raise EngineUnavailable(trouble.problem, trouble.remedy)
    with engine_errors("connecting to Docker", EngineUnavailable):
        return docker.from_env(timeout=timeout_s, environment={**os.environ, "DOCKER_HOST": address})


@contextmanager
def closing_chunks(answer: Iterator[bytes]) -> Iterator[Iterator[bytes]]:
    """The chunks of an answer. Leaving closes its connection: the SDK's generator does so only if it was started."""
    chunks = cast("Generator[bytes, None, None]", answer)
    with contextlib.closing(chunks):
        first = next(chunks, None)
        yield iter(()) if first is None else itertools.chain((first,), chunks)


def container_name(key: str) -> str:
    """The container's name for a run's key: 63 characters at most, different for different keys."""
    slug = re.sub(r"[^a-zA-Z0-9_.-]+", "-", key)
    name = f"slamhive-{slug}"
    if slug == key and len(name) <= _NAME_LIMIT:
        return name
    digest = hashlib.sha256(key.encode()).hexdigest()[:12]
    return f"{name[: _NAME_LIMIT - 13]}-{digest}"


def boot_labels() -> dict[str, str]:
    """The label with the boot of this machine; none if the engine may be on another machine."""
    return {} if socket_path(engine_address()) is None else {BOOT_LABEL: boot_id()}


def is_of_earlier_boot(container: Any) -> bool:
    """Return whether the machine was restarted since the container was created."""
    return container.labels.get(BOOT_LABEL) not in (None, boot_id())


def _no_answer(doing: str, error: Exception) -> EngineUnavailable:
    return EngineUnavailable(
        f"{doing}: no Docker engine answers ({type(error).__name__})", "start it, or check DOCKER_HOST and your rights"
    )


def engine_time(text: str | None) -> datetime | None:
    """Parse a time of the engine, which has nanoseconds; None if it is not set."""
    if not text or text.startswith(_UNSET_TIME):
        return None
    seconds, _, fraction = text.rstrip("Z").partition(".")
    moment = datetime.fromisoformat(seconds).replace(tzinfo=UTC)
    return moment.replace(microsecond=int(fraction[:6].ljust(6, "0"))) if fraction else moment


def lifetime(state: Mapping[str, Any]) -> tuple[datetime | None, datetime | None]:
    """Return the start and the end of a container; Docker may note the end of a very short one before its start."""
    started_at, ended_at = engine_time(state.get("StartedAt")), engine_time(state.get("FinishedAt"))
    if started_at is not None and ended_at is not None:
        ended_at = max(started_at, ended_at)
    return started_at, ended_at
