"""``slamhive runs delete``, ``restore`` and ``trash``."""

from __future__ import annotations

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli, run_number
from slamhive.cli.output import print_json, print_table, tell
from slamhive.domain.numbers import plural
from slamhive.schema.api_answers import DeletedRun


@click.command("delete")
@click.argument("run_ids", type=run_number, nargs=-1, required=True, shell_complete=offers.RUN)
@pass_cli
def delete(cli: CliContext, run_ids: tuple[int, ...]) -> None:
    """Move runs that have ended to the trash, with their files."""
    runs = cli.hive().trash.delete(run_ids)
    numbers = " ".join(str(run.id) for run in runs)
    click.echo(f"{plural(len(runs), 'run')} moved to the trash; slamhive runs restore {numbers} takes them out again")


@click.command("restore")
@click.argument("run_ids", type=run_number, nargs=-1, required=True, shell_complete=offers.RUN)
@pass_cli
def restore(cli: CliContext, run_ids: tuple[int, ...]) -> None:
    """Take runs out of the trash, under their old numbers."""
    click.echo(f"{plural(len(cli.hive().trash.restore(run_ids)), 'run')} restored")


@click.command("trash")
@click.option("--empty", is_flag=True, help="Remove the files of all deleted runs for good.")
@json_option
@pass_cli
def trash(cli: CliContext, empty: bool, as_json: bool) -> None:
    """List the deleted runs, or remove them for good."""
    hive = cli.hive()
    if empty:
        click.echo(f"{plural(hive.trash.empty(), 'run')} removed for good")
        return
    found = hive.trash.listed()
    rows = [(run.deleted.run_id, run.algorithm, run.dataset, run.deleted.at.isoformat()) for run in found]
    columns = ("id", "algorithm", "dataset", "deleted_at")
    if as_json:
        print_json([DeletedRun.of(run).content for run in found])
    elif rows:
        print_table(columns, rows, right=("id",))
    else:
        tell("the trash is empty")


COMMANDS = (delete, restore, trash)
