"""The root command: its options, how it finds commands, and how it reports mistakes."""

from __future__ import annotations

import functools
import gc
import logging
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from slamhive import __version__
from slamhive.base.bounds import check_text
from slamhive.cli.context import CliContext
from slamhive.cli.visible import VisibleFormatter, mistakes_end_with

# Groups of commands that import the module of a command only when it is used.


class LazyGroup(click.Group):
    """A group of commands.

    Args:
        modules: {command: module of :mod:`slamhive.cli` that has it in ``COMMANDS``}. Importing all takes a second.
        more: What a click.Group takes.
    """

    def __init__(self, *args: Any, modules: Mapping[str, str] | None = None, **more: Any) -> None:
        super().__init__(*args, **more)
        self.modules = dict(modules or {})

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names of all commands."""
        return sorted({*super().list_commands(ctx), *self.modules})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name; its module is imported now."""
        if cmd_name not in self.modules:
            return super().get_command(ctx, cmd_name)
        commands: tuple[click.Command, ...] = import_module(f"slamhive.cli.{self.modules[cmd_name]}").COMMANDS
        return next(command for command in commands if command.name == cmd_name)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem[str]]:
        """Commands and options that begin so; commands without their help, which would import all modules."""
        names = [CompletionItem(name) for name in self.list_commands(ctx) if name.startswith(incomplete)]
        return [*names, *click.Command.shell_complete(self, ctx, incomplete)]


SECTIONS = {
    "Start here": {
        "demo": ("serving", "Run three SLAM systems on a rendered room, show the results"),
        "doctor": ("maintenance", "Say whether this machine can start, and how to fix the rest"),
        "serve": ("serving", "Show everything on web pages, and work on the queue"),
        "completion": ("completion", "Let Tab complete commands and names in bash, zsh and fish"),
    },
    "Data and algorithms": {
        "dataset": ("datasets", "Fetch, import, check, export, render and show datasets"),
        "variants": ("variants", "Make and remove degraded or cut copies of datasets"),
        "algorithm": ("algorithms", "List, show, import, build and test algorithms"),
        "find": ("searching", "Find anything that has these words in its name or text"),
    },
    "Runs and experiments": {
        "run": ("running", "Run one algorithm on one dataset"),
        "runs": ("runs", "List runs by a filter; show, retry, tag and delete them"),
        "search": ("searching", "Save a filter of `runs` under a name"),
        "experiment": ("experiments", "Run many configurations from one file, and report on them"),
        "configuration": ("configurations", "Name, group, export and import configurations"),
        "evaluate": ("evaluate", "Compute the errors of runs, under any protocol"),
        "protocol": ("evaluate", "List, compare and choose protocols of evaluations"),
    },
    "Results": {
        "compare": ("compare", "Show what differs between some runs, side by side"),
        "gate": ("gates", "Fail in CI when runs became worse; find the commit"),
        "claims": ("gates", "Say which numbers of a paper or README hold here"),
        "replay": ("archive", "Run an archive again here, and say if the results agree"),
        "analyse": ("analyses", "Draw plots and tables from an analysis file"),
        "analyses": ("analyses", "List, share and delete the analyses of the web pages"),
    },
    "Share": {
        "archive": ("archive", "Export runs to a file, check and import it, publish a site"),
        "cite": ("cite", "Print BibTeX of everything that runs or an experiment used"),
        "challenge": ("challenges", "Hold a competition whose ground truth is secret"),
    },
    "Machines": {
        "worker": ("serving", "Execute what is queued, on this machine or a cluster"),
        "nodes": ("machines", "List the machines that execute runs, and keep some free"),
        "cloud": ("machines", "Rent machines for an experiment, and give them back"),
    },
    "Administration": {
        "account": ("accounts", "Say who may use the web server, and see what they did"),
        "notify": ("notify", "Tell people when experiments end or fail"),
        "plugins": ("maintenance", "List installed plug-ins, and why one is broken"),
        "settings": ("maintenance", "List all settings with value, source and meaning"),
        "reindex": ("maintenance", "Rebuild the database from the folders of the data root"),
    },
}
"""By heading of the help: the module of each command, and its line there.

The lines are here rather than in the commands, so that `--help` imports no command. Each fits 80 columns, and says how
a command differs from those with similar names.
"""

MODULES = {name: module for section in SECTIONS.values() for name, (module, _) in section.items()}

REGISTRY = "slamhive.base.registry"
"""The logger of the module that loads plug-ins. Importing it for its name would load ``importlib.metadata``."""


_MADE_BEFORE_A_LOOK = 100_000
"""Python looks for garbage after so many new objects; its own number, 700, suits programs without large imports."""


class Root(LazyGroup):
    """The group of all commands. An explained error ends a command with one line and exit code 1."""

    def main(self, *args: Any, **more: Any) -> Any:
        """Run as a program. What imports make stays, so looking for garbage in it was 15 % of the time of a list."""
        before = gc.get_threshold()
        gc.set_threshold(_MADE_BEFORE_A_LOOK, *before[1:])
        try:
            return super().main(*args, **more)
        finally:
            gc.set_threshold(*before)

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Parse the options of the root command; a mistake in them ends as one in a subcommand does."""
        with mistakes_end_with(1):
            for number, text in enumerate(args, start=1):
                check_text(text, f"argument {number}")  # bytes that are not UTF-8 are halves of surrogate pairs
            return super().make_context(info_name, args, parent, **extra)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the commands below the headings of :data:`SECTIONS`."""
        width = max(map(len, MODULES))
        for heading, section in SECTIONS.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), line) for name, (_, line) in section.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn SlamHiveError into a message."""
        try:
            with mistakes_end_with(1):
                return super().invoke(ctx)
        except BrokenPipeError:
            sys.stderr.close()
            ctx.exit(0)


@click.group(
    "slamhive",
    cls=Root,
    modules=MODULES,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="slamhive")
@click.option("--data", type=click.Path(path_type=Path), help="Data root; wins over SLAMHIVE_DATA.")
@click.option("--database-url", help="Database; wins over SLAMHIVE_DATABASE_URL.")
@click.option("-v", "--verbose", is_flag=True, help="Print what is going on.")
@click.pass_context
def main(context: click.Context, data: Path | None, database_url: str | None, verbose: bool) -> None:
    """Run any SLAM algorithm on any dataset, evaluate every run, compare.

    Results lie in the data root: data/ of the checkout, ~/.local/share/slamhive without one.
    """
    level = logging.INFO if verbose else logging.ERROR
    to_terminal = logging.StreamHandler()
    to_terminal.setFormatter(VisibleFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[to_terminal])
    for logger in (logging.getLogger("slamhive"), logging.getLogger(REGISTRY)):
        context.call_on_close(functools.partial(logger.setLevel, logger.level))  # commands choose for themselves
    logging.getLogger(REGISTRY).setLevel(logging.WARNING)  # what it says of broken plug-ins is always shown
    context.obj = CliContext({"data": None if data is None else data.absolute(), "database_url": database_url})
    context.call_on_close(context.obj.close)
