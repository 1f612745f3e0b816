"""Commands that a user types as root have ``sudo``, wherever a message names them."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path

import pytest

from slamhive.base.debian import as_root, find_program, install_command

ROOT = Path(__file__).resolve().parents[2]
INSTALLS = re.compile(r"\bapt(-get)?\b.* install\b")
RUNS_AS_ROOT = {"slamhive/executors/docker/foreign_images.py"}
"""Scripts that root of an image runs, and no user."""


@pytest.mark.parametrize(("uid", "begins"), [(0, "apt-get"), (1000, "sudo apt-get")])
def test_only_root_needs_no_sudo(monkeypatch, uid, begins):
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    assert install_command(["a", "b"]) == f"{begins} install a b"
    assert as_root("true") == begins.replace("apt-get", "true")


def test_programs_of_the_administrator_are_found_without_their_folders_in_the_path(monkeypatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    assert find_program("ldconfig") in {"/usr/sbin/ldconfig", "/sbin/ldconfig"}
    assert find_program("no-such-program") is None


def test_messages_take_the_command_from_one_place():
    """No text of the code says ``apt-get install``, but what runs as root by itself."""
    found = []
    for folder in ("slamhive", "tools", "algorithms", "docker"):
        for path in (ROOT / folder).rglob("*.py"):
            name = str(path.relative_to(ROOT))
            if name in RUNS_AS_ROOT or name == "slamhive/base/debian.py":
                continue
            text = path.read_text(encoding="utf-8")
            if "install" not in text or "apt" not in text:
                continue
            tree = ast.parse(text)
            texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
            found += [f"{name}: {text}" for text in texts if isinstance(text, str) and INSTALLS.search(text)]
    assert found == []


def test_messages_of_scripts_have_sudo():
    found = []
    for path in [ROOT / "tools" / "find-python.sh", *(ROOT / "docker").rglob("*.sh")]:
        for line in path.read_text(encoding="utf-8").splitlines():
            says = re.match(r"\s*(echo|stop|printf)\b", line) or "|| stop" in line
            if says and INSTALLS.search(line) and not re.search(r"(sudo |\$\{sudo\})apt-get", line):
                found.append(f"{path.name}: {line}")
    assert found == []
