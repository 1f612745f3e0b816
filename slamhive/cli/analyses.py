"""``slamhive analyse``: compute an analysis file into a report, without the web."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.analysis.report import PlotBrief, Report, ReportBrief
from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.context import CliContext, id_option, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, progress_bar, tell
from slamhive.cli.sharing import change_of, in_words, sharing_options
from slamhive.cli.visible import say
from slamhive.domain.names import plural

if TYPE_CHECKING:
    from slamhive.store.records import AnalysisRecord

FIGURE_FORMATS = ("pdf", "svg", "png")
PAPER_FORMATS = ("88mm.pdf", "180mm.pdf")
FONTS = ("serif", "sans")


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Folder or .zip file for the report.")
@click.option("--figures", default=",".join(FIGURE_FORMATS), show_default=True, help="Plot formats, or none.")
@click.option("--paper", is_flag=True, help="Also plots for papers: PDF, 88 and 180 mm wide, without title.")
@click.option("--font", type=click.Choice(FONTS), help="Font of plots. Default: serif for papers, otherwise sans.")
@click.option("--timeout", "timeout_s", type=click.FloatRange(1), default=3600.0, show_default=True, help="Limit in s.")
@id_option
@json_option
@pass_cli
def analyse(cli: CliContext, /, file: Path, out: Path | None, as_json: bool, **options: Any) -> None:
    """Compute the analysis in FILE: its plots, tables and report.

    FILE is an analysis file (docs/analysis.md), or one of the published SLAM Hive. Without --out only the counts and
    what could not be shown are printed. Ends with exit code 1 if a plot type does not fit the runs.
    """
    # matplotlib, pandas and scipy take two seconds to load, which no other command should wait for.
    from slamhive.services.analysis import (  # noqa: PLC0415
        PARQUET_REMEDY,
        WITHOUT_PARQUET,
        AnalysisLimits,
        Printing,
        parquet_there,
        write_folder,
        zipped,
    )

    figures = options["figures"]
    chosen = () if figures == "none" else tuple(part.strip() for part in figures.split(","))
    for name in chosen:
        if name not in FIGURE_FORMATS:
            raise InvalidInput(f"--figures {name!r} is not known", f"use some of {', '.join(FIGURE_FORMATS)}, or none")
    formats = (*chosen, *(PAPER_FORMATS if options["paper"] else ()))
    printing = Printing(formats, options["font"])
    if out is None and options["paper"]:
        raise InvalidInput("--paper writes files, but --out is missing", "add --out FOLDER")
    hive = cli.hive()
    analysis = hive.analyses.read_file(file, options["ids"])
    with progress_bar(analysis.name) as progress:
        report = hive.analyses.compute(analysis, AnalysisLimits(sys.maxsize, options["timeout_s"]), progress)
    root = hive.catalogue.project_root
    if out is not None and out.suffix == ".zip":
        from slamhive.base.files import write_aside  # noqa: PLC0415

        out.parent.mkdir(parents=True, exist_ok=True)
        write_aside(out, zipped(report, root, printing))
    elif out is not None:
        with progress_bar("writing the report") as progress:
            write_folder(report, root, out, printing, progress)
    refused = [plot.error for plot in report.forms if plot.error]
    plots = tuple(PlotBrief.of(plot, charts=len(plot.charts)) for plot in report.forms)
    if as_json:
        print_json(ReportBrief.of(report, forms=plots).content)
    else:
        tell(f"{report.runs} runs, {report.failed} failed: {report.selection}")
        if report.unevaluated:
            tell(f"left out: {report.unevaluated} runs: not evaluated under this protocol, cancelled or not ended")
        _show_what_differs(report)
        rows = [(entry.form, entry.title, entry.charts, entry.error or "") for entry in plots]
        print_table(("form", "title", "plots", "not shown because"), rows)
        for note in (note for entry in plots for note in entry.notes):
            tell(note)
        if out is not None:
            tell(f"written to {out}" + ("" if parquet_there() else f"; {WITHOUT_PARQUET}: {PARQUET_REMEDY}"))
    if refused:
        raise InvalidInput(f"{len(refused)} of {len(plots)} plots do not fit: {refused[0]}")


def _show_what_differs(report: Report) -> None:
    """Print what runs of the report do not have in common: disturbance, protocols, versions, trajectories, CPUs."""
    found = report.disturbance
    if found is not None and found.left_out:
        tell(f"left out: {found.left_out} runs that were measured on a disturbed machine")
    if found is not None and found.disturbed:
        tell(f"{found.disturbed} runs were measured on a disturbed machine")
    if report.mixed_protocols is not None:
        tell(report.mixed_protocols, style="yellow")
    for name, labels in report.mixed_versions.items():
        tell(f"versions are mixed: {name} ran as {', '.join(labels)}", style="yellow")
    for kind, names in report.mixed_trajectories.items():
        tell(f"kinds of trajectories are mixed: {kind} of {', '.join(names)}", style="yellow")
    if report.mixed_cpus:
        models = ", ".join(f"{model} ({plural(runs, 'run')})" for model, runs in report.mixed_cpus.items())
        tell(f"CPU models are mixed: {models}", style="yellow")


# ``slamhive analyses``: the analyses that the pages compute and keep.


@click.group("analyses")
def analyses() -> None:
    """List, share and delete analyses that were made on pages or by the web API."""


@analyses.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List the analyses that the pages list, the newest first."""
    found = cli.hive().stored_analyses.listed()
    if as_json:
        print_json([_content(record) for record in found])
        return
    columns = ("token", "name", "state", "owner", "seen by", "created_at")
    rows = [(r.token, r.name, r.state.value, r.owner, r.seen_by.value, r.created_at.isoformat()) for r in found]
    if rows:
        print_table(columns, rows)
    else:
        tell("there are no analyses; make one on the page of analyses, or compute a file with slamhive analyse")


@analyses.command("share")
@click.argument("token", shell_complete=completion.ANALYSIS)
@sharing_options
def share(cli: CliContext, token: str, visibility: str | None, owner: str | None, as_json: bool) -> None:
    """Choose who may see an analysis where there are accounts. A worker then computes it again."""
    record = cli.hive().sharings.analysis(token, change_of(visibility, owner))
    if as_json:
        print_json(_content(record))
    else:
        say(f"analysis {record.name}: {in_words(record.owner, record.seen_by)}")


@analyses.command("delete")
@click.argument("token", shell_complete=completion.ANALYSIS)
@pass_cli
def delete(cli: CliContext, token: str) -> None:
    """Remove an analysis with its files for good."""
    stored = cli.hive().stored_analyses
    name = stored.get(token).name
    stored.delete(token)
    say(f"analysis {name} deleted")


def _content(record: AnalysisRecord) -> dict[str, object]:
    from slamhive.documents.api import AnalysisDocument  # noqa: PLC0415 - the table needs none of these models

    return AnalysisDocument.of(record).content


COMMANDS = (
    analyse,
    analyses,
)
