"""The options of a run's container. Pure, so that tests can check them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docker.types import DeviceRequest, LogConfig, Mount, Ulimit

from slamhive.domain.algorithm import RunUser
from slamhive.executors.base import ExecutorContext
from slamhive.executors.docker.engine import (
    GPU_LABEL,
    HARDENING,
    INSTALLATION_LABEL,
    KEY_LABEL,
    PLAIN_ENGINE,
    RUN_LABEL,
    EngineTraits,
    container_name,
)
from slamhive.executors.docker.run_user import container_user
from slamhive.executors.local_files import read_places, written_places
from slamhive.executors.spec import ROS_ENVIRONMENT, RunSpec

WORKER_HOME = {"HOME": "/tmp"}  # noqa: S108 - the container's own
"""The worker's user has no other folder to write to. The users of images have the home that the image gives them."""


def container_options(spec: RunSpec, context: ExecutorContext, traits: EngineTraits = PLAIN_ENGINE) -> dict[str, Any]:
    """The arguments of ``containers.create`` for a run. Pure, so that a test can check them."""
    limits = spec.limits
    home = WORKER_HOME if spec.user is RunUser.WORKER else {}
    options: dict[str, Any] = {
        **HARDENING,
        "image": spec.identity,
        "name": container_name(spec.key),
        "entrypoint": list(spec.command),
        "command": [],
        "labels": {
            KEY_LABEL: spec.key,
            RUN_LABEL: str(spec.run_id),
            INSTALLATION_LABEL: context.installation,
        },
        "environment": {**ROS_ENVIRONMENT, **home, **spec.environment},
        "mounts": _mounts(spec),
        "user": container_user(spec.user, rootless=traits.rootless),
        "pids_limit": limits.pids,
        "log_config": LogConfig(
            type=LogConfig.types.JSON,
            config={"max-size": str(max(1000, context.log_max_bytes // 2)), "max-file": "2"},
        ),
    }
    if limits.memory_bytes is not None:
        options["mem_limit"] = limits.memory_bytes
        options["memswap_limit"] = limits.memory_bytes
    if limits.cpu_cores is not None and traits.limits_cpu:
        options["nano_cpus"] = round(limits.cpu_cores * 1e9)
    if limits.file_bytes is not None:
        options["ulimits"] = [Ulimit(name="fsize", soft=limits.file_bytes, hard=limits.file_bytes)]
    if limits.cpuset is not None:
        options["cpuset_cpus"] = ",".join(map(str, limits.cpuset))
    if spec.shm_bytes is not None:
        options["shm_size"] = spec.shm_bytes
    if spec.gpu is not None:
        options["device_requests"] = [DeviceRequest(device_ids=[spec.gpu], capabilities=[["gpu"]])]
        options["labels"][GPU_LABEL] = spec.gpu
    return options


def _mounts(spec: RunSpec) -> list[Mount]:
    """The mounts of a run. A mount below another one comes after it, and so shows in it."""
    read_only = read_places(spec)
    # /tmp counts with the result, unlike the container's own layer, and takes no memory, unlike a tmpfs.
    places = {**read_only, **written_places(spec), "/tmp": scratch_folder(spec)}  # noqa: S108 - the container's
    return [Mount(target, str(places[target]), type="bind", read_only=target in read_only) for target in sorted(places)]


def scratch_folder(spec: RunSpec) -> Path:
    """The folder that the container sees as ``/tmp``."""
    return spec.work.resolve() / "tmp"
