"""``slamhive completion``, and what it offers for commands, options and names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.web import web_world as world

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with a dataset and two runs."""
    folder = tmp_path_factory.mktemp("completion")
    hive = world.make_hive(folder)
    world.add_runs(hive, 2)
    hive.close()
    return folder / "data"


def offered(begun: str, *words: str) -> list[str]:
    made = ShellComplete(main, {}, "slamhive", "_SLAMHIVE_COMPLETE")
    return [item.value for item in made.get_completions(list(words), begun)]


def call(home: Path, *arguments: str, **environment: str | None) -> Result:
    clean = {"HOME": str(home), "XDG_DATA_HOME": None, "XDG_CONFIG_HOME": None, "SHELL": None}
    return CliRunner().invoke(main, ["completion", *arguments], env={**clean, **environment})


def test_commands_and_options_are_offered() -> None:
    assert offered("exp") == ["experiment"]
    assert offered("pl", "experiment") == ["plan"]
    assert "--executor" in offered("--", "experiment", "plan")


def test_commands_are_offered_without_loading_them() -> None:
    code = (
        "import sys; from click.shell_completion import ShellComplete; from slamhive.cli import main;"
        "print(len(ShellComplete(main, {}, 'slamhive', '_').get_completions([], '')),"
        "[name for name in sys.modules if name.startswith('slamhive.cli.exp')])"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    number, _, loaded = printed.partition(" ")
    assert int(number) > 20
    assert loaded == "[]\n"


def test_names_come_from_the_data_root_of_the_command_line(data: Path, tmp_path: Path) -> None:
    at = ("--data", str(data))
    assert offered("ro", *at, "dataset", "show") == ["room"]
    assert offered("", *at, "runs", "show") == ["2", "1"]
    assert offered("2", *at, "compare", "1") == ["2"]
    assert offered("no-such", *at, "dataset", "show") == []
    assert offered("", "--data", str(tmp_path / "absent"), "runs", "show") == []
    assert list(tmp_path.iterdir()) == []


def test_an_experiment_may_be_a_file(data: Path) -> None:
    made = ShellComplete(main, {}, "slamhive", "_SLAMHIVE_COMPLETE")
    (only,) = made.get_completions(["--data", str(data), "experiment", "status"], "docs/")
    assert only.type == "file"


@pytest.mark.parametrize(
    ("shell", "path"),
    [
        ("bash", ".local/share/bash-completion/completions/slamhive"),
        ("zsh", ".local/share/zsh/site-functions/_slamhive"),
        ("fish", ".config/fish/completions/slamhive.fish"),
    ],
)
def test_install_writes_where_the_shell_looks(tmp_path: Path, shell: str, path: str) -> None:
    result = call(tmp_path, "install", SHELL=f"/usr/bin/{shell}")
    assert result.exit_code == 0, result.output
    written = tmp_path / path
    assert result.stdout == f"{written}\n"
    assert written.read_text() == call(tmp_path, "show", shell).stdout
    assert "_SLAMHIVE_COMPLETE" in written.read_text()


def test_install_follows_the_folders_of_the_user(tmp_path: Path) -> None:
    call(tmp_path, "install", "bash", XDG_DATA_HOME=str(tmp_path / "share"))
    assert (tmp_path / "share" / "bash-completion" / "completions" / "slamhive").is_file()


@pytest.mark.parametrize(
    ("shell", "said"), [("/bin/dash", "SHELL is 'dash', which has no completion here"), (None, "SHELL is not set")]
)
def test_an_unknown_shell_is_one_line(tmp_path: Path, shell: str | None, said: str) -> None:
    result = call(tmp_path, "install", SHELL=shell)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith(f"error: {said}")
    assert list(tmp_path.iterdir()) == []


def test_bash_completes_with_the_installed_script(data: Path, tmp_path: Path) -> None:
    call(tmp_path, "install", "bash")
    script = tmp_path / ".local/share/bash-completion/completions/slamhive"
    program = Path(sys.executable).with_name("slamhive")
    words = f"COMP_WORDS=({program} --data '{data}' dataset show ro); COMP_CWORD=5"
    code = f"set -e; . '{script}'; {words}; _slamhive_completion '{program}'; echo \"${{COMPREPLY[@]}}\""
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=False, env=dict(os.environ))
    assert (done.stdout, done.stderr) == ("room\n", "")
