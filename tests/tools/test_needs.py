"""``tools/needs.py``: what only root can install is asked for once, in one line, before anything takes long."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from slamhive.base.strict_yaml import parse
from slamhive.executors.docker.address import Trouble

TOOLS = Path(__file__).resolve().parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

import bootstrap  # noqa: E402
import machine  # noqa: E402
import needs  # noqa: E402
import steps  # noqa: E402
from machine import engine_trouble  # noqa: E402

ABSENT = Trouble("no Docker engine answers", "install it")
CLOSED = Trouble("user dev may not use the Docker engine", "sudo usermod -aG docker $USER, then log in again", True)


@pytest.fixture(autouse=True)
def plain_user(monkeypatch):
    """A user without rights and without a terminal, on a machine with nothing but Debian's own."""
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(machine, "can_install", lambda: False)
    monkeypatch.setattr(machine, "install", lambda packages: pytest.fail("installs without rights"))
    monkeypatch.setattr(machine, "engine_trouble", lambda: ABSENT)
    monkeypatch.setattr(machine, "available", lambda *names: names[0])
    monkeypatch.setattr(machine, "has_compose", lambda: False)
    monkeypatch.setattr(needs, "_missing", tuple)
    monkeypatch.setattr(needs, "find_program", lambda name: None)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)


def test_the_demo_without_docker_asks_for_the_libraries_and_goes_on(capsys):
    needs.provide(needs.for_demo())
    said = capsys.readouterr().out
    assert f"  sudo apt-get install {' '.join(needs.ORB_SLAM3_LIBRARIES)}\n" in said
    assert said.count("apt-get") == 1
    assert said.endswith("Going on without it.\n")


def test_everything_is_asked_for_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(needs, "find_spec", lambda name: None)
    with pytest.raises(steps.StepFailed, match=r"cannot go on without python3\.\d+-venv; run the command above"):
        needs.provide(needs.for_demo())
    line = re.search(r"^  sudo apt-get install (.*)$", capsys.readouterr().out, re.MULTILINE)
    assert line is not None
    assert line[1].split() == [f"python3.{sys.version_info.minor}-venv", *needs.ORB_SLAM3_LIBRARIES]


def test_a_closed_engine_is_said_with_the_remedy(monkeypatch, capsys):
    monkeypatch.setattr(machine, "engine_trouble", lambda: CLOSED)
    needs.for_demo()
    assert "sudo usermod -aG docker $USER, then log in again. Going on without it." in capsys.readouterr().out


@pytest.fixture
def socket_of_systemd(monkeypatch, tmp_path):
    """A socket that is open although no engine answers there yet."""
    path = tmp_path / "docker.sock"
    monkeypatch.setenv("DOCKER_HOST", f"unix://{path}")
    monkeypatch.setattr(machine, "ASK_S", 0.05)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        yield listening


def test_an_engine_that_starts_is_waited_for(monkeypatch, socket_of_systemd):
    said: list[str] = []
    waits = threading.Event()

    def say(label: str, outcome: str) -> None:
        said.append(f"{label}: {outcome}")
        waits.set()

    def answer() -> None:
        waits.wait(30)
        while True:
            connection, _ = socket_of_systemd.accept()
            # The first two have closed their end by now, and one of them has asked nothing.
            with connection, contextlib.suppress(OSError):
                if connection.recv(1000):
                    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nOK")
                    return

    monkeypatch.setattr(machine, "say", say)
    engine = threading.Thread(target=answer)
    engine.start()
    assert engine_trouble() is None
    engine.join()
    assert len(said) == 1
    assert said[0].endswith("docker.sock but does not answer yet, waiting for it")


def test_an_engine_that_never_answers_is_named(monkeypatch, socket_of_systemd):
    monkeypatch.setattr(machine, "ENGINE_START_S", 0.05)
    trouble = engine_trouble()
    assert trouble is not None
    assert trouble.is_there
    assert trouble.problem.endswith("docker.sock takes connections but does not answer")


def engine_without_images(monkeypatch, problem: str | None) -> None:
    monkeypatch.setattr(machine, "engine_trouble", lambda: None)
    monkeypatch.setattr(machine, "has_image", lambda name: False)
    monkeypatch.setattr(machine, "pull", lambda name: problem)


def test_with_an_engine_nothing_needs_root_if_a_registry_answers(monkeypatch, capsys):
    engine_without_images(monkeypatch, None)
    assert needs.for_demo() == []
    needs.provide(needs.for_demo())
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("script", "packages"),
    [
        ("echo 'missing: mmdebstrap uidmap; sudo apt-get install mmdebstrap uidmap' >&2; exit 1", "mmdebstrap uidmap"),
        ("exit 0", ""),
    ],
)
def test_without_a_registry_the_base_needs_what_its_script_says(monkeypatch, tmp_path, script, packages):
    engine_without_images(monkeypatch, "no route to host")
    (tmp_path / "make-base.sh").write_text(script)
    monkeypatch.setattr(needs, "BASE_SCRIPT", tmp_path / "make-base.sh")
    found = needs.for_demo()
    assert " ".join(package for need in found for package in need.packages) == packages
    assert all(need.required for need in found)


def test_a_base_that_no_package_makes_possible_is_refused_with_the_reason(monkeypatch, tmp_path):
    engine_without_images(monkeypatch, "no route to host")
    (tmp_path / "make-base.sh").write_text("echo 'user namespaces are forbidden here' >&2; exit 1")
    monkeypatch.setattr(needs, "BASE_SCRIPT", tmp_path / "make-base.sh")
    with pytest.raises(steps.StepFailed, match="cannot be made: user namespaces are forbidden here"):
        needs.for_demo()


def test_the_tests_ask_for_what_the_named_tiers_need():
    asked = {package for need in needs.for_tests(["mysql"]) for package in need.packages}
    assert asked == set(needs.DATABASE_PACKAGES)
    assert needs.for_tests(["unit", "lint"]) == []
    everything = {package for need in needs.for_tests([]) for package in need.packages}
    assert {"docker.io", "debootstrap", "poppler-utils", "slurm-wlm", *needs.ORB_SLAM3_LIBRARIES} <= everything


def test_who_gets_an_engine_joins_its_group_in_the_same_line(capsys):
    needs.provide(needs.for_tests(["docker"]))
    said = capsys.readouterr().out
    assert re.search(r"^  sudo apt-get install .*docker\.io.* && sudo usermod -aG docker \$USER$", said, re.MULTILINE)
    assert "Then log in again" in said


def test_root_installs_what_is_missing(monkeypatch):
    installed: list[str] = []
    monkeypatch.setattr(machine, "can_install", lambda: True)
    monkeypatch.setattr(machine, "install", installed.extend)
    needs.provide(needs.for_demo())
    assert installed == list(needs.ORB_SLAM3_LIBRARIES)


@pytest.mark.parametrize(("answer", "runs"), [("", True), ("n", False)])
def test_who_sits_at_a_terminal_may_have_it_run(monkeypatch, capsys, answer, runs):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("needs.shutil.which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr("builtins.input", lambda prompt: answer)
    ran: list[list[str]] = []

    def run(command, **_):
        ran.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr("needs.subprocess.run", run)
    needs.provide(needs.for_demo())
    command = f"sudo apt-get install {' '.join(needs.ORB_SLAM3_LIBRARIES)}"
    assert ran == ([["/bin/sh", "-c", command]] if runs else [])
    assert ("Going on without it." in capsys.readouterr().out) is not runs


def test_nothing_is_installed_into_the_environment_before_it_is_asked(monkeypatch):
    order: list[str] = []
    monkeypatch.setattr(needs, "provide", lambda found: order.append("asked"))
    monkeypatch.setattr(bootstrap, "bootstrap", order.append)
    assert bootstrap.main(["test", "unit"]) == 0
    assert order == ["asked", "test"]


def test_the_libraries_are_those_of_the_package():
    package = parse((TOOLS.parent / "algorithms" / "orb-slam3" / "algorithm.yaml").read_text(), "algorithm.yaml")
    assert tuple(package["system_packages"]) == needs.ORB_SLAM3_LIBRARIES


def test_the_base_images_are_those_that_the_executor_takes():
    from slamhive.executors.docker.images import OWN_BASE, PUBLIC_BASE, SAME_AS_PUBLIC  # noqa: PLC0415 - Docker's SDK

    assert (PUBLIC_BASE, OWN_BASE, *SAME_AS_PUBLIC) == needs.BASE_IMAGES
