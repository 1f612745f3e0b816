"""``slamhive completion``: the shell completes commands, options and names."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import click
from click.shell_completion import CompletionItem, get_completion_class

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.cli.main import LazyGroup
from slamhive.cli.output import tell
from slamhive.cli.visible import say, visible_line, write_out
from slamhive.domain.names import plural

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

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


@completion.command(short_help="Write the completion of SHELL (default: your login shell)")
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


# The names that the shell offers for the arguments of commands.


Offer: TypeAlias = tuple[str, str]
"""A name, and the words beside it in shells that show them."""
Completion: TypeAlias = Callable[[click.Context, click.Parameter, str], list[CompletionItem[str]]]

_LATEST_RUNS = 30


def _runs(hive: Hive) -> Iterable[Offer]:
    latest = hive.stored_runs.page(limit=_LATEST_RUNS).records
    return ((str(run.id), f"{run.algorithm} on {run.dataset}, {run.state.value}") for run in latest)


def _completion_of(names: Callable[[Hive], Iterable[Offer]], *, or_file: bool = False) -> Completion:
    """Complete an argument by the names that begin so; ``or_file`` offers files where no name does."""

    def complete(context: click.Context, _: click.Parameter, begun: str) -> list[CompletionItem[str]]:
        found = [
            CompletionItem(name, help=visible_line(words))
            for name, words in _read(context, names)
            if name.startswith(begun) and name == visible_line(name)  # the shell prints it, and takes it as it is
        ]
        return found if found or not or_file else [CompletionItem(begun, type="file")]

    return complete


def _read(context: click.Context, names: Callable[[Hive], Iterable[Offer]]) -> list[Offer]:
    """The names in the data root of the command line. A data root that cannot be read has none: Tab prints no error."""
    from slamhive.services.data_root import DataRoot  # noqa: PLC0415 - only completion needs them here
    from slamhive.services.hive import open_hive  # noqa: PLC0415

    options = {key: value for key, value in context.find_root().params.items() if key in ("data", "database_url")}
    try:
        hive = open_hive(options, DataRoot.OPTIONAL)
        try:
            return list(names(hive))
        finally:
            hive.close()
    except SlamHiveError:
        return []


ANALYSIS = _completion_of(lambda hive: ((entry.token, entry.name) for entry in hive.stored_analyses.listed()))
ALGORITHM = _completion_of(lambda hive: ((entry.name, entry.title) for entry in hive.catalogue.algorithms()))
PACKAGE = _completion_of(lambda hive: ((entry.name, entry.title) for entry in hive.catalogue.packages()))
DATASET = _completion_of(
    lambda hive: ((entry.name, f"{entry.duration_s:.1f} s") for entry in hive.catalogue.datasets())
)
EXPERIMENT = _completion_of(
    lambda hive: ((entry.name, entry.state.value) for entry in hive.experiments.list()), or_file=True
)
BASELINE = _completion_of(
    lambda hive: ((entry.name, plural(entry.runs, "run")) for entry in hive.gates.baselines.briefs()), or_file=True
)
CLAIMS = _completion_of(lambda hive: ((entry.name, entry.title) for entry in hive.claims.all()))
CHALLENGE = _completion_of(lambda hive: ((entry.name, entry.title) for entry in hive.challenges.briefs()))
SEARCH = _completion_of(lambda hive: ((entry.name, entry.filter_text) for entry in hive.searches.saved()))
RUN = _completion_of(_runs)


COMMANDS = (completion,)
