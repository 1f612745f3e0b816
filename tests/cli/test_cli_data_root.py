"""Which commands make a data root, and what the others say where there is none."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from sqlalchemy import event

from slamhive.base.errors import NotFound, SlamHiveError
from slamhive.cli.acting import EXPECTED, LISTS
from slamhive.cli.main import REGISTRY, main
from slamhive.services.data_root import DataRoot
from slamhive.services.hive import open_hive
from slamhive.store import AbsentStore, Store
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.quick

NO_HIVE = {"settings", "archive verify", "completion install", "completion show", "variants steps"}
"""Commands that never look at the installation."""


def leaves(command: click.Command, name: str = "") -> Iterator[tuple[str, click.Command]]:
    """Every command that can be given, with its name; a group counts if it does something by itself."""
    if not isinstance(command, click.Group) or (command.invoke_without_command and name):
        yield name, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for part in command.list_commands(context):
            below = command.get_command(context, part)
            assert below is not None
            yield from leaves(below, f"{name} {part}".strip())


def mistake_of(name: str) -> int:
    """The exit code of a mistake: 1 is an answer of gates, claims and replays."""
    return 2 if name.startswith(("gate ", "claims ")) or name == "replay" else 1


COMMANDS = dict(leaves(main))
READING = sorted(set(COMMANDS) - set(EXPECTED) - NO_HIVE)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_project(tmp_path / "project")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    return tmp_path


def call(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments)


def arguments_of(name: str) -> list[str]:
    """The command with arguments that its parser takes."""
    given = name.split()
    for parameter in COMMANDS[name].params:
        if not parameter.required and not (isinstance(parameter, click.Argument) and parameter.nargs == -1):
            continue
        kind = parameter.type
        value = "1"
        if isinstance(kind, click.Path):
            value = __file__ if kind.file_okay else str(Path(__file__).parent)
        if isinstance(kind, click.Choice):
            value = str(next(iter(kind.choices)))
        if parameter.name == "yes":
            continue
        given += [value] if isinstance(parameter, click.Argument) else [parameter.opts[0], value]
    return [*given, *(["--yes"] if any(parameter.name == "yes" for parameter in COMMANDS[name].params) else [])]


def test_every_command_of_the_table_exists():
    assert set(EXPECTED) <= set(COMMANDS)
    assert set(COMMANDS) >= NO_HIVE
    assert len(READING) > 25


@pytest.mark.parametrize("name", READING)
def test_a_command_that_reads_makes_nothing_where_nothing_is(project: Path, name: str):
    wrong = project / "wrong"
    result = call("--data", str(wrong), *arguments_of(name))
    assert result.exit_code == mistake_of(name), result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert f"data root {wrong} does not exist; name another with --data or SLAMHIVE_DATA" in line, line
    assert not wrong.exists()


@pytest.mark.parametrize("name", ["runs", "dataset list", "search list", "experiment list"])
def test_a_folder_without_a_database_is_left_as_it_is(project: Path, name: str):
    folder = project / "somebody"
    folder.mkdir()
    (folder / "letter.txt").write_text("mine")
    result = call("--data", str(folder), *name.split())
    assert result.exit_code == 1
    assert f"there is no database sqlite {folder}/slamhive.db yet; slamhive reindex makes one" in result.stderr
    assert [path.name for path in folder.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize("name", sorted(name for name, root in EXPECTED.items() if root is DataRoot.FOUND))
def test_a_command_that_needs_what_lies_there_makes_no_data_root(project: Path, name: str):
    result = call("--data", str(project / "wrong"), *arguments_of(name))
    assert result.exit_code == mistake_of(name)
    assert "does not exist" in result.stderr
    assert not (project / "wrong").exists()


@pytest.mark.parametrize("name", ["algorithm list", "algorithm show tiny", "doctor --all"])
def test_what_needs_no_data_root_works_without_and_makes_none(project: Path, name: str):
    result = call("--data", str(project / "wrong"), *name.split())
    assert "tiny" in result.stdout, result.output
    assert not (project / "wrong").exists()


@pytest.mark.integration
def test_doctor_tells_what_is_missing(project: Path):
    checks = {
        check["name"]: check for check in json.loads(call("--data", str(project / "wrong"), "doctor", "--json").stdout)
    }
    for name in ("data root", "database"):
        assert (checks[name]["verdict"], "does not exist" in checks[name]["found"]) == ("warning", True)


def test_a_file_is_no_data_root(project: Path):
    (project / "wrong").write_text("mine")
    assert "is not a folder" in call("--data", str(project / "wrong"), "runs").stderr


def test_a_path_that_no_system_takes_is_explained(project: Path):
    result = call("--data", f"{project}/{'x' * 5000}", "runs")
    assert result.exit_code == 1
    assert "cannot be used: File name too long" in result.stderr


@pytest.mark.integration
def test_rendering_makes_the_data_root_and_reading_finds_it(project: Path):
    made = call("--data", str(project / "new"), "dataset", "room", "--name", "r", "--seconds", "0.5")
    assert made.exit_code == 0, made.output
    assert "r" in call("--data", str(project / "new"), "dataset", "list").stdout


@pytest.mark.integration
def test_running_makes_the_database_of_a_data_root_that_has_none(project: Path):
    make_dataset(project / "data")
    assert call("run", "tiny", "track").exit_code == 0
    assert "1 of 1 run" in call("runs").stderr


@pytest.mark.integration
def test_reindex_makes_the_database_again(project: Path):
    make_dataset(project / "data")
    assert call("run", "tiny", "track").exit_code == 0
    (project / "data" / "slamhive.db").unlink()
    assert "slamhive reindex restores them" in call("runs").stderr
    assert call("reindex").exit_code == 0
    assert call("runs").exit_code == 0


@pytest.mark.parametrize("expected", list(DataRoot))
def test_a_server_that_only_shows_makes_nothing(project: Path, monkeypatch: pytest.MonkeyPatch, expected: DataRoot):
    monkeypatch.setenv("SLAMHIVE_MODE", "view-only")
    monkeypatch.setenv("SLAMHIVE_DATA", str(project / "wrong"))
    if expected is DataRoot.OPTIONAL:
        hive = open_hive(data_root=expected)
        assert isinstance(hive.store, AbsentStore)
        with pytest.raises(NotFound, match="does not exist"):
            hive.runs.counts()
        hive.close()
    else:
        with pytest.raises(SlamHiveError, match="does not exist"):
            open_hive(data_root=expected)
    result = call("serve", "--port", "0")
    assert result.exit_code == 1
    assert "does not exist" in result.stderr
    assert not (project / "wrong").exists()


def test_a_command_leaves_as_it_was_what_is_logged(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLAMHIVE_MODE", "view-only")
    monkeypatch.setenv("SLAMHIVE_DATA", str(project / "wrong"))
    loggers = [logging.getLogger(name) for name in ("slamhive", REGISTRY)]
    for logger in loggers:
        monkeypatch.setattr(logger, "level", logging.DEBUG)
    assert "does not exist" in call("serve", "--port", "0").stderr
    assert [logger.level for logger in loggers] == [logging.DEBUG, logging.DEBUG]


def test_a_server_that_only_shows_makes_no_folder_that_is_missing(project: Path, monkeypatch: pytest.MonkeyPatch):
    make_dataset(project / "data")
    assert call("runs").exit_code == 0
    shutil.rmtree(project / "data" / "runs")
    monkeypatch.setenv("SLAMHIVE_MODE", "view-only")
    assert call("runs").exit_code == 0
    assert not (project / "data" / "runs").exists()


def test_commands_that_list_are_commands() -> None:
    assert set(COMMANDS) >= LISTS


@pytest.mark.parametrize("name", ["runs", "configuration list", "experiment list"])
def test_a_command_that_lists_reads_in_one_transaction(
    project: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    open_hive().close()
    begun: list[object] = []
    begin_snapshot = Store.snapshot

    def counted(store: Store) -> AbstractContextManager[None]:
        event.listen(store.engine, "begin", begun.append)
        return begin_snapshot(store)

    monkeypatch.setattr(Store, "snapshot", counted)
    result = call(*name.split())
    assert result.exit_code == 0, result.output
    assert len(begun) == 1
