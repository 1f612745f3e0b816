"""Additions to the Job of a run, if nodes share no storage with the worker. Pure functions, as those of the Job."""

from __future__ import annotations

import math
from typing import Any

from slamhive.executors.kubernetes.manifest import (
    CONTAINER_SECURITY,
    LATEST_END_S,
    NODE_ENTRY,
    Who,
    job_manifest,
    job_name,
    labels_of,
)
from slamhive.executors.kubernetes.node_runs import HandedOut
from slamhive.executors.kubernetes.options import Options
from slamhive.executors.kubernetes.pod_files import (
    COURIER_FILE,
    COURIER_FOLDER,
    OWN_FOLDER,
    POD_FOLDER,
    POD_VARIABLE,
    PRIVATE_FOLDER,
    READY_FILE,
    WORK_FOLDER,
)
from slamhive.executors.spec import RunSpec

FETCH, COURIER = "fetch", "courier"
COURIER_CPU_MILLI, COURIER_BYTES = 250, 256 * 1024 * 1024
LONGEST_DELIVERY_S = 7 * 86_400
"""For so long a pod waits for a worker that is away. Its node keeps the cores and the memory for it meanwhile."""
_CACHE, _WORK, _TICKET = "cache", "work", "ticket"
_READY = f"{WORK_FOLDER}/{PRIVATE_FOLDER}/{READY_FILE}"
_READY_CHECK = f"import os, sys; sys.exit(not os.path.exists({_READY!r}))"
_MOST_CHECKS = 86_400
"""How often the check may fail. What was removed from the cache just now is fetched again before it succeeds."""


def secret_name(installation: str, key: str, mark: str) -> str:
    """The name of the Secret with the ticket that ``mark`` names.

    A kubelet keeps a Secret that cannot change for as long as it knows a pod with it, and would give it to later pods.
    """
    return f"{job_name(installation, key)}-{mark}"


def secret_manifest(spec: RunSpec, installation: str, given: HandedOut) -> dict[str, Any]:
    """Return the Secret that only the courier sees: the ticket of the run, and the programs."""
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "type": "Opaque",
        "immutable": True,
        "metadata": {
            "name": secret_name(installation, spec.key, given.mark),
            "labels": labels_of(spec, installation),
        },
        "data": given.secret,
    }


def node_job_manifest(
    spec: RunSpec, installation: str, options: Options, who: Who, given: HandedOut, cache: str
) -> dict[str, Any]:
    """The Job of a run whose data its courier brings.

    Args:
        spec: The run.
        installation: Distinguishes the runs of this data root from those of another one.
        options: What the user says about the cluster.
        who: The user of the run and of the cache.
        given: What was handed out for it.
        cache: The folder of the cache on the nodes.
    """
    volumes = _volumes(secret_name(installation, spec.key, given.mark), cache)
    job = job_manifest(spec, installation, options, who, (volumes, run_mounts(spec, given)))
    pod = job["spec"]["template"]["spec"]
    (run,) = pod["containers"]
    # What comes before the run may take what the run may take.
    carrying = {**run, "image": options.image} if spec.variant is not None else run
    fetch = _courier(FETCH, carrying, cache, run["resources"])
    beside = {name: {"cpu": f"{COURIER_CPU_MILLI}m", "memory": str(COURIER_BYTES)} for name in ("limits", "requests")}
    report = _courier(COURIER, carrying, cache, beside)
    report["restartPolicy"] = "Always"
    report["startupProbe"] = {
        "exec": {"command": ["python3", "-S", "-c", _READY_CHECK]},
        "periodSeconds": 1,
        "timeoutSeconds": 10,
        "failureThreshold": _MOST_CHECKS,
    }
    pod["initContainers"] = [fetch, report]
    pod["activeDeadlineSeconds"] = math.ceil(spec.timeout_s) + LATEST_END_S + LONGEST_DELIVERY_S
    return job


def with_courier(asked: dict[str, str]) -> dict[str, str]:
    """Return the requests of the pod, if ``asked`` is what the run asks for."""
    more = dict(asked)
    if "cpu" in asked:
        more["cpu"] = f"{int(asked['cpu'].removesuffix('m')) + COURIER_CPU_MILLI}m"
    if "memory" in asked:
        more["memory"] = str(int(asked["memory"]) + COURIER_BYTES)
    return more


def run_mounts(spec: RunSpec, given: HandedOut) -> list[dict[str, Any]]:
    """Return the mounts of the run: its inputs in the cache, which it cannot change, and its own folders."""
    written = {target: f"{OWN_FOLDER}/{name}" for target, name in given.own.items()}
    written |= {output.target: f"outputs/{output.name}" for output in spec.outputs}
    written |= {POD_FOLDER: "pod", "/tmp": "tmp"}  # noqa: S108 - the container's own
    mounts = [_mount(_CACHE, target, path, read_only=True) for target, path in given.items.items()]
    mounts += [_mount(_WORK, target, path, read_only=False) for target, path in written.items()]
    return sorted(mounts, key=lambda mount: str(mount["mountPath"]))


def _mount(volume: str, target: str, path: str, *, read_only: bool) -> dict[str, Any]:
    return {"name": volume, "mountPath": target, "subPath": path, "readOnly": read_only}


def _volumes(secret: str, cache: str) -> list[dict[str, Any]]:
    return [
        {"name": _CACHE, "hostPath": {"path": cache, "type": "DirectoryOrCreate"}},
        {"name": _WORK, "emptyDir": {}},
        {"name": _TICKET, "secret": {"secretName": secret, "defaultMode": 0o444}},
    ]


def _courier(name: str, run: dict[str, Any], cache: str, resources: dict[str, dict[str, str]]) -> dict[str, Any]:
    pod = {"name": POD_VARIABLE, "valueFrom": {"fieldRef": {"fieldPath": "metadata.uid"}}}
    return {
        "name": name,
        "image": run["image"],
        "imagePullPolicy": run["imagePullPolicy"],
        "command": ["python3", f"{COURIER_FOLDER}/{COURIER_FILE}", "fetch" if name == FETCH else "report"],
        "env": [NODE_ENTRY, pod],
        "resources": resources,
        "securityContext": CONTAINER_SECURITY,
        "volumeMounts": [
            {"name": _CACHE, "mountPath": cache},
            {"name": _WORK, "mountPath": WORK_FOLDER},
            {"name": _TICKET, "mountPath": COURIER_FOLDER, "readOnly": True},
        ],
    }
