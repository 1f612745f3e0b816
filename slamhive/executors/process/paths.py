"""What the paths of a container mean for a run that has none."""

from __future__ import annotations

import os
from pathlib import Path

from slamhive.executors.base import RunSpec
from slamhive.executors.process.environment import Environment
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.registry import ExecutorContext

CONTAINER_ROOT = "/slamhive"
KEY_VARIABLE = "SLAMHIVE_RUN_KEY"
PREPARED_VARIABLE = "SLAMHIVE_PREPARED"
INHERITED = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "TZ")
"""Variables of the worker that runs see too."""


def on_host(spec: RunSpec, target: str) -> Path | None:
    """What the container path ``target`` is on this machine: through a mount, else in the package's scripts."""
    best = max(
        (mount for mount in spec.mounts if target == mount.target or target.startswith(mount.target + "/")),
        key=lambda mount: len(mount.target),
        default=None,
    )
    if best is not None:
        return best.source.resolve() / target[len(best.target) :].lstrip("/")
    if target.startswith(CONTAINER_ROOT + "/"):
        return spec.package_folder.resolve() / "slamhive" / target[len(CONTAINER_ROOT) + 1 :]
    return None


def translate(spec: RunSpec, value: str) -> str:
    """``value``, or what it is on this machine if it is a path of the container."""
    found = on_host(spec, value) if value.startswith("/") else None
    return value if found is None else str(found)


def link_dataset(spec: RunSpec, folder: Path) -> None:
    """Links to what the mounts show below ``/slamhive/dataset``, and to nothing else."""
    inside = f"{CONTAINER_ROOT}/dataset/"
    for mount in spec.mounts:
        if mount.target.startswith(inside):
            link = folder / mount.target[len(inside) :]
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(mount.source.resolve())


def shim_spec_of(spec: RunSpec, environment: Environment, work: Path, context: ExecutorContext) -> ShimSpec:
    """Everything that the container paths of ``spec`` mean on this machine."""
    home, dataset = work / "home", work / "dataset"
    for folder in (home, dataset):
        folder.mkdir(parents=True, exist_ok=True)
    link_dataset(spec, dataset)
    inherited = {key: os.environ[key] for key in INHERITED if key in os.environ}
    variables = {
        **inherited,
        "HOME": str(home),
        "TMPDIR": str(home),
        "PYTHONPATH": str(environment.runtime),
        "PYTHONUNBUFFERED": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "SLAMHIVE_CONFIG": str(on_host(spec, f"{CONTAINER_ROOT}/config.yaml")),
        "SLAMHIVE_DATASET": str(dataset),
        "SLAMHIVE_RESULT": str(on_host(spec, f"{CONTAINER_ROOT}/result")),
        PREPARED_VARIABLE: str(environment.prepared),
        **{key: translate(spec, value) for key, value in spec.environment.items()},
        KEY_VARIABLE: spec.key,
    }
    program = str(environment.python) if spec.command[0] == "python3" else spec.command[0]
    return ShimSpec(
        command=[program, *(translate(spec, argument) for argument in spec.command[1:])],
        environment=variables,
        folder=str(home),
        cores=None if spec.limits.cpuset is None else list(spec.limits.cpuset),
        memory_bytes=spec.limits.memory_bytes,
        tasks=spec.limits.pids,
        file_bytes=spec.limits.file_bytes,
        log_max_bytes=context.log_max_bytes,
        cpu_cores=spec.limits.cpu_cores,
        installation=context.installation,
        key=spec.key,
        readable=[program, *filter(_is_file_here, variables.values()), *_files_shown(spec)],
        writable=[str(home), *(str(mount.source.resolve()) for mount in spec.mounts if not mount.read_only)],
        containment=context.containment,
    )


def _is_file_here(value: str) -> bool:
    return value.startswith("/") and os.pathsep not in value and Path(value).exists()


def _files_shown(spec: RunSpec) -> list[str]:
    return [str(mount.source.resolve()) for mount in spec.mounts]
