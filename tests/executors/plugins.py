"""Executors of other packages, really installed: the remote one of these tests, and the documentation's example."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import EntryPoint, distributions
from pathlib import Path
from typing import Self

from tests.waiting import eventually

CHECKOUT = Path(__file__).resolve().parents[2]
PLUGINS = ("plain", "remote")
PLAIN = """
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "slamhive-plain"
version = "1.0.0"

[project.entry-points."slamhive.executors"]
plain = "slamhive_plain:PlainExecutor"

[tool.setuptools]
py-modules = ["slamhive_plain"]
"""
TOKEN = "a token of these tests"


def install_plugins(folder: Path) -> Path:
    """Install both packages into a folder that is put on the path."""
    remote, plain, target = folder / "remote", folder / "plain", folder / "installed"
    shutil.copytree(Path(__file__).parent / "remote_plugin", remote, ignore=shutil.ignore_patterns("__pycache__"))
    plain.mkdir()
    (plain / "pyproject.toml").write_text(PLAIN)
    shutil.copy(CHECKOUT / "docs" / "extend" / "executor.py", plain / "slamhive_plain.py")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    command += ["--disable-pip-version-check", "--target", str(target), str(remote), str(plain)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return target


def distributions_in(folder: Path) -> list[EntryPoint]:
    """The executors that the packages installed in ``folder`` announce."""
    found = [point for package in distributions(path=[str(folder)]) for point in package.entry_points]
    assert sorted(point.name for point in found if point.group == "slamhive.executors") == sorted(PLUGINS)
    return found


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
        socket = Path(self.variables["REMOTE_AGENT"])
        socket.unlink(missing_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "slamhive_remote.agent", str(self.root), str(socket)],
            env={**os.environ, **self.variables, "PYTHONPATH": paths},
            cwd="/",
        )
        eventually(socket.exists, "the agent")

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
