"""``slamhive dataset fetch``, ``search``, ``links``, ``export``: public sequences, and folders for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import counting_bar, print_json, print_table, progress_bar, tell
from slamhive.cli.visible import say
from slamhive.domain.names import plural
from slamhive.recordings.exporters import SHIPPED, export_dataset, plan_export
from slamhive.services.datasets import dataset_document
from slamhive.services.fetching import FetchRequest

if TYPE_CHECKING:
    from slamhive.documents.catalogue import PublicSequence
    from slamhive.domain.dataset import Dataset


@click.command("fetch")
@click.argument("sequences", metavar="COLLECTION/SEQUENCE...", nargs=-1, required=True)
@click.option("--source", "--mirror", "source", help="Which of several sources to use.  [default: the first]")
@click.option(
    "--archive",
    "archives",
    type=click.Path(path_type=Path),
    multiple=True,
    help="A file that was downloaded by hand. Can be given several times.",
)
@click.option("--name", help="Name of the new dataset.  [default: COLLECTION_SEQUENCE]")
@click.option("--keep-archive", is_flag=True, help="Keep what was downloaded, in the data root.")
@click.option("--accept-licence", is_flag=True, help="You have read the licence and accept it.")
@click.option("--preview", is_flag=True, help="Show what would be downloaded, and stop.")
@json_option
@pass_cli
def fetch(cli: CliContext, preview: bool, as_json: bool, **given: Any) -> None:
    """Download public sequences and make datasets of them.

    An interrupted download continues when the command is run again. `*` stands for any letters, for instance
    'euroc/MH_*'. `slamhive dataset search` lists all sequences.
    """
    fetching = cli.hive(indexed=False).fetching
    request = FetchRequest(**given)
    plans = fetching.plan(request)
    for plan in plans:
        size = plan.download_bytes
        words = "of unknown size" if size is None else f"about {size / 1e6:,.0f} MB"
        files = [file.name for file in plan.files if file.name not in plan.by_hand]
        what = f"{', '.join(files)}, {words}" if files else "the files given"
        tell(f"{plan.sequence.full_name} becomes dataset {plan.name}: {what}")
        tell(f"licence: {plan.collection.licence or 'not stated'}; please cite: {plan.collection.citation}")
    if preview:
        return
    made: list[Dataset] = []
    with progress_bar("fetching", tells_left=False) as progress:
        for dataset in fetching.perform(plans, request, progress):
            made.append(dataset)
            if not as_json:
                tell(f"dataset {dataset.name} is ready: slamhive run ALGORITHM {dataset.name} --evaluate")
    if as_json:
        print_json([dataset_document(dataset).content for dataset in made])


@click.command("search", short_help="List public sequences that all WORDS fit")
@click.argument("words", nargs=-1)
@json_option
@pass_cli
def search(cli: CliContext, words: tuple[str, ...], as_json: bool) -> None:
    """List public sequences that all WORDS fit: attributes, sensor set-ups, parts of names.

    For instance: slamhive dataset search indoor stereo-inertial
    """
    found = cli.hive(indexed=False).fetching.search(words)
    if as_json:
        print_json([entry.content for entry in found])
        return
    columns = ("sequence", "MB", "sensors", "attributes", "needs", "licence")
    rows = [
        (
            entry.name,
            size_in_words(entry),
            _sensors(entry),
            ", ".join(entry.attributes[1:]),
            ", ".join(need.kind.value for need in entry.needs) or None,
            entry.licence,
        )
        for entry in found
    ]
    print_table(columns, rows, right=("MB",), spare=("licence", "attributes", "needs"))
    collections = {entry.title for entry in found}
    tell(
        f"{plural(len(found), 'sequence')} of {plural(len(collections), 'collection')}; slamhive dataset fetch SEQUENCE"
    )
    if any(entry.unverified for entry in found):
        tell("The addresses are unverified: slamhive dataset links tries them.")


@click.command("links")
@click.argument("collections", metavar="[COLLECTION]...", nargs=-1)
@click.option("--timeout", "timeout_s", type=click.FloatRange(0.1, 600), default=20.0, show_default=True, help="In s.")
@click.option("--connections", type=click.IntRange(1, 32), default=8, show_default=True, help="At the same time.")
@json_option
@pass_cli
def links(cli: CliContext, collections: tuple[str, ...], timeout_s: float, connections: int, as_json: bool) -> None:
    """Try the addresses of the catalogue, or of COLLECTIONs. The exit code is 1 if one gives no file.

    One byte of each file is requested.
    """
    from slamhive.downloads.web import Timeouts  # noqa: PLC0415 - with requests, for this command only

    fetching = cli.hive(indexed=False).fetching
    total = len(fetching.links(collections))
    with counting_bar("asking", total) as progress:
        reports = fetching.check_links(
            collections, Timeouts(timeout_s, timeout_s), connections, lambda n: progress(n, "")
        )
    bad = [report for report in reports if report.problem is not None]
    if as_json:
        print_json([report.content for report in reports])
    else:
        rows = [
            (
                report.problem or "ok",
                None if report.size_bytes is None else f"{report.size_bytes / 1e6:,.1f}",
                None if report.ranges is None else "yes" if report.ranges else "no",
                f"{report.duration_s:.1f}",
                report.address,
            )
            for report in sorted(reports, key=lambda report: report.problem is None)
        ]
        print_table(("answer", "MB", "continues", "s", "address"), rows, right=("MB", "s"))
        tell(f"{len(reports) - len(bad)} of {plural(len(reports), 'address', 'addresses')} give their file")
    if bad:
        click.get_current_context().exit(1)


def size_in_words(entry: PublicSequence) -> str:
    """``448``, ``about 22,000, shared``, ``unknown``."""
    if entry.download_bytes is None:
        return "unknown"
    about = "" if entry.exact else "about "
    return f"{about}{entry.download_bytes / 1e6:,.0f}{', shared' if entry.shared else ''}"


def _sensors(entry: PublicSequence) -> str:
    return ", ".join(entry.setups)


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


COMMANDS = (fetch, search, links, export)
