"""The Job of a run as data. Pure functions, so that tests can compare what is asked for."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass
from typing import Any

from slamhive.executors.kubernetes.options import Options
from slamhive.executors.kubernetes.pod_files import NODE_VARIABLE, POD_FOLDER, SUPERVISOR_FILE
from slamhive.executors.spec import ROS_ENVIRONMENT, Placing, RunSpec

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
        volumes: What :func:`slamhive.executors.kubernetes.places.volumes_of` returned.
    """
    labels = labels_of(spec, installation)
    queue = {QUEUE_LABEL: options.queue} if options.queue else {}
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
                "spec": _pod(spec, options, who, volumes),
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


def _pod(
    spec: RunSpec, options: Options, who: Who, volumes: tuple[list[dict[str, Any]], list[dict[str, Any]]]
) -> dict[str, Any]:
    shm = {"medium": "Memory", "sizeLimit": str(spec.shm_bytes or SHM_BYTES)}
    return {
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
