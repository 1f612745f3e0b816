"""``slamhive runs note`` and ``slamhive runs tag``: what people write about runs."""

from __future__ import annotations

from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.chosen_runs import ChosenRuns, SearchAction, runs_or_search
from slamhive.cli.context import CliContext, json_option, pass_cli, run_number
from slamhive.cli.output import print_json
from slamhive.cli.visible import say
from slamhive.domain.notes import NotesChange, RunNotes
from slamhive.errors import InvalidInput


@click.command("note")
@click.argument("run_id", type=run_number, shell_complete=offers.RUN)
@click.argument("text")
@json_option
@pass_cli
def note(cli: CliContext, run_id: int, text: str, as_json: bool) -> None:
    """Write the note of a run; an empty text removes it."""
    _show(cli.hive().notes.change([run_id], NotesChange(note=text)), as_json=as_json)


@click.command("tag")
@runs_or_search
@click.option("--add", multiple=True, metavar="TAG", help="Give the runs this tag.")
@click.option("--remove", multiple=True, metavar="TAG", help="Take this tag away from them.")
@json_option
@pass_cli
def tag(cli: CliContext, /, add: tuple[str, ...], remove: tuple[str, ...], as_json: bool, **chosen: Any) -> None:
    """Add tags to runs, or remove them. Filters find them: tag = paper."""
    hive, runs = cli.hive(), ChosenRuns(**chosen)
    if not add and not remove:
        raise InvalidInput("no tag is named", "use --add TAG or --remove TAG")
    change = NotesChange(add=add, remove=remove)
    if runs.where is None:
        _show(hive.notes.change(runs.run_ids, change), as_json=as_json)
        return
    action = SearchAction("tag", "change the tags of {runs}?", "the tags of {runs} are stored")
    runs.act(hive, action, lambda ids, progress: hive.search_actions.tag(ids, change, progress), as_json=as_json)


def _show(changed: dict[int, RunNotes], *, as_json: bool) -> None:
    if as_json:
        print_json([{"id": run_id, **notes.content} for run_id, notes in changed.items()])
        return
    for run_id, notes in changed.items():
        said = [f"tags {', '.join(notes.tags)}" if notes.tags else "no tags"] + ([notes.note] if notes.note else [])
        say(f"run {run_id}: {'; '.join(said)}")


COMMANDS = (note, tag)
