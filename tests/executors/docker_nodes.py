"""Nodes of Kubernetes whose pods are containers of Docker: supervisor, courier and limits are real.

Beside an :class:`tests.executors.api_server.ApiServer` they stand for a cluster where its programs are not here.
Nothing is learnt from them about a scheduler, a kubelet or containerd.
"""

from __future__ import annotations

import base64
import tempfile
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from slamhive.executors.base import Executor
from tests.executors.api_server import ApiServer, Document
from tests.services.docker_base import run_docker
from tests.waiting import eventually

_TERMINATION_LOG = "/dev/termination-log"


class DockerNodes:
    """Runs each pod that gets a node, in a thread of its own.

    Args:
        folder: Where volumes of pods are made, and what containers leave as the reason of their end.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._threads: list[threading.Thread] = []
        self.executors: list[Executor] = []
        """Those that use it, which are closed with it."""
        self.server: ApiServer

    def bound(self, pod: Document) -> None:
        """Start the pod."""
        self._threads.append(threading.Thread(target=Pod(self.server, pod, self._folder).run))
        self._threads[-1].start()

    def deleted(self, pod: Document, *, by_force: bool) -> None:
        """Ask its containers to end, as long as it grants them, unless they are to end at once."""
        names = run_docker("ps", "--all", "--quiet", "--filter", f"label=pod={pod['metadata']['uid']}").stdout.split()
        if names and not by_force:
            run_docker("stop", "--time", str(pod["spec"]["terminationGracePeriodSeconds"]), *names)
        if names:
            run_docker("rm", "--force", *names)

    def close(self) -> None:
        """End all pods, and close the executors."""
        for pod in self.server.all("pods"):
            self.deleted(pod, by_force=True)
        for thread in self._threads:
            thread.join()
        for executor in self.executors:
            executor.close()


class Pod:
    """One pod: its volumes, the containers that come before the run, and the run."""

    def __init__(self, server: ApiServer, pod: Document, folder: Path) -> None:
        self._server = server
        self._pod = pod
        self._name = pod["metadata"]["name"]
        self._folder = Path(tempfile.mkdtemp(prefix="pod-", dir=folder))
        self._folder.chmod(0o755)
        self._volumes = {volume["name"]: self._volume(volume) for volume in pod["spec"]["volumes"]}
        self._states: dict[str, list[Document]] = {"initContainerStatuses": [], "containerStatuses": []}

    def run(self) -> None:
        """From the first container to the end of the pod, as far as nobody deletes it meanwhile."""
        beside: list[str] = []
        for container in self._pod["spec"].get("initContainers", ()):
            name = self._start("initContainerStatuses", container, "host")
            if name is None:
                return
            if container.get("restartPolicy") == "Always":
                beside.append(name)
                self._wait_until_ready(name, container["startupProbe"]["exec"]["command"])
            elif self._wait("initContainerStatuses", container, name):
                self._report(phase="Failed")
                return
        (container,) = self._pod["spec"]["containers"]
        name = self._start("containerStatuses", container, "none")
        if name is None:
            return
        self._report(phase="Running")
        code = self._wait("containerStatuses", container, name)
        for other in beside:
            run_docker("stop", "--time", "30", other)
        self._report(phase="Failed" if code else "Succeeded")
        run_docker("rm", "--force", name, *beside)

    def _volume(self, volume: Document) -> Path | None:
        """Where a volume lies on this machine; None if it is memory."""
        if "hostPath" in volume:
            return Path(volume["hostPath"]["path"])
        if "medium" in volume.get("emptyDir", {}):
            return None
        made = self._folder / str(volume["name"])
        made.mkdir()
        made.chmod(0o777)
        if "secret" in volume:
            (secret,) = (
                entry
                for entry in self._server.all("secrets")
                if entry["metadata"]["name"] == volume["secret"]["secretName"]
            )
            for name, content in secret["data"].items():
                (made / name).write_bytes(base64.b64decode(content))
        return made

    def _start(self, kind: str, container: Document, network: str) -> str | None:
        """The name of the container, which has been started; None if it cannot be, which the pod then says."""
        name = f"{self._name}-{container['name']}"
        made = run_docker("create", "--name", name, "--network", network, *self._options(container))
        started = made if made.returncode else run_docker("start", name)
        if started.returncode:
            reason = "ErrImageNeverPull" if "No such image" in started.stderr else "CreateContainerError"
            self._note(kind, container, {"waiting": {"reason": reason, "message": started.stderr.strip()}})
            self._report(phase="Pending")
            return None
        self._note(kind, container, {"running": {}})
        self._report(phase="Pending")
        return name

    def _options(self, container: Document) -> Iterable[str]:
        who, limits = self._pod["spec"]["securityContext"], container["resources"]["limits"]
        hardened = container["securityContext"]
        assert hardened["readOnlyRootFilesystem"]
        assert not hardened["allowPrivilegeEscalation"]
        assert hardened["capabilities"] == {"drop": ["ALL"]}
        yield from ("--label", f"pod={self._pod['metadata']['uid']}", "--pull", "never")
        yield from ("--user", f"{who['runAsUser']}:{who['runAsGroup']}", "--read-only", "--cap-drop", "ALL")
        yield from ("--security-opt", "no-new-privileges")
        if "memory" in limits:
            yield from ("--memory", limits["memory"], "--memory-swap", limits["memory"])
        if "cpu" in limits:
            yield from ("--cpus", str(int(limits["cpu"].removesuffix("m")) / 1000))
        for entry in container["env"]:
            yield from ("--env", f"{entry['name']}={entry.get('value') or self._field(entry)}")
        reason = self._folder / f"{container['name']}-reason"
        reason.touch()
        reason.chmod(0o666)
        yield from ("--volume", f"{reason}:{_TERMINATION_LOG}")
        for mount in container["volumeMounts"]:
            volume = self._volumes[mount["name"]]
            if volume is None:
                continue  # /dev/shm, which Docker gives by itself
            source = volume / mount.get("subPath", "")
            mode = "ro" if mount.get("readOnly") else "rw"
            yield from ("--volume", f"{source}:{mount['mountPath']}:{mode}")
        program, *arguments = container["command"]
        yield from ("--entrypoint", program, container["image"], *arguments)

    def _field(self, entry: Document) -> str:
        path = entry.get("valueFrom", {}).get("fieldRef", {}).get("fieldPath", "")
        found: Any = self._pod
        for part in filter(None, path.split(".")):
            found = found[part]
        return str(found) if path else ""

    def _wait_until_ready(self, name: str, command: list[str]) -> None:
        """Until the check of a container that stays succeeds, or the container has ended."""

        def is_ready() -> bool:
            return run_docker("exec", name, *command).returncode == 0 or not self._goes_on(name)

        eventually(is_ready, f"the check of {name}")

    def _goes_on(self, name: str) -> bool:
        return run_docker("inspect", "--format", "{{.State.Running}}", name).stdout.strip() == "true"

    def _wait(self, kind: str, container: Document, name: str) -> int:
        """How a container ended, which its pod then says."""
        waited = run_docker("wait", name).stdout.strip()
        code = int(waited) if waited.isdigit() else 137
        killed = run_docker("inspect", "--format", "{{.State.OOMKilled}}", name).stdout.strip() == "true"
        reason = "OOMKilled" if killed else "Error" if code else "Completed"
        message = (self._folder / f"{container['name']}-reason").read_text()
        self._note(kind, container, {"terminated": {"exitCode": code, "reason": reason, "message": message}})
        return code

    def _note(self, kind: str, container: Document, state: Document) -> None:
        others = [entry for entry in self._states[kind] if entry["name"] != container["name"]]
        self._states[kind] = [*others, {"name": container["name"], "state": state}]

    def _report(self, **status: object) -> None:
        with suppress(KeyError):  # the pod was deleted
            self._server.status(self._name, **{**self._states, **status})
