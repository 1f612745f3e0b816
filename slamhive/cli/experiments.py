"""``slamhive experiment``: plan, start, watch, pause, cancel, try again, report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.experiment_tables import print_preview, print_report, print_status, print_statuses
from slamhive.cli.output import messages, print_json, progress_bar
from slamhive.cli.waiting import experiment_to_end
from slamhive.files import write_aside
from slamhive.services.experiments import (
    ExperimentSource,
    Phase,
    Progress,
    Standing,
    cell_to_json,
    csv_text,
    preview_to_json,
    status_to_json,
    varying,
)
from slamhive.services.hive import Hive
from slamhive.sweep.experiment_file import parse_experiment

SUFFIXES = (".yaml", ".yml")
name_argument = click.argument("name", metavar="NAME|FILE")


@click.group()
def experiment() -> None:
    """Experiments: many configurations out of one file."""


@experiment.command("plan")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--executor", help="docker or process; default: the file's, or the one in force.")
@json_option
@pass_cli
def plan(cli: CliContext, file: Path, executor: str | None, as_json: bool) -> None:
    """Check FILE and say what starting it would do; nothing is stored. Exit code 1 if it would be refused."""
    with _counting("checking") as progress:
        found = cli.hive().experiments.preview(ExperimentSource.read(file), executor, progress)
    if as_json:
        print_json(preview_to_json(found))
    else:
        print_preview(found)
    if found.refusals:
        raise click.exceptions.Exit(1)


@experiment.command("start")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--executor", help="docker or process; default: the file's, or the one in force.")
@click.option("--wait", is_flag=True, help="Stay until all runs have ended; works on them if no worker runs.")
@click.option("--yes", is_flag=True, help="Do not ask, however many runs there are.")
@json_option
@pass_cli
def start(cli: CliContext, file: Path, executor: str | None, wait: bool, yes: bool, as_json: bool) -> None:
    """Queue everything that FILE asks for. Again, it completes what was interrupted and doubles nothing."""
    hive = cli.hive()
    hive.check_writable()
    source = ExperimentSource.read(file)
    if messages.is_terminal and not (yes or as_json):
        _confirm(hive, source, executor)
    with _counting("storing") as progress:
        status = hive.experiments.start(source, executor, progress)
    if wait:
        experiment_to_end(hive, status.name)
        status = hive.experiments.status(status.name)
    elif not hive.worker_alive() and status.counts[Phase.QUEUED]:
        messages.print("no worker runs on this machine; `slamhive worker` (or `slamhive serve`) takes the queued runs")
    if as_json:
        print_json(status_to_json(status))
    else:
        print_status(status)
    if wait and status.counts[Phase.GOOD] + status.counts[Phase.UNJUDGED] < status.runs:
        raise click.exceptions.Exit(1)


@experiment.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List experiments, the newest first."""
    found = cli.hive().experiments.list()
    if as_json:
        print_json([status_to_json(status) for status in found])
    elif found:
        print_statuses(found)
    else:
        messages.print("no experiments; `slamhive experiment start FILE` starts one")


@experiment.command("status")
@click.argument("name", metavar="[NAME|FILE]", required=False)
@json_option
@pass_cli
def status_(cli: CliContext, name: str | None, as_json: bool) -> None:
    """Say how far an experiment is, or all that have not ended."""
    hive = cli.hive()
    if name is not None:
        status = hive.experiments.status(name_of(name))
        if as_json:
            print_json(status_to_json(status))
        else:
            print_status(status)
        return
    ended = (Standing.FINISHED, Standing.CANCELLED)
    found = [status for status in hive.experiments.list() if status.standing not in ended]
    if as_json:
        print_json([status_to_json(status) for status in found])
    elif found:
        print_statuses(found)
    else:
        messages.print("no experiment is under way; `slamhive experiment list` lists all")


@experiment.command("pause")
@name_argument
@pass_cli
def pause(cli: CliContext, name: str) -> None:
    """Start no further runs; those under way end as they would."""
    print_status(cli.hive().experiments.pause(name_of(name)))


@experiment.command("resume")
@name_argument
@pass_cli
def resume(cli: CliContext, name: str) -> None:
    """Go on with a paused experiment."""
    print_status(cli.hive().experiments.resume(name_of(name)))


@experiment.command("cancel")
@name_argument
@pass_cli
def cancel(cli: CliContext, name: str) -> None:
    """Cancel what is queued, and end what is under way; for good."""
    print_status(cli.hive().experiments.cancel(name_of(name)))


@experiment.command("retry-failed")
@name_argument
@pass_cli
def retry_failed(cli: CliContext, name: str) -> None:
    """Queue a new run in the place of each failed one."""
    hive = cli.hive()
    count = hive.experiments.retry_failed(name_of(name))
    click.echo(f"{count} runs queued again")


@experiment.command("add-repeats")
@name_argument
@click.argument("count", type=int)
@pass_cli
def add_repeats(cli: CliContext, name: str, count: int) -> None:
    """Run every configuration COUNT times more with each seed."""
    with _counting("storing") as progress:
        status = cli.hive().experiments.add_repeats(name_of(name), count, progress)
    print_status(status)


@experiment.command("report")
@name_argument
@click.option("--csv", "csv_file", type=click.Path(path_type=Path), help="Write the table to this file.")
@json_option
@pass_cli
def report(cli: CliContext, name: str, csv_file: Path | None, as_json: bool) -> None:
    """Print a row for each configuration: runs, failures with reasons, mean and spread of the figures.

    Figures that were taken under different protocols have rows of their own.
    """
    experiments = cli.hive().experiments
    known = name_of(name)
    axes = varying(experiments.axes(known))
    cells = experiments.report(known)
    if csv_file is not None:
        write_aside(csv_file, csv_text(cells, axes))
        messages.print(f"written to {csv_file}", markup=False, soft_wrap=True)
    elif as_json:
        print_json([cell_to_json(cell) for cell in cells])
    else:
        print_report(experiments.status(known), list(cells), axes)


def name_of(text: str) -> str:
    """The name of an experiment, given as such or by its file; a file wins where both could be meant."""
    path = Path(text)
    if path.suffix not in SUFFIXES:
        return text
    source = ExperimentSource.read(path)
    return parse_experiment(source.text, source.name).name


def _confirm(hive: Hive, source: ExperimentSource, executor: str | None) -> None:
    with _counting("checking") as progress:
        found = hive.experiments.preview(source, executor, progress)
    if found.standing is None and not found.refusals:
        print_preview(found)
        click.confirm(f"queue {found.runs} runs?", abort=True, default=True, err=True)


@contextmanager
def _counting(title: str) -> Iterator[Progress]:
    with progress_bar(title) as show:
        yield lambda done, total: show(done / total if total else 1.0, f"{done:,} of {total:,} runs")


COMMANDS = (experiment,)
