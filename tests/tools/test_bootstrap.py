"""``tools/bootstrap.py``: an environment is made once, and again only when its sources change."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

TOOLS = Path(__file__).resolve().parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

import bootstrap  # noqa: E402
import installer  # noqa: E402
import machine  # noqa: E402
import needs  # noqa: E402
import steps  # noqa: E402


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project folder whose environment seems to have been made for ``demo``."""
    monkeypatch.setattr(bootstrap, "ROOT", tmp_path)
    monkeypatch.setattr(bootstrap, "ENVIRONMENT", tmp_path / ".venv")
    monkeypatch.setattr(bootstrap, "STAMP", tmp_path / ".venv" / "stamp.json")
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python").symlink_to(sys.executable)
    bootstrap.STAMP.write_text(json.dumps({"fingerprint": bootstrap.fingerprint(), "extras": []}))
    return tmp_path


def test_unchanged_environment_lacks_nothing(project):
    assert bootstrap.missing_extras(()) == ()
    assert bootstrap.missing_extras(("dev",)) == ("dev",)


def test_changed_constraints_ask_for_a_new_environment(project):
    (project / "constraints.txt").write_text("numpy==1\n")
    assert bootstrap.missing_extras(()) is None


@pytest.mark.parametrize("damage", ["stamp", "python"])
def test_damaged_environment_is_made_anew(project, damage):
    path = bootstrap.STAMP if damage == "stamp" else bootstrap.ENVIRONMENT / "bin" / "python"
    path.unlink()
    assert bootstrap.missing_extras(()) is None


def test_used_again_without_installing(project, capsys, monkeypatch):
    monkeypatch.setattr(bootstrap, "install", lambda extras: pytest.fail("installed again"))
    monkeypatch.setattr(needs, "for_demo", list)
    assert bootstrap.main(["demo"]) == 0
    assert "used again" in capsys.readouterr().out


def test_without_venv_module_the_command_is_named(project, capsys, monkeypatch):
    bootstrap.STAMP.unlink()
    monkeypatch.setattr(needs, "find_spec", lambda name: None)
    monkeypatch.setattr(needs, "for_demo", needs.for_environment)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(machine, "can_install", lambda: False)
    assert bootstrap.main(["demo"]) == 1
    version = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    said = capsys.readouterr()
    assert f"sudo apt-get install {version}" in said.out
    assert f"cannot go on without {version}" in said.err


def test_failed_install_leaves_no_stamp(project, capsys, monkeypatch):
    def refuse(label, command, environment=None):
        raise steps.StepFailed("no network")

    (project / "constraints.txt").write_text("")
    monkeypatch.setattr(needs, "for_tests", lambda tiers: [])
    monkeypatch.setattr(bootstrap, "run_step", refuse)
    monkeypatch.setattr(installer, "run_step", refuse)
    assert bootstrap.main(["test"]) == 1
    assert not bootstrap.STAMP.exists()
    assert "no network" in capsys.readouterr().err


def test_uv_gets_the_configuration_of_pip():
    words, variables = installer.translated(
        [
            ("extra-index-url", "file:///a file:///b"),
            ("cert", "/ca.crt"),
            ("find-links", "/old"),
            ("find-links", "/new"),
            ("constraint", "/limits.txt"),
            ("retries", "3"),
            ("timeout", "60"),
        ]
    )
    assert words == [
        "--index",
        "file:///a",
        "--index",
        "file:///b",
        "--find-links",
        "/new",
        "--constraints",
        "/limits.txt",
    ]
    assert variables == {"SSL_CERT_FILE": "/ca.crt", "UV_HTTP_TIMEOUT": "60"}


def test_what_uv_cannot_follow_is_left_to_pip():
    with pytest.raises(installer.CannotFollow, match="proxy"):
        installer.translated([("proxy", "http://proxy:3128")])


@pytest.mark.integration  # asks pip
def test_variables_are_stronger_than_files(tmp_path):
    (tmp_path / "pip.conf").write_text(
        "[global]\ntimeout = 5\n[install]\ntimeout = 6\nretries = 2\n[list]\nformat = json\n"
    )
    environment = {"PIP_CONFIG_FILE": str(tmp_path / "pip.conf"), "PIP_RETRIES": "4", "HOME": str(tmp_path)}
    found = dict(installer.pip_configuration(sys.executable, environment))
    assert (found["timeout"], found["retries"]) == ("6", "4")
    assert "format" not in found


def test_pip_installs_what_uv_does_not(project, monkeypatch, capsys):
    (project / "constraints.txt").write_text("uv==0.0.0\n")
    ran = []

    def run(label, command, environment=None):
        ran.append([str(part) for part in command])
        if "uv" in Path(command[0]).name:
            raise steps.StepFailed("uv has no index")

    monkeypatch.setattr(installer, "run_step", run)
    monkeypatch.setattr(installer, "uv_command", lambda *_: nullcontext((["/tmp/uv", "pip", "install"], {})))
    installer.install("install", "python", ["x"], {}, project)
    assert ran == [["/tmp/uv", "pip", "install", "x"], ["python", "-m", "pip", "install", "--no-compile", "x"]]
    assert "trying pip (uv has no index)" in capsys.readouterr().out


def test_step_shows_the_end_of_the_output_when_it_fails():
    with pytest.raises(steps.StepFailed, match=r"(?s)dig failed \(exit code 3\).*the reason"):
        steps.run_step("dig", [sys.executable, "-c", "print('the reason'); raise SystemExit(3)"])


def test_step_names_a_program_that_is_not_there():
    with pytest.raises(steps.StepFailed, match="no-such-program cannot be started"):
        steps.run_step("dig", ["no-such-program"])


def test_finder_prefers_the_chosen_python():
    environment = {"PATH": "/usr/bin:/bin", "PYTHON": sys.executable}
    found = subprocess.run(
        ["sh", TOOLS / "find-python.sh"], check=True, capture_output=True, text=True, env=environment
    ).stdout.strip()
    assert Path(found).resolve() == Path(sys.executable).resolve()


def test_finder_passes_over_a_python_without_optimisation(tmp_path):
    for name, says in (("python3", "*ensurepip*) exit 1;; *) echo /slow;;"), ("python3.11", "*) echo /fast;;")):
        (tmp_path / name).write_text(f'#!/bin/sh\ncase "$*" in {says} esac\n')
        (tmp_path / name).chmod(0o755)
    command = ["/bin/sh", str(TOOLS / "find-python.sh")]
    found = subprocess.run(command, check=True, capture_output=True, text=True, env={"PATH": str(tmp_path)})
    assert found.stdout == "/fast\n"
    chosen = {"PATH": str(tmp_path), "PYTHON": "python3"}
    found = subprocess.run(command, check=True, capture_output=True, text=True, env=chosen)
    assert found.stdout == "/slow\n"


def test_every_pinned_version_is_for_the_oldest_python():
    """Debian 12 has 3.11.2, so 3.11.5 is asking too much."""
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)", (TOOLS.parent / "constraints.txt").read_text(), re.MULTILINE))
    installed = {found.name.lower().replace("_", "-"): found for found in distributions()}
    asked = {name: str(installed[name].metadata["Requires-Python"]) for name in pins if name in installed}
    asked = {name: needs for name, needs in asked.items() if needs != "None"}
    assert len(asked) > 100
    too_new = [f"{name}: {needs}" for name, needs in asked.items() if not SpecifierSet(needs).contains("3.11.0")]
    assert too_new == []


def test_no_file_names_a_package_index():
    root = TOOLS.parent
    for name in ("constraints.txt", "pyproject.toml", "Makefile", "docker/install.sh", "tools/bootstrap.py"):
        text = (root / name).read_text()
        assert "index-url" not in text.replace("-index-url=$", "")
        assert "pypi.org" not in text
