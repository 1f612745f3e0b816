"""``slamhive completion``: the shell completes commands, options and names."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from slamhive.cli.groups import LazyGroup
from slamhive.cli.output import tell
from slamhive.cli.visible import say, write_out
from slamhive.errors import InvalidInput, Unavailable
from slamhive.files import write_aside

PROGRAM = "slamhive"
_VARIABLE = "_SLAMHIVE_COMPLETE"


@dataclass(frozen=True, slots=True)
class Shell:
    """Where a shell looks for completions.

    ``variable`` names the folder of the user's files, ``default`` is that folder below the home. ``next_step`` is what
    is left to do after the script is there.
    """

    variable: str
    default: str
    file: str
    next_step: str

    def path(self, environment: Mapping[str, str], home: Path) -> Path:
        """The file from which the shell loads the completion of this program."""
        given = environment.get(self.variable, "")
        root = Path(given) if Path(given).is_absolute() else home / self.default  # the XDG rule for relative values
        return root / self.file


SHELLS = {
    "bash": Shell(
        "XDG_DATA_HOME",
        ".local/share",
        f"bash-completion/completions/{PROGRAM}",
        "it works in new shells if the package bash-completion is installed; otherwise add to ~/.bashrc: . '{path}'",
    ),
    "zsh": Shell(
        "XDG_DATA_HOME",
        ".local/share",
        f"zsh/site-functions/_{PROGRAM}",
        "add to ~/.zshrc, before compinit: fpath+=('{folder}')",
    ),
    "fish": Shell("XDG_CONFIG_HOME", ".config", f"fish/completions/{PROGRAM}.fish", "it works in new shells"),
}

_shell_argument = click.argument("shell", type=click.Choice(list(SHELLS)), required=False)


@click.group(cls=LazyGroup)
def completion() -> None:
    """Complete commands, options and names with Tab, in bash, zsh or fish."""


@completion.command()
@_shell_argument
def install(shell: str | None) -> None:
    """Write the completion of SHELL (default: your login shell) to where it looks for it."""
    shell = shell or _login_shell()
    path = SHELLS[shell].path(os.environ, Path.home())
    script = _script(shell)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, script)
    except OSError as error:
        raise Unavailable(
            f"{path} cannot be written: {error.strerror}", f"slamhive completion show {shell} prints the script"
        ) from None
    say(path)
    tell(SHELLS[shell].next_step.format(path=path, folder=path.parent))


@completion.command()
@_shell_argument
def show(shell: str | None) -> None:
    """Print the completion script of SHELL (default: your login shell)."""
    write_out(_script(shell or _login_shell()))


def _login_shell() -> str:
    name = Path(os.environ.get("SHELL", "")).name
    if name not in SHELLS:
        known = ", ".join(SHELLS)
        found = f"SHELL is {name!r}" if name else "SHELL is not set"
        raise InvalidInput(f"{found}, which has no completion here", f"name one of {known}")
    return name


def _script(shell: str) -> str:
    """The script of ``shell``. It asks this program for names at each Tab."""
    kind = get_completion_class(shell)
    if kind is None:
        raise Unavailable(f"click {click.__version__} has no completion for {shell}", "use another shell")
    return kind(click.Command(PROGRAM), {}, PROGRAM, _VARIABLE).source()


COMMANDS = (completion,)
