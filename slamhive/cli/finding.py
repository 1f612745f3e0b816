"""``slamhive find``: one search over everything that has a name."""

from __future__ import annotations

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.schema.finding import FoundThing
from slamhive.services.finding import find as find_everything


@click.command()
@click.argument("words", nargs=-1, required=True)
@json_option
@pass_cli
def find(cli: CliContext, words: tuple[str, ...], as_json: bool) -> None:
    """Find WORDS in names and descriptions of algorithms, datasets, experiments, analyses, searches and metrics.

    A number is also a run; a tag or a filter also finds the runs that it fits. Of each kind the best 8 are shown.
    """
    groups = find_everything(cli.hive(), " ".join(words))
    found = [entry for entries in groups.values() for entry in entries]
    if as_json:
        print_json([FoundThing.of(entry).content for entry in found])
    elif found:
        print_table(("what", "name", "description"), [(entry.kind.value, entry.name, entry.words) for entry in found])
    else:
        tell(f"nothing is called {' '.join(words)!r}")


COMMANDS = (find,)
