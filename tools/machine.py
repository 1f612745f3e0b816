"""What this machine has, and how to get what it lacks: Debian packages and the Docker engine. Standard library only."""

from __future__ import annotations

import http.client
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from steps import StepFailed, run_step, say

DOCKER_SOCKET = "/var/run/docker.sock"
ENGINE_PID_FILE = Path("/var/run/docker.pid")
ENGINE_START_S = 60.0


def can_install() -> bool:
    """Root on Debian or Ubuntu."""
    return os.geteuid() == 0 and shutil.which("apt-get") is not None


def install_command(packages: Sequence[str]) -> str:
    """The command for a user to type."""
    return f"sudo apt-get install {' '.join(packages)}"


def absent(packages: Sequence[str]) -> tuple[str, ...]:
    """Which Debian packages are not installed; all of them where there is no dpkg."""
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


def install_or_explain(packages: Sequence[str], problem: str) -> None:
    """Install what is missing where that is possible, else raise StepFailed naming the command."""
    if not can_install():
        raise StepFailed(f"{problem}; install what is missing: {install_command(packages)}")
    install(packages)


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

    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=5.0)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def engine_answers() -> bool:
    """A Docker engine answers on ``DOCKER_HOST`` or the usual socket."""
    target = urlsplit(os.environ.get("DOCKER_HOST") or f"unix://{DOCKER_SOCKET}")
    connection: http.client.HTTPConnection
    if target.scheme == "unix":
        connection = _UnixConnection(target.path)
    else:
        connection = http.client.HTTPConnection(target.hostname or "localhost", target.port or 2375, timeout=5.0)
    try:
        connection.request("GET", "/_ping")
        return connection.getresponse().status == http.client.OK
    except (OSError, http.client.HTTPException):
        return False
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
