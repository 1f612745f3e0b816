"""Where the Docker engine of a user is found, and what is said if it cannot be used."""

from __future__ import annotations

import grp
import hashlib
import json
import os
import pwd
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from slamhive.executors.docker import address
from slamhive.executors.docker.address import engine_address, trouble_with


@pytest.fixture
def user(tmp_path, monkeypatch) -> dict[str, str]:
    """The variables of a user whose system has no engine; what root may is not theirs."""
    monkeypatch.setattr(address, "SYSTEM_SOCKET", str(tmp_path / "system.sock"))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(pwd, "getpwuid", lambda uid: SimpleNamespace(pw_name="dev"))
    return {"XDG_RUNTIME_DIR": str(tmp_path / "user"), "DOCKER_CONFIG": str(tmp_path / "config")}


@pytest.fixture
def listening(tmp_path) -> Iterator[Path]:
    """A rootless engine's socket."""
    path = tmp_path / "user" / "docker.sock"
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(path))
        server.listen()
        yield path


def test_the_system_comes_first_then_the_rootless_engine(user, tmp_path, listening):
    assert engine_address(user) == f"unix://{listening}"
    (tmp_path / "system.sock").touch()
    assert engine_address(user) == f"unix://{tmp_path}/system.sock"
    listening.unlink()
    (tmp_path / "system.sock").unlink()
    assert engine_address(user) == f"unix://{tmp_path}/system.sock"


def test_a_closed_system_socket_gives_way_to_the_rootless_engine(user, tmp_path, listening, monkeypatch):
    (tmp_path / "system.sock").touch()
    monkeypatch.setattr(os, "access", lambda path, mode: path == listening)
    assert engine_address(user) == f"unix://{listening}"
    # Both are closed: a service that may not look into the folders of users.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert engine_address(user) == f"unix://{tmp_path}/system.sock"


def test_the_variable_and_the_context_come_before_both(user, tmp_path, listening):
    config = tmp_path / "config"
    meta = config / "contexts" / "meta" / hashlib.sha256(b"lab").hexdigest()
    meta.mkdir(parents=True)
    (meta / "meta.json").write_text(json.dumps({"Endpoints": {"docker": {"Host": "ssh://lab"}}}))
    (config / "config.json").write_text(json.dumps({"currentContext": "lab"}))
    assert engine_address(user) == "ssh://lab"
    assert engine_address({**user, "DOCKER_CONTEXT": "default"}) == f"unix://{listening}"
    assert engine_address({**user, "DOCKER_HOST": "tcp://there:2375"}) == "tcp://there:2375"
    (config / "config.json").write_text("{}")
    assert engine_address(user) == f"unix://{listening}"


def test_who_listens_is_no_trouble(listening):
    assert trouble_with(str(listening)) is None


def closed(monkeypatch, group: str, gid: int, members: list[str]) -> None:
    def refuse(self, path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(grp, "getgrgid", lambda _: SimpleNamespace(gr_name=group, gr_gid=gid, gr_mem=members))


@pytest.mark.parametrize(
    ("group", "members", "problem", "remedy"),
    [
        ("docker", [], "user dev may not use", "sudo usermod -aG docker $USER, then log in again"),
        ("docker", ["dev"], "this session is older than its membership of the group docker", "log in again"),
        ("engines", [], "user dev may not use", "sudo usermod -aG engines $USER, then log in again"),
    ],
)
def test_a_closed_socket_names_the_command(user, tmp_path, monkeypatch, group, members, problem, remedy):
    (tmp_path / "system.sock").touch()
    closed(monkeypatch, group, 999, members)
    trouble = trouble_with(address.SYSTEM_SOCKET)
    assert trouble is not None
    assert problem in trouble.problem
    assert (trouble.remedy, trouble.is_there) == (remedy, True)


@pytest.mark.parametrize(
    ("dockerd", "remedy"),
    [
        ("/usr/sbin/dockerd", "sudo systemctl start docker"),
        (None, "sudo apt-get install docker.io && sudo usermod -aG docker $USER, then log in again"),
    ],
)
def test_an_absent_engine_is_started_or_installed(user, monkeypatch, dockerd, remedy):
    monkeypatch.setattr(address, "find_program", lambda name: dockerd)
    trouble = trouble_with(address.SYSTEM_SOCKET)
    assert trouble is not None
    assert "No such file or directory" in trouble.problem
    assert (trouble.remedy, trouble.is_there) == (remedy, False)


def test_a_rootless_engine_is_started_by_its_user(user, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    trouble = trouble_with(str(tmp_path / "docker.sock"))
    assert trouble is not None
    assert trouble.remedy == "systemctl --user start docker"
