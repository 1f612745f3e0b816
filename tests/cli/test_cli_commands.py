"""How the root command finds its commands."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import click

from slamhive import cli
from slamhive.cli import main
from slamhive.cli.groups import LazyGroup
from slamhive.cli.main import MODULES


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


def test_the_version_is_printed_without_importing_what_commands_need():
    code = (
        "import sys; from slamhive.cli import main; main(['--version'], standalone_mode=False); "
        "print([name for name in ('sqlalchemy', 'pydantic', 'numpy', 'rich') if name in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert ended.stdout.splitlines()[-1] == "[]"
