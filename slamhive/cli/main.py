"""The root command: its options, how it finds commands, and how it reports mistakes."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import click

from slamhive import __version__
from slamhive.cli.context import CliContext
from slamhive.cli.groups import LazyGroup
from slamhive.cli.mistakes import mistakes_end_with
from slamhive.cli.visible import VisibleFormatter
from slamhive.input_bounds import check_text

MODULES = {
    "account": "accounts",
    "algorithm": "algorithms",
    "analyse": "analyse",
    "analyses": "stored_analyses",
    "archive": "archive",
    "challenge": "challenges",
    "cite": "cite",
    "cloud": "cloud",
    "compare": "compare",
    "completion": "completion",
    "configuration": "configurations",
    "dataset": "datasets",
    "demo": "serving",
    "doctor": "maintenance",
    "evaluate": "evaluate",
    "experiment": "experiments",
    "find": "finding",
    "gate": "gates",
    "nodes": "nodes",
    "notify": "notify",
    "plugins": "plugins",
    "protocol": "protocols",
    "reindex": "maintenance",
    "replay": "replay",
    "run": "running",
    "runs": "runs",
    "search": "searching",
    "serve": "serving",
    "settings": "maintenance",
    "variants": "variants",
    "worker": "serving",
}
"""The module of each command."""

REGISTRY = "slamhive.registry"
"""The logger of the module that loads plug-ins. Importing it for its name would load ``importlib.metadata``."""


class Root(LazyGroup):
    """The group of all commands. An explained error ends a command with one line and exit code 1."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Parse the options of the root command; a mistake in them ends as one in a subcommand does."""
        with mistakes_end_with(1):
            for number, text in enumerate(args, start=1):
                check_text(text, f"argument {number}")  # bytes that are not UTF-8 are halves of surrogate pairs
            return super().make_context(info_name, args, parent, **extra)

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

    Data lies in the data root (default: ./data in the project). `slamhive doctor` checks this machine.
    """
    level = logging.INFO if verbose else logging.ERROR
    to_terminal = logging.StreamHandler()
    to_terminal.setFormatter(VisibleFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[to_terminal])
    logging.getLogger(REGISTRY).setLevel(logging.WARNING)  # what it says of broken plug-ins is always shown
    context.obj = CliContext({"data": None if data is None else data.absolute(), "database_url": database_url})
    context.call_on_close(context.obj.close)
