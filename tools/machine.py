"""Programs of this machine, and how to get others: Debian packages and the Docker engine. Standard library only."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from steps import StepFailed, run_step, say

sys.path.insert(1, str(Path(__file__).resolve().parent.parent))  # SLAM Hive may not be installed yet

from slamhive.executors.docker.address import Trouble, engine_address, socket_path, trouble_with

ENGINE_PID_FILE = Path("/var/run/docker.pid")
ENGINE_START_S = 60.0
ASK_S = 5.0
PULL_S = 600.0


def can_install() -> bool:
    """Root on Debian or Ubuntu."""
    return os.geteuid() == 0 and shutil.which("apt-get") is not None


def absent(packages: Sequence[str]) -> tuple[str, ...]:
    """Debian packages that are not installed; all of them where there is no dpkg."""
    if shutil.which("dpkg-query") is None:
        return tuple(packages)
    command = ["dpkg-query", "-W", "-f", "${Package} ${db:Status-Status}\n", *packages]
    output = subprocess.run(command, check=False, capture_output=True, text=True).stdout
    installed = {line.split()[0] for line in output.splitlines() if line.endswith(" installed")}
    return tuple(package for package in packages if package not in installed)


def install(packages: Sequence[str]) -> None:
    """Install Debian packages without starting their services; raises StepFailed."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    command = ["apt-get", "install", "-y", "--no-install-recommends", *packages]
    label = f"install {' '.join(packages)}"
    label = label if len(label) <= 44 else f"install {len(packages)} system packages"
    try:
        run_step(label, command, environment)
    except StepFailed:
        run_step("refresh the package lists", ["apt-get", "update"], environment)
        run_step(label, command, environment)


def available(*names: str) -> str | None:
    """The first of these packages that can be installed here, None if none can."""
    for name in names:
        policy = subprocess.run(["apt-cache", "policy", name], check=False, capture_output=True, text=True).stdout
        if "Candidate:" in policy and "Candidate: (none)" not in policy:
            return name
    return None


def has_compose() -> bool:
    """``docker compose`` or the stand-alone ``docker-compose`` works."""
    for command in (["docker", "compose", "version"], ["docker-compose", "version"]):
        if shutil.which(command[0]) and subprocess.run(command, check=False, capture_output=True).returncode == 0:
            return True
    return False


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: str, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def engine_answers() -> bool:
    """The Docker engine of this user answers."""
    return engine_trouble() is None


def engine_trouble() -> Trouble | None:
    """Why no Docker engine answers this user, and the remedy; None if one does."""
    address = engine_address()
    path = socket_path(address)
    trouble = None if path is None else trouble_with(path)
    if trouble is not None:
        return trouble
    try:
        if _ask_engine("GET", "/_ping", ASK_S)[0] == http.client.OK:
            return None
    except (OSError, http.client.HTTPException):
        pass
    if path is None:
        return Trouble(f"no Docker engine answers at {address}", "start it, or correct DOCKER_HOST")
    # systemd holds the socket open before the engine is ready, which then answers who came earlier.
    say("Docker engine", f"it takes connections at {path} but does not answer yet, waiting for it")
    try:
        if _ask_engine("GET", "/_ping", ENGINE_START_S)[0] == http.client.OK:
            return None
    except (OSError, http.client.HTTPException):
        pass
    problem = f"the Docker engine at {path} takes connections but does not answer"
    return Trouble(problem, "docker info shows when it does, and the log of its service why not", is_there=True)


def has_image(name: str) -> bool:
    """Return whether the engine has an image of this name."""
    try:
        return _ask_engine("GET", f"/images/{name}/json", ASK_S)[0] == http.client.OK
    except (OSError, http.client.HTTPException):
        return False


def pull(name: str) -> str | None:
    """Pull an image; why that failed in one line, None if it did not."""
    repository, _, tag = name.rpartition(":")
    started = time.monotonic()
    try:
        status, answer = _ask_engine("POST", f"/images/create?fromImage={repository}&tag={tag}", PULL_S)
    except (OSError, http.client.HTTPException) as error:
        return str(error) or type(error).__name__
    # The engine answers 200 before it begins, and says in the last line how it went.
    last = json.loads((answer.strip().splitlines() or ["{}"])[-1])
    problem = last.get("error") or (None if status == http.client.OK else last.get("message", f"status {status}"))
    if problem is None:
        say(f"pull {name}", f"{time.monotonic() - started:6.1f} s")
    return problem


def _ask_engine(method: str, path: str, timeout_s: float) -> tuple[int, str]:
    """Status and body of the engine's answer. Raises OSError or HTTPException."""
    address = engine_address()
    target = urlsplit(address)
    socket_of_engine = socket_path(address)
    connection: http.client.HTTPConnection
    if socket_of_engine is not None:
        connection = _UnixConnection(socket_of_engine, timeout_s)
    else:
        connection = http.client.HTTPConnection(target.hostname or "localhost", target.port or 2375, timeout=timeout_s)
    try:
        connection.request(method, path)
        response = connection.getresponse()
        return response.status, response.read().decode(errors="replace")
    finally:
        connection.close()


def _remove_stale_pid_file() -> None:
    """A daemon that was killed leaves its number; if another process has that number now, none would start."""
    try:
        command = Path(f"/proc/{int(ENGINE_PID_FILE.read_text())}/comm").read_text().strip()
    except (OSError, ValueError):
        return
    if command != "dockerd":
        ENGINE_PID_FILE.unlink(missing_ok=True)


class Engine:
    """A Docker engine that this process started, to be stopped again."""

    def __init__(self) -> None:
        self._daemon: subprocess.Popen[bytes] | None = None
        self._unit_started = False
        self._log = Path(tempfile.gettempdir()) / f"slamhive-dockerd-{os.getpid()}.log"

    def start(self) -> None:
        """Start the engine and wait until it answers; raises StepFailed with the engine's last words."""
        started = time.monotonic()
        if Path("/run/systemd/system").is_dir():
            subprocess.run(["systemctl", "start", "docker"], check=False, capture_output=True)
            if self._wait(lambda: False):
                self._unit_started = True
                say("start the Docker engine", f"{time.monotonic() - started:6.1f} s")
                return
            raise StepFailed("the Docker engine does not start; see: journalctl -u docker")
        _mount_cgroups()
        _remove_stale_pid_file()
        # The second try is for kernels without packet filtering: networks host and none still work.
        for options in ((), ("--iptables=false", "--ip6tables=false", "--bridge=none")):
            with self._log.open("wb") as log:
                self._daemon = subprocess.Popen(
                    ["dockerd", *options], stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
                )
            if self._wait(self._daemon_ended):
                say("start the Docker engine", f"{time.monotonic() - started:6.1f} s")
                return
            self._stop_daemon()
        last = self._log.read_text(errors="replace").strip().splitlines()[-1:]
        raise StepFailed(f"the Docker engine does not start: {' '.join(last)} (whole log: {self._log})")

    def stop(self) -> None:
        """Stop the engine if this process started it."""
        if self._unit_started:
            subprocess.run(["systemctl", "stop", "docker.socket", "docker"], check=False, capture_output=True)
            self._unit_started = False
        if self._daemon is not None:
            self._stop_daemon()
            self._log.unlink(missing_ok=True)

    def _stop_daemon(self) -> None:
        if self._daemon is None:
            return
        if self._daemon.poll() is None:
            self._daemon.send_signal(signal.SIGTERM)
            try:
                self._daemon.wait(timeout=30.0)
            except subprocess.TimeoutExpired:
                self._daemon.kill()
                self._daemon.wait()
        self._daemon = None

    def _daemon_ended(self) -> bool:
        return self._daemon is not None and self._daemon.poll() is not None

    @staticmethod
    def _wait(gave_up: Callable[[], bool]) -> bool:
        deadline = time.monotonic() + ENGINE_START_S
        while time.monotonic() < deadline:
            if engine_answers():
                return True
            if gave_up():
                return False
            time.sleep(0.3)
        return False


def _mount_cgroups() -> None:
    """Without systemd nobody may have mounted the control groups that the engine needs."""
    if any(Path("/sys/fs/cgroup").iterdir()):
        return
    if can_install() and absent(["cgroupfs-mount"]):
        install(["cgroupfs-mount"])
    if shutil.which("cgroupfs-mount"):
        run_step("mount the control groups", ["cgroupfs-mount"])
