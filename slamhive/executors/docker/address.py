"""Where the Docker engine of this user answers, and what to do if it does not. Standard library only.

The set-up in ``tools/`` asks too, before Docker's SDK is installed.
"""

from __future__ import annotations

import grp
import hashlib
import json
import os
import pwd
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from slamhive.base.debian import as_root, find_program, install_command

SYSTEM_SOCKET = "/var/run/docker.sock"
_SOCKET_TIMEOUT_S = 5
JOIN = "sudo usermod -aG docker $USER"
_AGAIN = "then log in again"


class Trouble(NamedTuple):
    """Why a socket cannot be used, and what its user can do about it."""

    problem: str
    remedy: str
    is_there: bool = False
    """An engine is there, and this user cannot use it now."""


def engine_address(environment: Mapping[str, str] = os.environ) -> str:
    """The address of the engine, as the ``docker`` command chooses it.

    That is ``DOCKER_HOST``, or the context in use. Otherwise it is the engine of the system if this user may use its
    socket, or else a rootless engine of this user.
    """
    if environment.get("DOCKER_HOST"):
        return environment["DOCKER_HOST"]
    chosen = _address_of_context(environment)
    if chosen is not None:
        return chosen
    own = user_socket(environment)
    # Services that may not look into /run/user learn no more than that there is nothing for them.
    rootless = not _may_use(SYSTEM_SOCKET) and _may_use(own)
    return f"unix://{own if rootless else SYSTEM_SOCKET}"


def user_socket(environment: Mapping[str, str] = os.environ) -> Path:
    """The socket of a rootless engine of this user. A service of the system lacks the variable, but not the folder."""
    return Path(environment.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}", "docker.sock")


def _may_use(path: str | Path) -> bool:
    return os.access(path, os.R_OK | os.W_OK)


def socket_path(address: str) -> str | None:
    """The path of a Unix socket; None for an address of another kind."""
    scheme, _, path = address.partition("://")
    return path if scheme in {"unix", "http+unix"} else None


def trouble_with(path: str) -> Trouble | None:
    """Connect to the socket at ``path``: why that fails, None if somebody listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(_SOCKET_TIMEOUT_S)
        try:
            probe.connect(path)
        except PermissionError:
            return _closed(path)
        except OSError as error:
            return Trouble(f"no Docker engine answers at {path} ({error.strerror or error})", _start(path))
    return None


def _closed(path: str) -> Trouble:
    """The socket is there, but its group is another one."""
    user = pwd.getpwuid(os.geteuid()).pw_name
    problem = f"user {user} may not use the Docker engine at {path}"
    try:
        group = grp.getgrgid(Path(path).stat().st_gid)
    except (OSError, KeyError):
        return Trouble(problem, f"{JOIN}, {_AGAIN}", is_there=True)
    remedy = f"sudo usermod -aG {group.gr_name} $USER, {_AGAIN}"
    if user in group.gr_mem:
        problem += f": this session is older than its membership of the group {group.gr_name}"
        remedy = "log in again"
    elif group.gr_gid == 0:
        problem += ", which only root may"
        remedy = "let its socket have the group docker, as Debian's docker.io does"
    return Trouble(problem, remedy, is_there=True)


def _start(path: str) -> str:
    """The command that starts an engine for ``path``, or installs one."""
    if path == str(user_socket()):
        return "systemctl --user start docker"
    if path != SYSTEM_SOCKET:
        return "start it, or correct DOCKER_HOST or the context of docker"
    if find_program("dockerd") is not None:
        return as_root("systemctl start docker")
    install = install_command(["docker.io"])
    return install if os.geteuid() == 0 else f"{install} && {JOIN}, {_AGAIN}"


def _address_of_context(environment: Mapping[str, str]) -> str | None:
    """The address that ``docker context use`` has chosen; None for the default.

    Contexts with certificates are left to docker.
    """
    folder = Path(environment.get("DOCKER_CONFIG") or Path.home() / ".docker")
    try:
        name = environment.get("DOCKER_CONTEXT") or json.loads((folder / "config.json").read_text())["currentContext"]
        if name == "default":
            return None
        digest = hashlib.sha256(name.encode()).hexdigest()
        description = json.loads((folder / "contexts" / "meta" / digest / "meta.json").read_text())
        address = description["Endpoints"]["docker"]["Host"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return str(address) or None
