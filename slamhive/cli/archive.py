"""``slamhive archive``: runs and everything they need, as one file or as static pages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, progress_bar, tell
from slamhive.cli.visible import Answering, say
from slamhive.domain.gate import REPLAY_MARGINS, Agreement
from slamhive.domain.names import plural
from slamhive.filters.syntax import experiment_filter
from slamhive.services.archive import (
    ArchiveImport,
    ArchivePart,
    ExportRequest,
    Extra,
    check_archive,
    export_archive,
    open_archive,
)
from slamhive.services.hive import Hive

if TYPE_CHECKING:
    from slamhive.documents.gate import ReplayAnswer

_UNPUBLISHED = "Also what is not public; without accounts, that makes no difference."
_FILE = click.Path(dir_okay=False, path_type=Path)


@click.group()
def archive() -> None:
    """Move runs between installations, or publish them. See docs/archive.md."""


@archive.command("export")
@click.argument("file", type=_FILE)
@click.option("--all", "everything", is_flag=True, help="All runs, and everything else that is stored.")
@click.option("--where", metavar="FILTER", help="Only runs that match this filter.")
@click.option("--experiment", metavar="NAME", help="Only the runs of this experiment.")
@click.option(
    "--without", type=choice(ArchivePart), multiple=True, help="Leave out files of this kind; may be repeated."
)
@click.option("--with", "extra", type=choice(Extra), multiple=True, help="Add what a replay needs; may be repeated.")
@click.option("--replace", is_flag=True, help="Replace an existing file.")
@click.option("--unpublished", is_flag=True, help=_UNPUBLISHED)
@json_option
@pass_cli
def export(cli: CliContext, /, file: Path, as_json: bool, **options: object) -> None:
    """Write finished runs and their folders to FILE (zip).

    `--with packages`, `images` (with their packages) and `recordings` add what `slamhive replay` needs elsewhere.
    """
    hive = cli.hive()
    run_ids = _chosen(hive, bool(options["everything"]), options["where"], options["experiment"])
    request = ExportRequest(
        path=file,
        run_ids=run_ids,
        without=tuple(ArchivePart(str(name)) for name in options["without"]),  # type: ignore[attr-defined]
        replace=bool(options["replace"]),
        extra=tuple(Extra(str(name)) for name in options["extra"]),  # type: ignore[attr-defined]
        unpublished=bool(options["unpublished"]),
    )
    with progress_bar("exporting") as show:

        def progress(done: int, total: int) -> None:
            show(done / total, f"{done}/{total} runs")

        report = export_archive(hive.settings, hive.store, request, progress, hive.versions if request.extra else None)
    if as_json:
        counts = dict(sorted(report.counts.items()))
        left_out = {"left_out": dict(report.left_out), "files_left_out": dict(report.files_left_out)}
        print_json({"counts": counts, **left_out, "size_bytes": report.size_bytes})
        return
    say(f"{report.counts['runs']} runs exported to {file}, {report.size_bytes / 1e6:.1f} MB")
    for kind in Extra:
        if report.counts[kind]:
            tell(f"with {plural(report.counts[kind], kind.removesuffix('s'))}")
    for why, number in report.left_out.items():
        tell(f"left out: {number} runs that {why}")
    for what, number in report.files_left_out.items():
        tell(f"left out: {number} {what}")


@archive.command("verify")
@click.argument("file", type=_FILE)
@json_option
def verify(file: Path, as_json: bool) -> None:
    """Check FILE as an import would, without changing anything."""
    with progress_bar("checking") as show, open_archive(file) as opened:
        contents = check_archive(opened, show)
        manifest = opened.manifest
    if as_json:
        said = {"made_at": manifest.made_at, "software": manifest.software, "counts": manifest.counts}
        print_json({**said, "left_out": contents.left_out})
    else:
        say(f"{file} is whole: {manifest.counts.get('runs', 0)} runs, made {manifest.made_at}")
        if contents.note is not None:
            tell(f"note: {contents.note}")


@archive.command("import")
@click.argument("file", type=_FILE)
@json_option
@pass_cli
def import_archive(cli: CliContext, file: Path, as_json: bool) -> None:
    """Merge FILE into this installation.

    Known runs are skipped. Running the command again completes an interrupted import.
    """
    hive = cli.hive()
    with progress_bar("importing") as show:
        report = ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(file, show)
    if as_json:
        print_json(
            {
                "imported": report.imported,
                "known": report.known,
                "completed": report.completed,
                "kept_numbers": report.kept_numbers,
                "counts": dict(sorted(report.counts.items())),
                "notes": report.notes,
            }
        )
        return
    numbers = "under the numbers that they had" if report.kept_numbers else "under numbers of this installation"
    text = f"{report.imported} runs imported {numbers}, {report.known} known already"
    say(text + (f", {report.completed} completed" if report.completed else ""))
    for note in report.notes:
        tell(f"note: {note}")


@archive.command("site", short_help="Write static pages of runs into FOLDER")
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@click.option("--where", metavar="FILTER", help="Only runs that match this filter; default: all.")
@click.option("--experiment", metavar="NAME", help="Only the runs of this experiment.")
@click.option("--title", default="SLAM Hive", show_default=True, help="Title of the pages.")
@click.option("--unpublished", is_flag=True, help=_UNPUBLISHED)
@click.option("--afresh", is_flag=True, help="Write all pages again, also of runs that have not changed.")
@pass_cli
def site(cli: CliContext, folder: Path, title: str, unpublished: bool, afresh: bool, **chosen: str | None) -> None:
    """Write static pages of runs into FOLDER; they need no server and no network.

    If FOLDER has an older site, the pages of runs that have not changed are taken over.
    """
    from slamhive.web.static_site import SiteRequest, StaticSite  # noqa: PLC0415 - Plotly takes a second

    hive = cli.hive()
    where, experiment = chosen["where"], chosen["experiment"]
    run_ids = _chosen(hive, where is None and experiment is None, where, experiment)
    query = where or (experiment_filter(experiment) if experiment else "")
    with progress_bar("writing") as show:
        site = StaticSite(hive, SiteRequest(folder, run_ids, title, query, unpublished, afresh))
        written = site.write(lambda done, total: show(done / total, f"{done}/{total} runs"))
    kept = f", {site.kept} of them unchanged" if site.kept else ""
    say(f"{written} runs published in {folder}{kept}; open {folder / 'index.html'}")


def _chosen(hive: Hive, everything: bool, where: object, experiment: object) -> Sequence[int] | None:
    """The numbers of the selected runs, None for all."""
    if (everything, where is not None, experiment is not None).count(True) != 1:
        raise click.UsageError("select the runs with one of --all, --where FILTER and --experiment NAME")
    if everything:
        return None
    chosen = hive.searches.find(str(where)) if where is not None else hive.experiments.run_ids(str(experiment))
    if not chosen:
        raise InvalidInput("no run matches", "slamhive runs --where FILTER shows what a filter finds")
    return chosen


# ``slamhive replay``: run again what a bundle recorded, and say whether both agree.


EXIT_CODES = {Agreement.AGREE: 0, Agreement.DIFFERS: 1, Agreement.UNDECIDED: 3}
STYLES = {Agreement.AGREE: "green", Agreement.DIFFERS: "red", Agreement.UNDECIDED: "yellow"}
_DEFAULTS = ", ".join(f"{key}={margin.words().replace(' ', '')}" for key, margin in REPLAY_MARGINS.items())


@click.command(cls=Answering)
@click.argument("bundle", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--repeats", type=click.IntRange(1, 1000), default=5, show_default=True, help="Runs of each configuration."
)
@click.option("--into", type=click.Path(file_okay=False, path_type=Path), help="Data root to use; made if missing.")
@click.option("--executor", help="Where runs are executed; by default where the recorded ones were.")
@click.option("--load-image", is_flag=True, help="Take packages and images from BUNDLE. They are code that runs here.")
@click.option("--rebuild", is_flag=True, help="Build a package again if its image or environment is not here.")
@click.option(
    "--margin",
    "margins",
    multiple=True,
    metavar="METRIC=MARGIN",
    help=f"A share (5%), a number in the metric's unit, or off; may be repeated.  [default: {_DEFAULTS}]",
)
@click.option("--markdown", type=click.Path(dir_okay=False, path_type=Path), help="Write a summary.")
@json_option
@pass_cli
def replay(cli: CliContext, /, bundle: Path, as_json: bool, **options: Any) -> None:
    """Run again what BUNDLE recorded, and say whether old and new agree. See docs/replay.md.

    BUNDLE is a file of `slamhive archive export`. The exit code is 0 if all metrics agree within their margins, and 1
    if one differs and chance does not explain it. It is 3 if the runs are too few to say, and 2 for a mistake.
    """
    # Importing the services takes half a second, which `--help` need not wait for.
    from slamhive.cli.waiting import run_to_end  # noqa: PLC0415
    from slamhive.services.replay import ReplayRequest  # noqa: PLC0415

    markdown = options["markdown"]
    if markdown is not None and not markdown.parent.is_dir():
        raise InvalidInput(f"folder {markdown.parent} does not exist", "make it first")
    if options["into"] is not None:
        cli.options_with(data=options["into"].absolute())
    named = ("repeats", "executor", "load_image", "rebuild", "margins")
    hive = cli.hive()
    with progress_bar("preparing") as show:
        prepared = hive.replays.prepare(ReplayRequest(bundle, **{name: options[name] for name in named}), show)
    started = hive.replays.start(prepared)
    run_to_end(hive, [run_id for run_ids in started for run_id in run_ids], evaluate=True)
    answer = hive.replays.answer(prepared, started)
    print_json(answer.content) if as_json else _print(answer)
    _write(answer, markdown)
    raise click.exceptions.Exit(EXIT_CODES[answer.answer])


def _print(answer: ReplayAnswer) -> None:
    from slamhive.services import replay as tables  # noqa: PLC0415

    print_table(tables.METRIC_HEADS, tables.metric_rows(answer), right=tables.METRIC_HEADS[1:-1])
    say()
    print_table(tables.CONFIGURATION_HEADS, tables.configuration_rows(answer), right=tables.CONFIGURATION_HEADS[2:])
    say()
    values = [
        tuple(f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row) for row in tables.value_rows(answer)
    ]
    print_table(tables.VALUE_HEADS, values, right=tables.VALUE_HEADS[2:])
    for note in answer.notes:
        tell(note)
    count = plural(sum(len(entry.runs) for entry in answer.configurations), "repeat")
    tell(f"replay of {answer.bundle}, {count}: {answer.answer}. {answer.words}", style=STYLES[answer.answer])


def _write(answer: ReplayAnswer, markdown: Path | None) -> None:
    from slamhive.services.replay import answer_markdown  # noqa: PLC0415

    if markdown is not None:
        write_aside(markdown, answer_markdown(answer))


COMMANDS = (
    archive,
    replay,
)
