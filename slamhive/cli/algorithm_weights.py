"""``slamhive algorithm weights``: the files with trained weights that a package needs."""

from __future__ import annotations

from pathlib import Path

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.errors import InvalidInput
from slamhive.services.hive import Hive
from slamhive.services.weights import StoredWeights, WeightsStore


@click.command("weights")
@click.argument("name", shell_complete=offers.PACKAGE)
@click.option("--file", "file", type=click.Path(path_type=Path), help="Add this file, which you have downloaded.")
@click.option("--as", "weights", metavar="WEIGHTS", help="The weights that --file holds.  [default: its file name]")
@click.option("--fetch", is_flag=True, help="Download what is missing from where its authors publish it.")
@json_option
@pass_cli
def weights_command(
    cli: CliContext, name: str, file: Path | None, weights: str | None, fetch: bool, as_json: bool
) -> None:
    """List, add or download the weights of the package NAME.

    Runs get them as read-only files. A file whose checksum differs is refused.
    """
    if fetch and file is not None:
        raise InvalidInput("--file and --fetch exclude each other", "give one of them")
    hive = cli.hive()
    package = hive.catalogue.package(name)
    store = WeightsStore(hive.settings)
    if file is not None:
        store.add(package, file, weights)
    elif fetch:
        store.fetch(package, lambda done, size: tell(f"{done / 1e6:,.0f} of {(size or 0) / 1e6:,.0f} MB", style="dim"))
    _print(hive, store.stored(package), as_json=as_json)


def _print(hive: Hive, entries: tuple[StoredWeights, ...], *, as_json: bool) -> None:
    rows = [
        {
            "name": entry.weights.name,
            "present": entry.present,
            "sha256": entry.sha256,
            "licence": entry.weights.licence,
            "page": entry.weights.page,
            "path": str(entry.path.relative_to(hive.settings.data)),
        }
        for entry in entries
    ]
    if as_json:
        print_json(rows)
        return
    columns = ("weights", "here", "SHA-256", "licence", "published at")
    print_table(
        columns,
        [
            (
                entry.weights.name,
                "yes" if entry.present else "no",
                "not known" if entry.sha256 is None else entry.sha256[:12],
                entry.weights.licence,
                entry.weights.page,
            )
            for entry in entries
        ],
    )


COMMANDS = (weights_command,)
