"""``slamhive dataset export``: a dataset as a folder for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, progress_bar, tell
from slamhive.cli.visible import say
from slamhive.recordings.exporters import SHIPPED, export_dataset, plan_export


@click.command("export")
@click.argument("name", shell_complete=completion.DATASET)
@click.option("--format", "format_name", required=True, help=f"One of {', '.join(SHIPPED)}, or that of a plug-in.")
@click.option("--to", "folder", type=click.Path(path_type=Path), help="The new folder.  [default: NAME-FORMAT]")
@click.option("--partial", is_flag=True, help="Leave out what the format cannot hold.")
@json_option
@pass_cli
def export(cli: CliContext, name: str, format_name: str, folder: Path | None, partial: bool, as_json: bool) -> None:
    """Write the dataset NAME to a folder in another format."""
    dataset = cli.hive(indexed=False).catalogue.dataset(name)
    target = (folder or Path(f"{name}-{format_name}")).absolute()
    plan = plan_export(dataset, format_name, partial=partial)
    with progress_bar(f"exporting {name}") as progress:
        export_dataset(plan, target, progress)
    if as_json:
        print_json(
            {
                "dataset": name,
                "format": format_name,
                "folder": str(target),
                "left_out": list(plan.left_out),
                "notes": list(plan.notes),
            }
        )
        return
    for text in plan.left_out:
        tell(f"left out: {text}")
    for note in plan.notes:
        tell(note)
    say(str(target))


COMMANDS = (export,)
