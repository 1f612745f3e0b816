"""Nodes of Kubernetes that are played: what kubelet and supervisor write and report, without either."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.kubernetes.pod_files import CLAIM_FILE, POD_FOLDER, STARTED_FILE, write_json
from slamhive.executors.process.exit_file import reserve, write_exit
from slamhive.executors.spec import RunOutput, RunSpec
from slamhive.executors.status import Gone, RunHandle, Running
from tests.executors.api_server import ApiServer, Document
from tests.executors.test_kubernetes_manifest import SPEC
from tests.waiting import eventually

STARTED = {"started_s": 10.0, "cpu": "Xeon", "cores": 4, "memory_bytes": 10**9, "kernel": "6.1"}
WELL = {
    "exit_code": 0,
    "out_of_memory": False,
    "process_limit": False,
    "timed_out": False,
    "ended_from_outside": False,
    "error": "",
    "started_s": 10.0,
    "ended_s": 11.0,
}
RUNNING = [{"name": "run", "state": {"running": {}}}]


MakeKubernetes = Callable[..., KubernetesExecutor]


class Nodes:
    """Plays kubelet and supervisor: a pod that gets a node begins at once, unless the nodes are idle."""

    def __init__(self) -> None:
        self.idle = False
        self.meets: Callable[[Document], object] = self.begin
        """What happens to a pod that gets a node."""
        self.began: list[str] = []
        """Where runs began."""
        self.server: ApiServer

    @staticmethod
    def folder(pod: Document) -> Path:
        """What the pod sees of its files, by its own volumes."""
        (run,) = pod["spec"]["containers"]
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        mounts = {mount["mountPath"]: mount["name"] for mount in run["volumeMounts"]}
        return Path(volumes[mounts[POD_FOLDER]]["hostPath"]["path"])

    def bound(self, pod: Document) -> None:
        if not self.idle:
            self.meets(pod)

    def begin(self, pod: Document) -> None:
        """What the supervisor does first."""
        folder, node = self.folder(pod), pod["spec"]["nodeName"]
        os.close(os.open(folder / CLAIM_FILE, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        write_json(folder / STARTED_FILE, {**STARTED, "node": node})
        self.began.append(node)
        self.server.status(pod["metadata"]["name"], phase="Running", containerStatuses=RUNNING)

    def record(self, pod: Document, **how: object) -> None:
        """What it does last."""
        reserve(self.folder(pod))
        write_exit(self.folder(pod), {**WELL, **how})

    def end(self, pod: Document, **how: object) -> None:
        """The same, and its pod is over."""
        self.record(pod, **how)
        self.server.status(pod["metadata"]["name"], phase="Failed" if how.get("exit_code") else "Succeeded")

    def deleted(self, pod: Document, *, by_force: bool) -> None:
        """Nothing: pods of tests that are deleted record nothing."""


def spec_of(folder: Path, key: str, **changes: Any) -> RunSpec:
    work = folder / "runs" / key / "work"
    work.mkdir(parents=True)
    output = RunOutput("result", work.parent / "result", "/slamhive/result", live=("alive",))
    output.destination.mkdir()
    return replace(SPEC, key=key, work=work, outputs=(output,), package_folder=folder, **changes)


def left(server: ApiServer) -> list[str]:
    """What is there besides nodes and events."""
    return [entry["metadata"]["name"] for kind in ("jobs", "pods", "secrets") for entry in server.all(kind)]


def lost(kubernetes: KubernetesExecutor, handle: RunHandle) -> str:
    """Why the run was lost, as soon as that is known."""
    eventually(lambda: not isinstance(kubernetes.poll(handle), Running), "the loss")
    status = kubernetes.poll(handle)
    assert isinstance(status, Gone), status
    return status.why
