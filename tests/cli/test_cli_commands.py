"""How the root command finds its commands."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import click
import pytest
from click.testing import CliRunner

from slamhive import cli
from slamhive.cli import main
from slamhive.cli.main import MODULES, SECTIONS, LazyGroup


def test_every_command_of_every_module_is_found():
    modules = [import_module(f"slamhive.cli.{entry.name}") for entry in iter_modules(cli.__path__)]
    found = {
        (command.name, module.__name__.rpartition(".")[2])
        for module in modules
        for command in getattr(module, "COMMANDS", ())
    }
    groups = (value for module in modules for value in vars(module).values() if isinstance(value, LazyGroup))
    assert found == set(MODULES.items()).union(*(group.modules.items() for group in groups))
    assert main.get_command(click.Context(main), "no-such-command") is None


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_what_needs_no_command_imports_none(option):
    code = (
        "import sys; from slamhive.cli import main; main(sys.argv[1:], standalone_mode=False); "
        "heavy = ('sqlalchemy', 'pydantic', 'numpy', 'rich', 'slamhive.cli.runs'); "
        "print([name for name in heavy if name in sys.modules])"
    )
    command = [sys.executable, "-c", code, option]
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert ended.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("columns", [80, 200])
def test_the_help_has_one_whole_line_for_each_command_below_what_people_do(columns):
    printed = CliRunner().invoke(main, ["--help"], terminal_width=columns).output.splitlines()
    listed = printed[printed.index("Start here:") :]
    assert max(map(len, listed)) <= 80
    assert [line.removesuffix(":") for line in listed if line and not line.startswith(" ")] == list(SECTIONS)
    entries = [line.strip().partition(" ") for line in listed if line.startswith(" ")]
    assert {name: said.strip() for name, _, said in entries} == {
        name: line for section in SECTIONS.values() for name, (_, line) in section.items()
    }
    assert len(entries) == len(MODULES)
    assert not [line for line in listed if "..." in line]
