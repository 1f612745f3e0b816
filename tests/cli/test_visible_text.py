"""Text of others on the terminal: what would steer it is shown instead, whatever command prints it."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.cli.output import print_error, print_json, print_table, progress_bar, tell
from slamhive.cli.visible import VisibleFormatter, say, visible, visible_line, write_out
from slamhive.domain.run import FailureReason, RunState
from slamhive.services.hive import Hive, open_hive
from slamhive.store import Transaction
from tests.services.tiny_project import environment, make_dataset, make_project

HOSTILE = "a\x1b]0;title\x07b\x1b[2Kc\rd\x9b31me\u202egpj\u2066f\x00g\x7fh\x08"
SHOWN = r"a\x1b]0;title\x07b\x1b[2Kc\rd\x9b31me\u202egpj\u2066f\x00g\x7fh\x08"
STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
NOW = datetime(2026, 5, 4, tzinfo=UTC)

Call = Callable[..., Result]


def test_what_steers_a_terminal_is_shown_and_the_rest_stays():
    assert visible(HOSTILE) == SHOWN
    assert visible("tab\tand\r\nlines\n, ÄÖ 漢字 🤖 \u200d") == "tab\tand\nlines\n, ÄÖ 漢字 🤖 \u200d"
    assert visible_line("tab\tand\r\nlines") == r"tab\tand\nlines"
    assert visible("\udc80\U000e0041\u2028") == r"\udc80\U000e0041\u2028"


def test_json_says_the_same_without_steering_the_terminal(capsys: pytest.CaptureFixture[str]):
    content = {HOSTILE: [HOSTILE, "\U000e0041\udc80", "ÄÖ\n"]}
    print_json(content)
    printed = capsys.readouterr().out
    assert not STEERING.search(printed)
    assert "ÄÖ" in printed
    assert json.loads(printed) == content


def test_every_way_to_print_shows_it(capsys: pytest.CaptureFixture[str]):
    say(HOSTILE)
    tell(HOSTILE)
    print_error(HOSTILE, [HOSTILE, "^"])
    print_table(("name", "note"), [(HOSTILE, f"{HOSTILE}\nanother line")])
    with progress_bar(HOSTILE) as show:
        show(1.0, f"[red]{HOSTILE}")
    found = capsys.readouterr()
    for text in (found.out, found.err):
        assert SHOWN in text
        assert not STEERING.search(text)
    assert f"[red]{SHOWN}" in found.err
    assert rf"{SHOWN}\nanother line" in found.out


def test_a_logged_line_and_a_traceback_show_it():
    record = logging.LogRecord("name", logging.ERROR, "", 1, "failed: %s", (HOSTILE,), None)
    assert VisibleFormatter("%(message)s").format(record) == f"failed: {SHOWN}"


def test_files_for_programs_are_unchanged_unless_a_terminal_shows_them(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    write_out(f"{HOSTILE},1\r\n")
    assert capsys.readouterr().out == f"{HOSTILE},1\r\n"
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    write_out(f"{HOSTILE},1\r\n")
    assert capsys.readouterr().out == f"{SHOWN},1\n"


@pytest.fixture
def slamhive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Call:
    """The command line in a project with a failed run of an algorithm that is out to steer terminals."""
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)

    def call(*arguments: str) -> Result:
        return CliRunner().invoke(main, arguments)

    assert call("run", "tiny", "track").exit_code == 0
    hive = open_hive({})
    fail(hive)
    hive.close()
    another = tmp_path / "data" / "datasets" / "another"
    another.mkdir()
    (another / "dataset.yaml").write_text(f"format: 1\nname: another\n{HOSTILE}: [1, 2\n")
    return call


def fail(hive: Hive) -> None:
    def work(transaction: Transaction) -> None:
        for state in (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING):
            transaction.runs.move(1, state, why=HOSTILE, now=NOW)
        transaction.runs.move(
            1, RunState.FAILED, why=HOSTILE, now=NOW, reason=FailureReason.NO_TRAJECTORY, detail=HOSTILE, poses=0
        )

    hive.store.write(work)
    folder = hive.runs.folder(1)
    folder.create()
    folder.log.write_text(f"line\twith tab\r\n{HOSTILE}\n")
    folder.write_record({"match": {}, "software": HOSTILE, "host": {HOSTILE: HOSTILE}})


COMMANDS = [
    ("runs",),
    ("runs", "show", "1"),
    ("runs", "show", "1", "--json"),
    ("runs", "--json"),
    ("runs", "log", "1"),
    ("dataset", "list"),
    ("-v", "dataset", "list", "--json"),
    pytest.param(("doctor",), marks=pytest.mark.integration),
]


@pytest.mark.quick
@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_passes_it_on(slamhive: Call, command: tuple[str, ...]):
    done = slamhive(*command)
    assert done.exit_code == 0 or command == ("doctor",)  # which finds no worker
    assert not STEERING.search(done.output)
    if command[0] == "runs":
        assert SHOWN in done.output or json.dumps(HOSTILE)[1:12] in done.output


@pytest.mark.quick
@pytest.mark.parametrize(
    "command", [("runs", "show", HOSTILE), ("run", HOSTILE, "track"), ("dataset", "show", "another")]
)
def test_no_error_passes_it_on(slamhive: Call, command: tuple[str, ...]):
    done = slamhive(*command)
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    assert not STEERING.search(done.stderr)


@pytest.mark.quick
def test_the_log_is_raw_for_those_who_want_it(slamhive: Call):
    assert slamhive("runs", "log", "1").stdout == f"line\twith tab\n{SHOWN}\n"
    assert slamhive("runs", "log", "1", "--raw").stdout_bytes == f"line\twith tab\r\n{HOSTILE}\n".encode()
