"""Executors of other packages, really installed: the remote one of these tests, and the documentation's example."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from importlib.metadata import EntryPoint, distributions
from pathlib import Path
from typing import Self

from tests.extend.plugin_packages import CHECKOUT, EXTEND, install, write_package
from tests.waiting import eventually

PLUGINS = ("plain", "remote")
PLAIN_ENTRY_POINT = """
[project.entry-points."slamhive.executors"]
plain = "slamhive_plain:PlainExecutor"
"""
TOKEN = "a token of these tests"


def install_plugins(sources: Path, folder: Path) -> Path:
    """Write both packages to ``sources``, and install them into a folder that is put on the path."""
    remote = sources / "remote"
    shutil.copytree(Path(__file__).parent / "remote_plugin", remote, ignore=shutil.ignore_patterns("__pycache__"))
    example = (EXTEND / "executor.py").read_text()
    plain = write_package(sources / "plain", "slamhive_plain", example, PLAIN_ENTRY_POINT)
    return install([remote, plain], folder)


def distributions_in(folder: Path) -> list[EntryPoint]:
    """The executors that the packages installed in ``folder`` announce."""
    found = [point for package in distributions(path=[str(folder)]) for point in package.entry_points]
    assert sorted(point.name for point in found if point.group == "slamhive.executors") == sorted(PLUGINS)
    return found


def answers(address: Path) -> bool:
    """Whether a process listens on a socket; the file is there a moment before."""
    with socket.socket(socket.AF_UNIX) as asking:
        return asking.connect_ex(str(address)) == 0


class Agent:
    """A process that stands for another machine. It can be killed and started again."""

    def __init__(self, root: Path, plugin_folder: Path) -> None:
        self.root = root
        self._plugin_folder = plugin_folder
        self._socket_folder = Path(tempfile.mkdtemp(prefix="agent-"))  # the path of a socket must be short
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def variables(self) -> dict[str, str]:
        """What the executor needs to find it."""
        return {"REMOTE_AGENT": str(self._socket_folder / "socket"), "REMOTE_TOKEN": TOKEN}

    def start(self) -> None:
        """Start it, and wait until it listens."""
        paths = os.pathsep.join((str(CHECKOUT), str(self._plugin_folder)))
        address = Path(self.variables["REMOTE_AGENT"])
        address.unlink(missing_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "slamhive_remote.agent", str(self.root), str(address)],
            env={**os.environ, **self.variables, "PYTHONPATH": paths},
            cwd="/",
        )
        eventually(lambda: answers(address), "the agent")

    def kill(self) -> None:
        """SIGKILL; the runs that it has started go on."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        shutil.rmtree(self._socket_folder)
