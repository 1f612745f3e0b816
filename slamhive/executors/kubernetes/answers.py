"""Meaning of Kubernetes' answers: pods, Jobs, nodes and refusals as data, in; one line for the user, out. Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any

from slamhive.executors.base import Node
from slamhive.executors.kubernetes.manifest import CONTAINER, KEY_ANNOTATION
from slamhive.executors.kubernetes.pod_files import REFUSED_EXIT

Document = dict[str, Any]

_FORBIDDEN = re.compile(r'cannot (?P<verb>[a-z]+) resource "(?P<what>[^"]+)" in API group "(?P<group>[^"]*)"')
_IMAGE_NEVER = frozenset(("ErrImageNeverPull", "InvalidImageName", "ErrImageInspectError"))
_IMAGE_PULL = frozenset(("ErrImagePull", "ImagePullBackOff", "RegistryUnavailable"))
_IMAGE_REFUSED = ("not found", "denied", "unauthorized", "manifest unknown", "does not exist")
_CONTAINER_REFUSED = frozenset(
    ("CreateContainerConfigError", "CreateContainerError", "RunContainerError", "CrashLoopBackOff", "StartError")
)
_INITIALISING = "PodInitializing"
_GIVEN_UP = ("DeletionByTaintManager", "DeletionByPodGC", "TerminationByKubelet")
_FACTORS = {
    "": Decimal(1), "m": Decimal("0.001"), "k": Decimal(10**3), "M": Decimal(10**6), "G": Decimal(10**9),
    "T": Decimal(10**12), "Ki": Decimal(2**10), "Mi": Decimal(2**20), "Gi": Decimal(2**30), "Ti": Decimal(2**40),
}  # fmt: skip
_QUANTITY = re.compile(r"([0-9.]+)([a-zA-Z]*)")


@dataclass(frozen=True, slots=True)
class Right:
    """A right that the worker needs."""

    verb: str
    resource: str
    group: str = ""

    @property
    def text(self) -> str:
        """Such as ``create jobs.batch``."""
        return f"{self.verb} {self.resource}{f'.{self.group}' if self.group else ''}"


@dataclass(frozen=True, slots=True)
class NotStarted:
    """Why the algorithm of a pod has not started.

    Attributes:
        why: In words.
        image: The image is the reason, and waiting does not help.
        refused: The kubelet cannot start the container. It tries again.
        unschedulable: No node takes the pod now.
        created: The container was made, and has yet to be started. That takes a moment, unless its containerd was
            killed in between: then nobody starts it any more.
    """

    why: str
    image: bool = False
    refused: bool = False
    unschedulable: bool = False
    created: bool = False


def missing_right(body: str) -> Right | None:
    """The right that a refusal with code 403 names; None if it names none (such as a quota)."""
    found = _FORBIDDEN.search(message_of(body))
    return None if found is None else Right(found["verb"], found["what"], found["group"])


def message_of(body: str) -> str:
    """The message in the body of a refusal; the body itself if it is no status of Kubernetes."""
    try:
        content = json.loads(body)
    except ValueError:
        return body.strip()
    return str(content.get("message") or body) if isinstance(content, dict) else body


def key_of(pod: Document) -> str | None:
    """The key of the run that a pod or Job belongs to."""
    annotations: dict[str, str] = pod["metadata"].get("annotations") or {}
    return annotations.get(KEY_ANNOTATION)


def is_over(pod: Document) -> bool:
    """Return whether all containers of the pod have ended for good."""
    return pod.get("status", {}).get("phase") in ("Succeeded", "Failed")


def node_of(pod: Document) -> str:
    """The node of the pod, empty if it has none yet."""
    return str(pod["spec"].get("nodeName") or "")


def given_up(pod: Document) -> str | None:
    """Why Kubernetes has given the pod up although nobody recorded its end; None if it has not.

    The pod of a lost node stays ``Terminating`` until its node is back: nobody can say that it has ended.
    """
    status = pod.get("status", {})
    for condition in status.get("conditions") or ():
        marked = condition.get("type") == "DisruptionTarget" and condition.get("status") == "True"
        if marked and condition.get("reason") in _GIVEN_UP:
            lost = condition["reason"] == "DeletionByTaintManager"
            said = condition.get("message") or condition["reason"]
            return f"node {node_of(pod)} is lost: {said}" if lost else f"the pod was evicted: {said}"
    if status.get("reason") == "NodeLost":
        return f"node {node_of(pod)} is lost"
    return None


def ran_out_of_memory(pod: Document) -> bool:
    """Return whether the kernel ended the pod's first process because of the memory limit."""
    ended = _state(pod, "terminated")
    return ended is not None and ended.get("reason") == "OOMKilled"


def how_it_was_lost(pod: Document | None) -> str:
    """Why a run has ended that recorded no end, in words."""
    if pod is None:
        return "the pod was deleted from outside"
    status = pod.get("status", {})
    found = given_up(pod)
    if found is not None:
        return found
    if status.get("reason") == "Evicted":
        return f"node {node_of(pod)} evicted the pod: {status.get('message', '')}"
    if status.get("reason"):
        return f"Kubernetes ended the pod: {status['reason']} {status.get('message', '')}".strip()
    failed = _failed_before(pod)
    if failed is not None:
        return f"node {node_of(pod)} could not get the data of the run: {failed.get('message') or failed.get('reason')}"
    ended = _state(pod, "terminated") or {}
    words = [str(ended[name]) for name in ("reason", "message") if ended.get(name)]
    said = ", ".join([*words, f"exit code {ended.get('exitCode', 'unknown')}"])
    return f"the pod ended on node {node_of(pod)}, but nobody could record how: {said}"


def why_not_started(pod: Document) -> NotStarted:
    """Why the algorithm of a pod that has not ended does not run yet."""
    # What keeps back a container that comes before the run keeps back the run.
    before = (state.get("waiting") or {} for state in _before(pod))
    noted = next((found for found in before if found.get("reason", _INITIALISING) != _INITIALISING), None)
    waiting = noted or _state(pod, "waiting") or {}
    reason, said = str(waiting.get("reason", "")), str(waiting.get("message", ""))
    text = f"{reason}: {said}" if said else reason
    if reason in _IMAGE_NEVER:
        return NotStarted(f"node {node_of(pod)} does not have it ({text})", image=True)
    if reason in _IMAGE_PULL:
        return NotStarted(f"node {node_of(pod)}: {text}", image=any(word in said.lower() for word in _IMAGE_REFUSED))
    if reason in _CONTAINER_REFUSED:
        return NotStarted(f"node {node_of(pod)} cannot start the container: {text}", refused=True)
    for condition in pod.get("status", {}).get("conditions") or ():
        if condition.get("type") == "PodScheduled" and condition.get("status") == "False":
            unschedulable = condition.get("reason") == "Unschedulable"
            return NotStarted(condition.get("message") or "no node was chosen yet", unschedulable=unschedulable)
    if reason in ("", _INITIALISING) and _made(pod):
        return NotStarted(f"node {node_of(pod)} has made a container of the pod and does not go on", created=True)
    fetching = any(state.get("running") is not None for state in _before(pod))
    doing = "gets the data of the run" if fetching else "prepares the pod"
    return NotStarted(f"node {node_of(pod)} {doing}" if node_of(pod) else "no node was chosen yet")


def job_failure(job: Document) -> str | None:
    """Why a Job has failed or does not begin, in words; None if neither is so."""
    for condition in job.get("status", {}).get("conditions") or ():
        if condition.get("status") == "True" and condition.get("type") in ("Failed", "FailureTarget"):
            return f"{condition.get('reason', 'failed')}: {condition.get('message', '')}"
    return None


def is_suspended(job: Document) -> bool:
    """Return whether somebody, such as Kueue, holds the Job back."""
    return bool(job["spec"].get("suspend"))


def last_warning(events: Iterable[Document]) -> str | None:
    """The newest warning among events of a pod or Job, in words."""
    warnings = [event for event in events if event.get("type") == "Warning"]
    warnings.sort(key=lambda event: str(event.get("lastTimestamp") or event.get("eventTime") or ""))
    return f"{warnings[-1].get('reason')}: {warnings[-1].get('message')}" if warnings else None


def quantity(text: str) -> Decimal:
    """The value of a quantity such as ``1500m`` or ``4Gi``. Raises ValueError."""
    found = _QUANTITY.fullmatch(text)
    if found is None or found[2] not in _FACTORS:
        raise ValueError(f"{text!r} is no quantity")
    try:
        return Decimal(found[1]) * _FACTORS[found[2]]
    except InvalidOperation:
        raise ValueError(f"{text!r} is no quantity") from None


def unmeetable(asked: Mapping[str, str], wanted: Mapping[str, str], nodes: list[Document]) -> str | None:
    """Find the request that no node can ever meet, in words; None if one can, alone and empty.

    Args:
        asked: What the run asks for, such as ``{"cpu": "4000m"}``.
        wanted: The labels that its node must have.
        nodes: All nodes of the cluster.
    """
    fitting = [node for node in nodes if has_labels(node, wanted)]
    if not fitting:
        labels = ", ".join(f"{label}={value}" for label, value in wanted.items())
        return f"no node has the label {labels}" if labels else "the cluster has no node"
    for name, text in asked.items():
        most = max(quantity(node["status"]["allocatable"].get(name, "0")) for node in fitting)
        if quantity(text) > most:
            return f"it asks for {_shown(name, quantity(text))}, but the largest node has {_shown(name, most)}"
    return None


def offered(resource: str, wanted: Mapping[str, str], nodes: list[Document]) -> bool:
    """Return whether a node with the labels ``wanted`` has at least one of an extended resource."""
    return any(
        quantity((node["status"].get("allocatable") or {}).get(resource, "0")) >= 1
        for node in nodes
        if has_labels(node, wanted)
    )


def all_among(nodes: list[Document], wanted: Mapping[str, str], names: Collection[str]) -> bool:
    """Return whether all nodes with the labels ``wanted`` are among these ``names``; there is at least one name."""
    return bool(names) and {str(node["metadata"]["name"]) for node in nodes if has_labels(node, wanted)} <= set(names)


def has_labels(node: Document, wanted: Mapping[str, str]) -> bool:
    """Return whether a node has all of these labels."""
    return wanted.items() <= (node["metadata"].get("labels") or {}).items()


def node(found: Document) -> Node:
    """A node of the cluster."""
    name, drained = str(found["metadata"]["name"]), bool(found["spec"].get("unschedulable"))
    given = found["status"].get("allocatable") or {}
    state = "ready" if ready_nodes([{**found, "spec": {}}]) else "not ready"  # apart from being cordoned
    return Node(
        name=name,
        state=f"{state}, cordoned" if drained else state,
        takes_runs=bool(ready_nodes([found])),
        drained=drained,
        cpu_count=int(quantity(given["cpu"])) if "cpu" in given else None,
        memory_bytes=int(quantity(given["memory"])) if "memory" in given else None,
    )


def ready_nodes(nodes: list[Document]) -> list[str]:
    """The names of the nodes that answer and take pods."""
    return [
        str(node["metadata"]["name"])
        for node in nodes
        if not node["spec"].get("unschedulable")
        and any(
            condition["type"] == "Ready" and condition["status"] == "True"
            for condition in node["status"].get("conditions") or ()
        )
    ]


def allocatable(node: Document) -> str:
    """The cores and memory that pods of a node can have together, in words."""
    given = node["status"]["allocatable"]
    return ", ".join(_shown(name, quantity(given[name])) for name in ("cpu", "memory") if name in given)


def _shown(name: str, value: Decimal) -> str:
    if name == "memory":
        return f"{float(value) / 1e6:.0f} MB of {name}"
    return f"{float(value):g} {'cores' if name == 'cpu' else name}"


def _made(pod: Document) -> bool:
    """Return whether a container was made and not started, or has ended before the run while the pod is not over.

    After a power cut of its node, a pod may keep a container whose end nobody knows, and never go on. Nor does a pod
    that is never restarted, if its containers lose their common namespaces between one and the next.
    """
    entries = _containers(pod)
    states = [entry.get("state") or {} for entry in entries]
    ended = [state for state in states if state.get("terminated") is not None]
    waiting = [state for state in states if (state.get("waiting") or {}).get("reason") == _INITIALISING]
    between_two = bool(ended and waiting) and len(ended) + len(waiting) == len(states)
    if _failed_before(pod) is not None or between_two:
        return True
    return any((entry.get("state") or {}).get("waiting") is not None and entry.get("containerID") for entry in entries)


def _containers(pod: Document) -> list[Document]:
    """Return the states of all containers of a pod, those that come before the run first."""
    status = pod.get("status", {})
    return [*(status.get("initContainerStatuses") or ()), *(status.get("containerStatuses") or ())]


def _before(pod: Document) -> Iterable[Document]:
    """The states of the containers that come before the run, if there are any."""
    for status in pod.get("status", {}).get("initContainerStatuses") or ():
        yield status.get("state") or {}


def _failed_before(pod: Document) -> Document | None:
    """Find how a container failed that comes before the run and had to succeed; None if none failed."""
    if _state(pod, "terminated") is not None or _state(pod, "running") is not None:
        return None
    ended = (state.get("terminated") or {} for state in _before(pod))
    return next((found for found in ended if found.get("exitCode")), None)


def data_refused(pod: Document) -> bool:
    """Return whether the pod did not get its data for a reason that another pod would meet too."""
    failed = _failed_before(pod)
    return failed is not None and failed.get("exitCode") == REFUSED_EXIT


def _state(pod: Document, kind: str) -> Document | None:
    for status in pod.get("status", {}).get("containerStatuses") or ():
        if status.get("name") == CONTAINER:
            found: Document | None = (status.get("state") or {}).get(kind)
            return found
    return None
