"""The Job of a run as data. Pure functions, so that tests can compare what is asked for."""

from __future__ import annotations

import hashlib
import math
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from slamhive.base.errors import Unavailable
from slamhive.base.files import remedy_of
from slamhive.executors.base import StartFailed
from slamhive.executors.kubernetes.node_runs import HandedOut
from slamhive.executors.kubernetes.options import Options
from slamhive.executors.kubernetes.pod_files import (
    COURIER_FILE,
    COURIER_FOLDER,
    NODE_VARIABLE,
    OWN_FOLDER,
    POD_FOLDER,
    POD_VARIABLE,
    PRIVATE_FOLDER,
    READY_FILE,
    SUPERVISOR_FILE,
    WORK_FOLDER,
)
from slamhive.executors.spec import ROS_ENVIRONMENT, Placing, RunInput, RunSpec
from slamhive.executors.transfer import make_own_copies, read_places, written_places

KEY_LABEL = "slamhive.key"
RUN_LABEL = "slamhive.run"
INSTALLATION_LABEL = "slamhive.installation"
KEY_ANNOTATION = "slamhive/key"
QUEUE_LABEL = "kueue.x-k8s.io/queue-name"
CONTAINER = "run"
SUPERVISOR_BYTES = 32 * 1024 * 1024
"""Kubernetes counts the supervisor with the run."""
SHM_BYTES = 256 * 1024 * 1024
NODE_PATIENCE_S = 60
"""How long a node may be silent before its runs count as lost."""
TERMINATION_GRACE_S = 30
LATEST_END_S = 300
"""The supervisor ends a late run by itself. The kubelet does so this much later, if the supervisor cannot."""
_APP_LABEL, _APP = "app.kubernetes.io/name", "slamhive-run"
_AT_START = "DuringSchedulingIgnoredDuringExecution"
_WEIGHT = 100
_LONGEST_NAME = 63
_LONGEST_JOB_NAME = 52
"""The Job controller adds to it for the name of the pod."""
CONTAINER_SECURITY = {
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
    "privileged": False,
    "readOnlyRootFilesystem": True,
}
NODE_ENTRY = {"name": NODE_VARIABLE, "valueFrom": {"fieldRef": {"fieldPath": "spec.nodeName"}}}
_PLAIN = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?")


@dataclass(frozen=True, slots=True)
class Who:
    """The user and group of a run: those of the worker, to whom its files belong afterwards."""

    uid: int
    gid: int


def label_value(text: str) -> str:
    """``text`` if it can be the value of a label, otherwise one that is different for different texts."""
    return text if len(text) <= _LONGEST_NAME and _PLAIN.fullmatch(text) else _digest(text)


def job_name(installation: str, key: str) -> str:
    """The name of the Job of a run, different for different runs of all installations in a namespace."""
    slug = re.sub(r"[^a-z0-9]+", "-", key.lower()).strip("-")[: _LONGEST_JOB_NAME - 22].strip("-")
    return f"slamhive-{slug}-{_digest(f'{installation}:{key}')[:12]}"


def selector(installation: str, key: str | None = None) -> str:
    """Selects the Jobs and pods of an installation, or of one run."""
    chosen = f"{INSTALLATION_LABEL}={label_value(installation)}"
    return chosen if key is None else f"{chosen},{KEY_LABEL}={label_value(key)}"


def resources(spec: RunSpec, options: Options) -> dict[str, str]:
    """Return the requests of a run: requests equal limits, so that nobody takes it from the run."""
    limits = spec.limits
    cores = limits.cpu_cores if limits.cpuset is None else float(len(limits.cpuset))
    asked: dict[str, str] = {}
    if cores is not None:
        asked["cpu"] = f"{math.ceil(cores * 1000)}m"
    if limits.memory_bytes is not None:
        asked["memory"] = str(limits.memory_bytes + SUPERVISOR_BYTES)
    if spec.asks_gpu:
        asked[options.gpu] = "1"
    return asked


def job_manifest(
    spec: RunSpec,
    installation: str,
    options: Options,
    who: Who,
    volumes: tuple[list[dict[str, Any]], list[dict[str, Any]]],
) -> dict[str, Any]:
    """The Job of a run.

    Args:
        spec: The run.
        installation: Distinguishes the runs of this data root from those of another one.
        options: What the user says about the cluster.
        who: The user of the run.
        volumes: What :func:`slamhive.executors.kubernetes.manifest.volumes_of` returned.
    """
    labels = labels_of(spec, installation)
    queue = {QUEUE_LABEL: options.queue} if options.queue else {}
    shm = {"medium": "Memory", "sizeLimit": str(spec.shm_bytes or SHM_BYTES)}
    pod = {
        "restartPolicy": "Never",
        "activeDeadlineSeconds": math.ceil(spec.timeout_s) + LATEST_END_S,
        "terminationGracePeriodSeconds": TERMINATION_GRACE_S,
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "hostNetwork": False,
        "hostPID": False,
        "hostIPC": False,
        "securityContext": {
            "runAsUser": who.uid,
            "runAsGroup": who.gid,
            "runAsNonRoot": who.uid != 0,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        **({"nodeSelector": options.node} if options.node else {}),
        **affinity(spec.placing),
        "tolerations": [
            {
                "key": f"node.kubernetes.io/{state}",
                "operator": "Exists",
                "effect": "NoExecute",
                "tolerationSeconds": NODE_PATIENCE_S,
            }
            for state in ("not-ready", "unreachable")
        ],
        "containers": [_container(spec, options, volumes[1])],
        "volumes": [*volumes[0], {"name": "shm", "emptyDir": shm}],
    }
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {
            "name": job_name(installation, spec.key),
            "labels": labels | queue,
            "annotations": {KEY_ANNOTATION: spec.key},
        },
        "spec": {
            "backoffLimit": 0,
            "completions": 1,
            "parallelism": 1,
            "podReplacementPolicy": "Failed",
            "template": {
                "metadata": {"labels": labels, "annotations": {KEY_ANNOTATION: spec.key}},
                "spec": pod,
            },
        },
    }


def labels_of(spec: RunSpec, installation: str) -> dict[str, str]:
    """The labels of all that belongs to a run."""
    return {
        _APP_LABEL: _APP,
        INSTALLATION_LABEL: label_value(installation),
        KEY_LABEL: label_value(spec.key),
        RUN_LABEL: str(spec.run_id),
    }


def affinity(placing: Placing) -> dict[str, Any]:
    """Where the scheduler may, and should rather, put the pod; empty if nothing is known.

    A node that may hold the data counts as much as one without another run, so that runs do not crowd on it.
    """
    node: dict[str, Any] = {}
    if placing.other_nodes:
        # A node is in question by its name; labels of host names need not be equal to it.
        refused = [_of_name("NotIn", name) for name in placing.other_nodes]
        node[f"required{_AT_START}"] = {"nodeSelectorTerms": [{"matchFields": refused}]}
    if not placing.near_nodes:
        return {"affinity": {"nodeAffinity": node}} if node else {}
    node[f"preferred{_AT_START}"] = [
        {"weight": _WEIGHT, "preference": {"matchFields": [_of_name("In", name)]}} for name in placing.near_nodes
    ]
    apart = {"labelSelector": {"matchLabels": {_APP_LABEL: _APP}}, "topologyKey": "kubernetes.io/hostname"}
    pods = {f"preferred{_AT_START}": [{"weight": _WEIGHT, "podAffinityTerm": apart}]}
    return {"affinity": {"nodeAffinity": node, "podAntiAffinity": pods}}


def _of_name(operator: str, name: str) -> dict[str, Any]:
    return {"key": "metadata.name", "operator": operator, "values": [name]}


def _container(spec: RunSpec, options: Options, mounts: list[dict[str, Any]]) -> dict[str, Any]:
    asked = resources(spec, options)
    variables = {**ROS_ENVIRONMENT, "HOME": "/tmp", **spec.environment}  # noqa: S108 - the container's own
    return {
        "name": CONTAINER,
        "image": spec.identity,
        "imagePullPolicy": "IfNotPresent" if options.registry else "Never",
        "command": ["python3", f"{POD_FOLDER}/{SUPERVISOR_FILE}", POD_FOLDER],
        "env": [*({"name": name, "value": value} for name, value in sorted(variables.items())), NODE_ENTRY],
        "resources": {"limits": asked, "requests": asked},
        "securityContext": CONTAINER_SECURITY,
        "volumeMounts": [*mounts, {"name": "shm", "mountPath": "/dev/shm"}],  # noqa: S108 - the container's own
    }


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:40]


# Additions to the Job of a run, if nodes share no storage with the worker. Pure functions, as those of the Job.


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
    volumes = [
        {"name": _CACHE, "hostPath": {"path": cache, "type": "DirectoryOrCreate"}},
        {"name": _WORK, "emptyDir": {}},
        {
            "name": _TICKET,
            "secret": {"secretName": secret_name(installation, spec.key, given.mark), "defaultMode": 0o444},
        },
    ]
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


# Folders and files of the data root that a pod sees, and their way into it.


MOST_BYTES_COPIED = 100_000_000
"""An input that lies outside of the data root is copied if it is no larger."""


@dataclass(frozen=True, slots=True)
class PodPlace:
    """Something that the run sees at ``target``. ``source`` is its path on the machine of the worker."""

    target: str
    source: Path
    is_folder: bool
    read_only: bool


def outputs_on_node(spec: RunSpec, folder: Path) -> RunSpec:
    """The specification whose outputs are written below ``folder`` first; ``collect`` takes them over."""
    outputs = tuple(replace(output, destination=folder / output.name) for output in spec.outputs)
    return replace(spec, outputs=outputs)


def prepare_inputs(spec: RunSpec, data: Path, folder: Path) -> RunSpec:
    """Copy small inputs from outside of the data root to ``folder``, and those that the run may change.

    Raises Unavailable if that fails.
    """
    copied = replace(spec, inputs=tuple(_inside(entry, data, folder) for entry in spec.inputs))
    make_own_copies(copied)
    return copied


def places_of(spec: RunSpec, other: Mapping[str, Path]) -> list[PodPlace]:
    """List what the run sees, in the order in which it is mounted. ``other``: folders that only the executor knows."""
    read_only = read_places(spec)
    places = {**read_only, **written_places(spec), **other}
    return [PodPlace(target, path, path.is_dir(), target in read_only) for target, path in sorted(places.items())]


def volumes_of(places: list[PodPlace], data: Path, claim: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The volumes of a pod and the mounts of its container.

    Args:
        places: What the run sees.
        data: The data root.
        claim: The claim that holds the data root; empty if nodes see all files at the path that they have here.

    Raises StartFailed for a place outside of the data root if there is a claim.
    """
    if claim:
        volume = {"name": "data", "persistentVolumeClaim": {"claimName": claim}}
        mounts: list[dict[str, Any]] = []
        for place in places:
            try:
                below = str(place.source.relative_to(data.resolve()))
            except ValueError:
                raise StartFailed(
                    f"{place.source} is not below the data root {data}, which is all that nodes have",
                    "move it there, or use a shared file system instead of --claim",
                ) from None
            mounts.append(_mount_of_place(place, "data") | {"subPath": below})
        return [volume], mounts
    volumes = [
        {"name": f"p{number}", "hostPath": {"path": str(place.source), "type": _kind(place)}}
        for number, place in enumerate(places)
    ]
    return volumes, [_mount_of_place(place, f"p{number}") for number, place in enumerate(places)]


def _mount_of_place(place: PodPlace, volume: str) -> dict[str, Any]:
    return {"name": volume, "mountPath": place.target, "readOnly": place.read_only}


def _kind(place: PodPlace) -> str:
    """The kubelet refuses a path that is something else, or missing because the node does not share it."""
    return "Directory" if place.is_folder else "File"


def _inside(entry: RunInput, data: Path, folder: Path) -> RunInput:
    source = entry.source.resolve()
    if entry.own_copy or source.is_relative_to(data.resolve()) or entry.size_bytes > MOST_BYTES_COPIED:
        return entry
    copy = folder / entry.name
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, copy, dirs_exist_ok=True)
        else:
            shutil.copy(source, copy)
    except OSError as error:
        raise Unavailable(f"{copy} cannot be written: {error}", remedy_of(error)) from None
    return replace(entry, source=copy)
