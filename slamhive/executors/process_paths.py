"""What the paths of a container mean for a run that has none."""

from __future__ import annotations

from pathlib import Path

from slamhive.executors.base import RunSpec

CONTAINER_ROOT = "/slamhive"


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
