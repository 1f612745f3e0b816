"""``deploy/systemd/``: systemd accepts the units, and ``docs/server.md`` describes each of their options."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import click
import pytest

from slamhive.base.debian import find_program
from slamhive.base.settings_sources import describe
from slamhive.cli import main
from slamhive.executors.process.cgroup_home import LEAF
from slamhive.executors.registry import declared_settings

ROOT = Path(__file__).resolve().parents[2]
UNITS = ROOT / "deploy" / "systemd"
PAGE = ROOT / "docs" / "server.md"
EXPOSURE = {"slamhive-worker": 60, "slamhive-web": 30}
"""The most that ``systemd-analyze security`` may say, in tenths. A service without any hardening has 96."""
NAMES = ("slamhive-worker", "slamhive-web")
IGNORED_BEFORE_254 = re.compile(r"Unknown key (name )?'DelegateSubgroup' in section '?\[?Service\]?'?, ignoring")

Unit = list[tuple[str, str]]


def service_of(kind: str, name: str) -> Unit:
    """The options of the section ``[Service]``."""
    text = (UNITS / kind / f"{name}.service").read_text()
    section = text.partition("[Service]\n")[2].partition("\n[")[0]
    lines = [line for line in section.splitlines() if line and not line.startswith("#")]
    return [(line.partition("=")[0], line.partition("=")[2]) for line in lines]


def documented() -> dict[str, tuple[bool, bool]]:
    """{option: (of the worker, of the web server)} in the table of the page."""
    rows = re.findall(r"^\| `([^`]+=[^`]*)` \| (yes|no) \| (yes|no) \|", PAGE.read_text(), re.MULTILINE)
    assert len(rows) == len({option for option, *_ in rows})
    return {option: (worker == "yes", web == "yes") for option, worker, web in rows}


@pytest.mark.parametrize("name", NAMES)
def test_the_page_names_each_option_of_the_system_units(name):
    has = {f"{key}={value}" for key, value in service_of("system", name) if key != "ExecStart"}
    says = {option for option, units in documented().items() if units[NAMES.index(name)]}
    assert has == says


@pytest.mark.parametrize("name", NAMES)
def test_a_user_has_the_same_options_for_runs_and_restarts(name):
    system, user = set(service_of("system", name)), set(service_of("user", name))
    assert {key for key, _ in user - system} == {"EnvironmentFile", "ExecStart"}


@pytest.mark.parametrize("kind", ["system", "user"])
def test_the_worker_may_make_groups_and_leaves_runs_alive(kind):
    options = dict(service_of(kind, "slamhive-worker"))
    assert set(options["Delegate"].split()) >= {"pids", "memory", "cpu"}
    assert options["KillMode"] == "process"
    assert options["DelegateSubgroup"] == LEAF
    assert options["OOMPolicy"] == "continue"
    assert options["NoNewPrivileges"] == "yes"


@pytest.mark.parametrize("kind", ["system", "user"])
def test_the_commands_are_those_of_slamhive(kind):
    for name in NAMES:
        program, command, *options = shlex.split(dict(service_of(kind, name))["ExecStart"])
        assert program.endswith("/.venv/bin/slamhive")
        found = main.get_command(click.Context(main), command)
        assert found is not None
        known = {spelling for entry in found.params for spelling in (*entry.opts, *entry.secondary_opts)}
        assert set(options) <= known


def test_the_example_names_settings():
    known = {f"SLAMHIVE_{entry.name}" for entry in describe(declared_settings())}
    names = set(re.findall(r"^# (SLAMHIVE_\w+)=", (UNITS / "slamhive.env.example").read_text(), re.MULTILINE))
    assert names
    assert names <= known


@pytest.fixture
def machine_root(tmp_path: Path) -> Path:
    """The files of a machine on which the units are installed."""
    units = tmp_path / "etc" / "systemd" / "system"
    units.mkdir(parents=True)
    for name in NAMES:
        (units / f"{name}.service").write_text((UNITS / "system" / f"{name}.service").read_text())
    # What they are ordered after; systemd's own.
    for name in ("network-online", "multi-user", "sysinit", "basic", "shutdown"):
        (units / f"{name}.target").write_text("[Unit]\nDefaultDependencies=no\n")
    (units / "system.slice").write_text("[Unit]\nDefaultDependencies=no\n")
    (units / "-.mount").write_text("[Unit]\nDefaultDependencies=no\n[Mount]\nWhat=/dev/vda\nWhere=/\n")
    program: Path = tmp_path / "opt" / "slamhive" / ".venv" / "bin" / "slamhive"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    (tmp_path / "opt" / "slamhive" / "docs").mkdir()
    (tmp_path / "opt" / "slamhive" / "docs" / "server.md").touch()
    return tmp_path


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    if find_program("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed; it is in the package systemd")
    return subprocess.run(
        ["systemd-analyze", *map(str, arguments)], check=False, capture_output=True, text=True, timeout=60
    )


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_systemd_accepts_the_units(machine_root, name):
    checked = analyze("verify", "--man=no", "--recursive-errors=no", f"--root={machine_root}", f"{name}.service")
    said = (checked.stdout + checked.stderr).splitlines()
    ignored = [line for line in said if IGNORED_BEFORE_254.search(line)]
    assert said == ignored
    assert (checked.returncode == 0) == (not ignored)


@pytest.mark.integration
def test_systemd_names_a_mistake(machine_root):
    """So that the test above cannot pass because nothing is checked."""
    unit = machine_root / "etc" / "systemd" / "system" / "slamhive-web.service"
    unit.write_text(unit.read_text().replace("PrivateTmp=yes", "PrivateTemp=yes"))
    checked = analyze("verify", "--man=no", "--recursive-errors=no", f"--root={machine_root}", "slamhive-web.service")
    assert re.search(r"Unknown key (name )?'PrivateTemp'", checked.stderr)


@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_the_units_are_hardened(machine_root, name):
    unit = machine_root / "etc" / "systemd" / "system" / f"{name}.service"
    checked = analyze("security", "--offline=yes", f"--threshold={EXPOSURE[name]}", "--no-pager", unit)
    assert checked.returncode == 0, checked.stdout + checked.stderr
