"""``slamhive algorithm import`` and ``remove``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json, tell
from slamhive.cli.visible import say, write_out
from slamhive.domain.sensors import SensorSetup
from slamhive.schema.catalogue import Algorithm

if TYPE_CHECKING:
    from slamhive.services.algorithms import ImportedPackage, PlannedPackage


@click.command("import")
@click.argument("source", metavar="FOLDER|GIT-URL|IMAGE|TAR")
@click.option("--name", help="The name of the package; default: that of the source.")
@click.option("--image", help="The image to use with a folder: its name, or a file that docker save wrote.")
@click.option("--setup", type=choice(SensorSetup), help="What the algorithm senses with, if its files do not say.")
@click.option("--replace", is_flag=True, help="Take the place of an imported package of that name.")
@click.option("--executor", help="The executor that gets the image; default: the one in force.")
@click.option("--preview", is_flag=True, help="Only show what would be made.")
@json_option
@pass_cli
def import_(cli: CliContext, source: str, preview: bool, as_json: bool, **asked: Any) -> None:
    """Import an algorithm that was made for the published SLAM Hive, without changing its files.

    FOLDER holds slamhive/mapping.py, and a Dockerfile or image.tar. A Git address may end with #COMMIT. IMAGE and TAR
    hold /slamhive themselves; TAR may also be what `slamhive algorithm export` wrote. `algorithm.yaml` is drafted from
    the files, which are read and not executed.
    """
    # Importing the services takes half a second, which `--help` need not wait for.
    from slamhive.services.algorithms import ImportRequest  # noqa: PLC0415
    from slamhive.services.versions import is_export  # noqa: PLC0415

    hive = cli.hive(indexed=False)
    if is_export(Path(source)):
        chosen = hive.executors.get(hive.executors.choose(asked["executor"]))
        made, record = hive.versions.load(Path(source), chosen)
        say(f"{record.label}: {made.package.folder}")
        return
    setup = asked.pop("setup")
    request = ImportRequest(setup=None if setup is None else SensorSetup(setup), **asked)
    with hive.algorithms.planned(source, request) as planned:
        if preview:
            _show_plan(planned, as_json=as_json)
            return
        tell(f"{planned.name}: {_way(planned)}", style="bold")
        _show_result(hive.algorithms.perform(planned, lambda line: tell(line, style="dim")), as_json=as_json)


@click.command("remove")
@click.argument("name", shell_complete=offers.PACKAGE)
@click.option("--executor", help="The executor that has the image; default: the one in force.")
@pass_cli
def remove(cli: CliContext, name: str, executor: str | None) -> None:
    """Remove the imported package NAME and its image. Runs keep their results."""
    left = cli.hive(indexed=False).algorithms.remove(name, executor)
    if left is not None:
        tell(f"note: {left}")
    say(f"{name} is removed")


def _way(planned: PlannedPackage) -> str:
    verbs = {"build": "builds", "load": "loads", "take": "takes"}
    return f"{verbs[planned.way.value]} {planned.image} ({planned.why})"


def _show_plan(planned: PlannedPackage, *, as_json: bool) -> None:
    if as_json:
        print_json(planned.content)
        return
    say(f"{planned.name} from {planned.origin.words}")
    say(_way(planned))
    if planned.draft is None:
        say("algorithm.yaml is drafted when the image is there")
        return
    write_out(planned.draft.text)
    for note in planned.draft.notes:
        tell(f"note: {note}")


def _show_result(made: ImportedPackage, *, as_json: bool) -> None:
    for note in made.notes:
        tell(f"note: {note}")
    if as_json:
        print_json([Algorithm.of(entry).content for entry in made.algorithms])
        return
    package = made.algorithms[0].package
    say(f"imported {', '.join(entry.name for entry in made.algorithms)}; check {package.folder / 'algorithm.yaml'}")


COMMANDS = (import_, remove)
