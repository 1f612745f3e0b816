"""Paths of the container contract for a run without a container."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from slamhive.executors.base import ExecutorContext
from slamhive.executors.process.environment import Environment
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.spec import RunSpec
from slamhive.executors.transfer import make_own_copies, read_places, written_places

CONTAINER_ROOT = "/slamhive"
KEY_VARIABLE = "SLAMHIVE_RUN_KEY"
PREPARED_VARIABLE = "SLAMHIVE_PREPARED"
INHERITED = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "TZ")
"""Variables of the worker that runs see too."""

_NO_LIMIT_OF_TASKS = 1 << 22
"""More processes and threads than a Linux kernel can have."""


class LocalPaths:
    """Translates paths of the container contract into paths of this machine."""

    def __init__(self, spec: RunSpec) -> None:
        self.writable = written_places(spec)
        self.places = read_places(spec) | self.writable
        self._scripts = spec.package_folder.resolve() / "slamhive"

    def find(self, target: str) -> Path | None:
        """Where ``target`` is: in an input or output, else among the package's scripts; None if it is neither."""
        above = [place for place in self.places if target == place or target.startswith(f"{place}/")]
        if above:
            nearest = max(above, key=len)
            return self.places[nearest] / target[len(nearest) :].lstrip("/")
        if target.startswith(f"{CONTAINER_ROOT}/"):
            return self._scripts / target[len(CONTAINER_ROOT) + 1 :]
        return None

    def translate(self, value: str) -> str:
        """``value``, or its path on this machine if it is a path of the container contract."""
        found = self.find(value) if value.startswith("/") else None
        return value if found is None else str(found)

    def link_dataset(self, folder: Path) -> None:
        """Link what belongs below ``/slamhive/dataset`` into ``folder``, and nothing else."""
        inside = f"{CONTAINER_ROOT}/dataset/"
        for target, place in self.places.items():
            if target.startswith(inside):
                link = folder / target[len(inside) :]
                link.parent.mkdir(parents=True, exist_ok=True)
                link.unlink(missing_ok=True)
                link.symlink_to(place)


def shim_spec_of(
    spec: RunSpec, environment: Environment, work: Path, context: ExecutorContext, containment: str | None
) -> ShimSpec:
    """The orders for the supervisor of ``spec``. Makes the folders and copies that the run needs."""
    home, dataset = work / "home", work / "dataset"
    for folder in (home, dataset):
        folder.mkdir(parents=True, exist_ok=True)
    make_own_copies(spec)
    paths = LocalPaths(spec)
    paths.link_dataset(dataset)
    variables = {
        **{key: os.environ[key] for key in INHERITED if key in os.environ},
        "HOME": str(home),
        "TMPDIR": str(home),
        "PYTHONPATH": str(environment.runtime),
        "PYTHONUNBUFFERED": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "SLAMHIVE_CONFIG": str(paths.find(f"{CONTAINER_ROOT}/config.yaml")),
        "SLAMHIVE_DATASET": str(dataset),
        "SLAMHIVE_RESULT": str(paths.find(f"{CONTAINER_ROOT}/result")),
        PREPARED_VARIABLE: str(environment.prepared),
        **{key: paths.translate(value) for key, value in spec.environment.items()},
        KEY_VARIABLE: spec.key,
    }
    program = str(environment.python) if spec.command[0] == "python3" else spec.command[0]
    absolute = [value for value in variables.values() if value.startswith("/") and os.pathsep not in value]
    files = [value for value in absolute if Path(value).exists()]
    return replace(
        orders_for_limits(spec, context),
        command=[program, *map(paths.translate, spec.command[1:])],
        environment=variables,
        folder=str(home),
        readable=[program, *files, *map(str, paths.places.values())],
        writable=[str(home), *map(str, paths.writable.values())],
        containment=containment,
    )


def orders_for_limits(spec: RunSpec, context: ExecutorContext) -> ShimSpec:
    """Orders for the supervisor that say what ``spec`` may use, but not yet what to start."""
    limits = spec.limits
    return ShimSpec(
        command=[],
        environment={},
        folder="",
        cores=None if limits.cpuset is None else list(limits.cpuset),
        memory_bytes=limits.memory_bytes,
        tasks=_NO_LIMIT_OF_TASKS if limits.pids is None else limits.pids,
        file_bytes=limits.file_bytes,
        log_max_bytes=context.log_max_bytes,
        cpu_cores=limits.cpu_cores,
        installation=context.installation,
        key=spec.key,
    )
