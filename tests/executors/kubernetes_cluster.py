"""A real, small Kubernetes on this machine: ``../shared/kubernetes/kube`` starts the programs in ``KUBE_TOOLS``."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, Self

import psutil
import pytest

from tests.executors import kube_supervised
from tests.executors.kube_supervised import KUBE
from tests.waiting import eventually

NODES = ("node1", "node2")
TOOLS = "KUBE_TOOLS"
"""The variable with the programs of Kubernetes: a folder, or a .tar.xz of it."""
NO_PROGRAMS = f"{TOOLS} is empty: it names the programs of Kubernetes, see CONTRIBUTING.md"
_OF_A_TEST = ("SLAMHIVE_", "TMPDIR")


def why_no_kubernetes() -> str | None:
    """Why no test can have a Kubernetes; None if one can, or if what ``KUBE_TOOLS`` names lets all of them fail."""
    if not os.environ.get(TOOLS):
        return NO_PROGRAMS
    if not KUBE.exists():
        return "../shared/kubernetes/kube, which starts a Kubernetes for tests, is not here"
    return "a Kubernetes for tests needs root" if os.geteuid() != 0 else None


class KubernetesCluster:
    """Two nodes and a control plane, all with namespaces of their own; they see the files of this machine."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "cluster"
        self._archives = folder
        self.port = _free_port()
        """Of this machine's 127.0.0.1; pods reach it at :attr:`url`."""

    @property
    def url(self) -> str:
        """Where pods reach what listens on :attr:`port`."""
        return f"http://10.243.0.1:{self.port}"

    @property
    def cache(self) -> Path:
        """A folder of which each node has one of its own."""
        return self._folder / "node-cache"

    def cache_of(self, node: str) -> Path:
        """The folder of a node that pods there see at :attr:`cache`."""
        return self._folder / f"node-cache-{node}"

    def separate_caches(self) -> None:
        """Give each node a cache of its own, which is empty."""
        self.cache.mkdir(exist_ok=True)
        for node in NODES:
            shutil.rmtree(self.cache_of(node), ignore_errors=True)
            self.cache_of(node).mkdir()
            self._on(node, "umount", "--quiet", str(self.cache), check=False)
            self._on(node, "mount", "--bind", str(self.cache_of(node)), str(self.cache))

    def hide(self, *folders: Path) -> None:
        """Let no node see what is in these folders."""
        for folder in folders:
            for node in NODES:
                if self._on(node, "mountpoint", "--quiet", str(folder), check=False).returncode:
                    self._on(node, "mount", "-t", "tmpfs", "hidden", str(folder))
                assert self._on(node, "ls", "-A", str(folder)).stdout == b"", f"{node} sees {folder}"

    @property
    def kubeconfig(self) -> Path:
        """With the rights of an administrator."""
        return self._folder / "kubeconfig"

    def use(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let this process find the cluster."""
        monkeypatch.setenv("KUBECONFIG", str(self.kubeconfig))

    def kubectl(self, *arguments: str, stdin: str | None = None) -> str:
        """The output of a command."""
        return self._kube("kubectl", str(self._folder), *arguments, stdin=stdin)

    def read(self, *arguments: str) -> Any:
        """The output of ``kubectl get`` as data."""
        return json.loads(self.kubectl("get", *arguments, "-o", "json"))

    def load(self, image: str) -> None:
        """Give an image of the Docker engine to all nodes."""
        archive = self._archives / "image.tar"
        subprocess.run(["docker", "save", image, "-o", str(archive)], check=True)
        self._kube("load", str(self._folder), str(archive))
        archive.unlink()

    def lose(self, node: str) -> None:
        """A power cut of one node."""
        self._kube("node-stop", str(self._folder), node)

    def bring_back(self, node: str) -> None:
        """The node starts again, and is ready."""
        self._kube("node-start", str(self._folder), node)

    def kill_api_server(self) -> None:
        """SIGKILL; the control plane starts it again."""
        self.kill("kube-apiserver")

    def kill(self, daemon: str, node: str | None = None) -> None:
        """SIGKILL to a daemon of the control plane, or of a node; it is started again a second later.

        Some end by themselves when others are killed, like a controller manager that loses etcd. Then the next one is
        waited for.
        """
        eventually(lambda: self.runs(daemon, node), f"a {daemon} to kill")
        victim = next(process for process in psutil.process_iter(["cmdline"]) if self._is(process, daemon, node))
        victim.send_signal(signal.SIGKILL)
        victim.wait(10)

    def runs(self, daemon: str, node: str | None = None) -> bool:
        """Whether the daemon has been started again."""
        return any(self._is(process, daemon, node) for process in psutil.process_iter(["cmdline"]))

    def wait_for_api_server(self) -> None:
        """Until it answers again."""
        eventually(self._answers, "the API server")

    def __enter__(self) -> Self:
        self._kube("up", str(self._folder), "--nodes", str(len(NODES)), "--reach", str(self.port))
        return self

    def __exit__(self, *_: object) -> None:
        self._kube("down", str(self._folder), "--all")
        shutil.rmtree(self._archives, ignore_errors=True)

    def _on(self, node: str, *command: str, check: bool = True) -> subprocess.CompletedProcess[bytes]:
        """Execute a command where a node sees its files."""
        eventually(lambda: self.runs("kubelet", node), f"the kubelet of {node}")
        kubelet = next(process for process in psutil.process_iter(["cmdline"]) if self._is(process, "kubelet", node))
        return subprocess.run(["nsenter", "-t", str(kubelet.pid), "-m", *command], check=check, capture_output=True)

    def _answers(self) -> bool:
        try:
            return self.kubectl("get", "--raw", "/readyz") == "ok"
        except AssertionError:
            return False

    def _is(self, process: psutil.Process, daemon: str, node: str | None) -> bool:
        line = process.info["cmdline"] or []
        words = " ".join(line)
        ours = any(Path(part).name == daemon for part in line[:2]) and str(self._folder) in words
        return ours and (node is None or f"={node} " in words or f"/{node}/" in words)

    def _kube(self, *arguments: str, stdin: str | None = None) -> str:
        # A node that is started during a test must not look like a process of that test's installation.
        environment = {name: value for name, value in os.environ.items() if not name.startswith(_OF_A_TEST)}
        environment[TOOLS] = str(Path(environment[TOOLS]).resolve())
        command = [sys.executable, kube_supervised.__file__, *arguments]
        done = subprocess.run(command, input=stdin, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"kube {' '.join(arguments)}: {done.stderr or done.stdout}"
        return done.stdout


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])
