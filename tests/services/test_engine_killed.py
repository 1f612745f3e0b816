"""A private Docker daemon is killed in the middle of a run and started again: the run is accounted for."""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.services.hive import Hive, open_hive
from slamhive.services.worker import worker as worker_module
from tests.services.docker_base import run_docker
from tests.services.tiny_project import environment, executions, make_dataset, make_project
from tests.waiting import eventually

pytestmark = [
    pytest.mark.integration,
    pytest.mark.docker,
    # The SDK drops, unclosed, the socket of a request that its daemon did not live to answer.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

START_S = 60.0


class PrivateDaemon:
    """A ``dockerd`` with its own folders and socket, without network."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = f"unix://{folder}/docker.sock"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        options = {
            "host": self.url,
            "data-root": self.folder / "data",
            "exec-root": self.folder / "exec",
            "pidfile": self.folder / "pid",
            "bridge": "none",
        }
        # In a network of its own: a daemon without a bridge removes docker0, which another daemon of the machine uses.
        alone = ["unshare", "--net", "dockerd", "--iptables=false"]
        command = [*alone, *(f"--{key}={value}" for key, value in options.items())]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            if run_docker("--host", self.url, "version").returncode == 0:
                return
            time.sleep(0.2)
        pytest.fail((self.folder / "log").read_text()[-2000:])

    def end(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)
        self.process.wait(START_S)
        # Its containerd may outlive a killed daemon, or leave a pid file that keeps the next one from starting.
        pid_file = self.folder / "exec" / "containerd" / "containerd.pid"
        if pid_file.exists():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid_file.read_text()), signal.SIGKILL)
            pid_file.unlink()
        (self.folder / "pid").unlink(missing_ok=True)


@pytest.fixture
def daemon(tmp_path: Path, base_image: str) -> Iterator[PrivateDaemon]:
    if os.geteuid() != 0 or shutil.which("dockerd") is None:
        pytest.skip("a private Docker daemon needs root and dockerd")
    # A socket's path has room for 100 characters, which tmp_path alone may fill.
    folder = Path(tempfile.mkdtemp(prefix="slamhive-dockerd-"))
    private = PrivateDaemon(folder)
    private.start()
    archive = tmp_path / "image.tar"
    for command in (
        ("save", "--output", str(archive), base_image),
        ("--host", private.url, "load", "--input", str(archive)),
        ("--host", private.url, "tag", base_image, "slam-hive-algorithm:tiny"),
    ):
        done = run_docker(*command)
        assert done.returncode == 0, done.stderr
    archive.unlink()
    yield private
    private.end(signal.SIGTERM)
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, daemon: PrivateDaemon) -> Iterator[Hive]:
    project = make_project(tmp_path / "project")
    (project / "algorithms" / "tiny" / "Dockerfile").unlink()
    make_dataset(tmp_path / "data")
    for key, value in environment(project, tmp_path / "data", executor="docker").items():
        monkeypatch.setenv(key, value)
    monkeypatch.setenv("DOCKER_HOST", daemon.url)
    monkeypatch.setattr(worker_module, "TROUBLE_PAUSE_S", 0.5)
    opened = open_hive()
    yield opened
    opened.close()
    gc.collect()


SAVES_ITS_MAP = """
import os, pathlib, signal, sys, time
result = pathlib.Path("/slamhive/result")
def save(*_):
    (result / "traj.txt").write_text("100.0 0 0 0 0 0 0 1\\n100.3 1 0 0 0 0 0 1\\n")
    sys.exit(0)
signal.signal(signal.SIGTERM, save)
(result / f"start-{time.time_ns()}").touch()
time.sleep(60)
"""


@contextlib.contextmanager
def working(hive: Hive, run_id: int) -> Iterator[None]:
    """A worker that goes on until there is nothing more to do; the block begins when the run is executed."""
    worker = hive.worker()
    thread = threading.Thread(target=worker.run, kwargs={"until_idle": True}, daemon=True)
    thread.start()
    eventually(lambda: executions(hive.runs.folder(run_id).result), "the start of the run")
    yield
    thread.join(120)
    assert not thread.is_alive()


def test_a_run_that_its_daemon_asks_to_end_is_lost_though_it_saved_its_map(hive, daemon):
    """As when Docker is updated."""
    hive.catalogue.algorithm("tiny").package.folder.joinpath("slamhive", "mapping.py").write_text(SAVES_ITS_MAP)
    (run,) = hive.runs.submit(Submission("tiny", "track", evaluate=False))
    with working(hive, run.id):
        daemon.end(signal.SIGTERM)
        daemon.start()
    ended = hive.runs.get(run.id)
    assert (ended.state, ended.reason) == (RunState.FAILED, FailureReason.LOST)
    assert "the engine went away at" in ended.detail
    assert "(exit code 0)" in ended.detail
    assert executions(hive.runs.folder(run.id).result) == 1


def test_a_run_survives_in_the_books_when_its_daemon_is_killed(hive, daemon):
    (victim, next_one) = hive.runs.submit(Submission("tiny", "track", {"seconds": 20}, repeat=1, evaluate=False)) + (
        hive.runs.submit(Submission("tiny", "track", {"seconds": 0.2}, evaluate=False))
    )
    with working(hive, victim.id):
        daemon.end(signal.SIGKILL)
        time.sleep(1)
        daemon.start()
    result = hive.runs.folder(victim.id).result
    lost = hive.runs.get(victim.id)
    assert (lost.state, lost.reason) in {(RunState.FAILED, FailureReason.LOST), (RunState.SUCCEEDED, None)}
    assert executions(result) == 1
    assert hive.runs.get(next_one.id).state is RunState.SUCCEEDED
    assert run_docker("--host", daemon.url, "ps", "--all", "--quiet").stdout == ""
