"""The root command, its options, and what belongs to no group."""

from __future__ import annotations

import logging
from pathlib import Path

import click

from slamhive import __version__
from slamhive.cli import (
    algorithms,
    analyse,
    archive,
    configurations,
    datasets,
    evaluate,
    experiments,
    maintenance,
    protocols,
    runs,
    searching,
    serving,
    variants,
)
from slamhive.cli.context import CliContext
from slamhive.cli.output import OneLineErrors


@click.group(
    "slamhive", cls=OneLineErrors, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="slamhive")
@click.option("--data", type=click.Path(path_type=Path), help="Data root; wins over SLAMHIVE_DATA.")
@click.option("--database-url", help="Database; wins over SLAMHIVE_DATABASE_URL.")
@click.option("-v", "--verbose", is_flag=True, help="Say more of what is going on.")
@click.pass_context
def main(context: click.Context, data: Path | None, database_url: str | None, verbose: bool) -> None:
    """Run any SLAM algorithm on any dataset, evaluate every run, compare.

    Data lies in the data root (default: ./data in the project). `slamhive doctor` tells what works on this machine.
    """
    level = logging.INFO if verbose else logging.ERROR
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s")
    context.obj = CliContext({"data": None if data is None else data.absolute(), "database_url": database_url})
    context.call_on_close(context.obj.close)


for module in (
    datasets,
    variants,
    algorithms,
    configurations,
    experiments,
    runs,
    searching,
    evaluate,
    protocols,
    analyse,
    archive,
    serving,
    maintenance,
):
    for command in module.COMMANDS:
        main.add_command(command)
