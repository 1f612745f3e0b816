"""``slamhive runs delete``, ``restore`` and ``trash``."""

from __future__ import annotations

from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.chosen_runs import ChosenRuns, SearchAction, runs_or_search
from slamhive.cli.context import CliContext, json_option, pass_cli, run_number
from slamhive.cli.output import counting_bar, print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.domain.numbers import plural
from slamhive.errors import InvalidInput
from slamhive.schema.api_answers import DeletedRun


@click.command("delete")
@runs_or_search
@json_option
@pass_cli
def delete(cli: CliContext, /, as_json: bool, **chosen: Any) -> None:
    """Move runs that have ended to the trash, with their files.

    With --where, runs that have not ended or are being evaluated are left out.
    """
    hive, runs = cli.hive(), ChosenRuns(**chosen)
    if runs.where is not None:
        action = SearchAction("delete", "move {runs} to the trash?", "{runs} moved to the trash")
        acted = runs.act(hive, action, hive.search_actions.delete, as_json=as_json)
        if acted.at is not None and acted.done and not as_json:
            say(f"slamhive runs restore --deleted-at {acted.at.isoformat()} takes them out again")
        return
    deleted = hive.trash.delete(runs.run_ids)
    if as_json:
        print_json({"done": len(deleted), "left_out": 0, "reasons": []})
        return
    numbers = " ".join(str(run.id) for run in deleted)
    say(f"{plural(len(deleted), 'run')} moved to the trash; slamhive runs restore {numbers} takes them out again")


@click.command("restore")
@click.argument("run_ids", type=run_number, nargs=-1, shell_complete=offers.RUN)
@click.option("--deleted-at", metavar="TIME", help="All runs that one command deleted at this time, as it said.")
@pass_cli
def restore(cli: CliContext, run_ids: tuple[int, ...], deleted_at: str | None) -> None:
    """Take runs out of the trash, under their old numbers."""
    if bool(run_ids) == (deleted_at is not None):
        raise InvalidInput("name runs by number, or give --deleted-at: one of the two", "see slamhive runs trash")
    hive = cli.hive()
    wanted = list(run_ids) if deleted_at is None else hive.trash.deleted_together(deleted_at)
    with counting_bar("restore", len(wanted)) as bar:
        restored = hive.trash.restore(wanted, lambda done: bar(done, ""))
    say(f"{plural(len(restored), 'run')} restored")


@click.command("trash")
@click.option("--empty", is_flag=True, help="Remove the files of all deleted runs for good.")
@json_option
@pass_cli
def trash(cli: CliContext, empty: bool, as_json: bool) -> None:
    """List the deleted runs, or remove them for good."""
    hive = cli.hive()
    if empty:
        say(f"{plural(hive.trash.empty(), 'run')} removed for good")
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
