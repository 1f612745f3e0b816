"""``slamhive experiment``: preview, start, watch, pause, cancel, retry, report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.experiment_tables import print_preview, print_report, print_status, print_statuses
from slamhive.cli.meanings import id_option
from slamhive.cli.output import messages, print_json, progress_bar, tell
from slamhive.cli.sharing import share_experiment, visibility_option
from slamhive.cli.visible import confirm, say, write_out
from slamhive.cli.waiting import experiment_to_end
from slamhive.domain.visibility import Visibility
from slamhive.errors import InvalidInput
from slamhive.files import write_aside
from slamhive.schema import experiment as schema
from slamhive.services.experiments import (
    ExperimentSource,
    ExperimentStatus,
    Phase,
    Progress,
    Standing,
    csv_text,
    varying,
)
from slamhive.services.hive import Hive
from slamhive.sweep.experiment_file import parse_experiment

SUFFIXES = (".yaml", ".yml")
MOST_NODES = 10_000
name_argument = click.argument("name", metavar="NAME|FILE", shell_complete=offers.EXPERIMENT)


@click.group()
def experiment() -> None:
    """Run many configurations from one file."""


@experiment.command("plan")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--executor", help="An executor that `slamhive doctor --all` lists; default: the file's, or the one in force."
)
@click.option("--nodes", type=click.IntRange(1, MOST_NODES), help="Plan for so many nodes of a cluster.")
@json_option
@pass_cli
def plan(cli: CliContext, file: Path, executor: str | None, nodes: int | None, as_json: bool) -> None:
    """Preview FILE; nothing is stored. Exits with 1 if starting it would be refused.

    With --nodes, the time and the data to move are those of so many nodes, each with one run at a time.
    """
    with _counting("checking") as progress:
        found = cli.hive().experiments.preview(ExperimentSource.read(file), executor, progress, nodes)
    if as_json:
        print_json(schema.ExperimentPreview.of(found).content)
    else:
        print_preview(found)
    if found.refusals:
        raise click.exceptions.Exit(1)


@experiment.command("convert")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Write to this file; a folder if FILE holds several.")
@id_option
@pass_cli
def convert(cli: CliContext, file: Path, out: Path | None, ids: dict[str, str]) -> None:
    """Convert FILE, a combination file of the published SLAM Hive, to an experiment file.

    What cannot be converted is named on stderr and in comments of the experiment.
    """
    made = cli.hive(indexed=False).experiments.convert(ExperimentSource.read(file), ids)
    if len(made) > 1 and (out is None or (out.exists() and not out.is_dir())):
        raise InvalidInput(f"{file} holds {len(made)} combinations", "name a folder for them: --out FOLDER")
    for entry in made:
        for note in entry.notes:
            tell(f"{entry.name}: {note}" if len(made) > 1 else note, style="yellow")
        if out is None:
            write_out(entry.text)
            continue
        path = out / f"{entry.name}.yaml" if len(made) > 1 or out.is_dir() else out
        if path.exists():
            raise InvalidInput(f"{path} exists already", "choose another place")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, entry.text)
        tell(f"written to {path}; preview it: slamhive experiment plan {path}")


@experiment.command("start")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--executor", help="An executor that `slamhive doctor --all` lists; default: the file's, or the one in force."
)
@visibility_option
@click.option("--wait", is_flag=True, help="Wait until all runs have ended; run them here if there is no worker.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@json_option
@pass_cli
def start(cli: CliContext, /, file: Path, wait: bool, as_json: bool, **options: Any) -> None:
    """Queue all runs of FILE. Running it again completes an interrupted start; no run is queued twice."""
    hive = cli.hive()
    hive.check_writable()
    source = ExperimentSource.read(file)
    executor, visibility = options["executor"], options["visibility"]
    if messages.is_terminal and not (options["yes"] or as_json):
        _confirm(hive, source, executor)
    seen_by = None if visibility is None else Visibility(visibility)
    with _counting("storing") as progress:
        status = hive.experiments.start(source, executor, progress, seen_by)
    if wait:
        experiment_to_end(hive, status.name)
        status = hive.experiments.status(status.name)
    elif not hive.worker_alive() and status.counts[Phase.QUEUED]:
        tell("no worker is running here; start one with `slamhive worker` or `slamhive serve`")
    _show_status(status, as_json)
    if wait and status.counts[Phase.GOOD] + status.counts[Phase.UNJUDGED] < status.runs:
        raise click.exceptions.Exit(1)


@experiment.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List experiments, newest first."""
    found = cli.hive().experiments.list()
    if as_json:
        print_json([schema.ExperimentStatus.of(status).content for status in found])
    elif found:
        print_statuses(found)
    else:
        tell("no experiments; `slamhive experiment start FILE` starts one")


@experiment.command("status")
@click.argument("name", metavar="[NAME|FILE]", required=False, shell_complete=offers.EXPERIMENT)
@json_option
@pass_cli
def status_(cli: CliContext, name: str | None, as_json: bool) -> None:
    """Show the progress of an experiment, or of all unfinished ones."""
    hive = cli.hive()
    if name is not None:
        _show_status(hive.experiments.status(name_of(name)), as_json)
        return
    ended = (Standing.FINISHED, Standing.CANCELLED)
    found = [status for status in hive.experiments.list() if status.standing not in ended]
    if as_json:
        print_json([schema.ExperimentStatus.of(status).content for status in found])
    elif found:
        print_statuses(found)
    else:
        tell("no unfinished experiment; `slamhive experiment list` lists all")


@experiment.command("pause")
@name_argument
@json_option
@pass_cli
def pause(cli: CliContext, name: str, as_json: bool) -> None:
    """Stop starting runs; active runs continue."""
    _show_status(cli.hive().experiments.pause(name_of(name)), as_json)


@experiment.command("resume")
@name_argument
@json_option
@pass_cli
def resume(cli: CliContext, name: str, as_json: bool) -> None:
    """Continue a paused experiment."""
    _show_status(cli.hive().experiments.resume(name_of(name)), as_json)


@experiment.command("cancel")
@name_argument
@json_option
@pass_cli
def cancel(cli: CliContext, name: str, as_json: bool) -> None:
    """Cancel all queued and active runs, for good."""
    _show_status(cli.hive().experiments.cancel(name_of(name)), as_json)


@experiment.command("retry-failed")
@name_argument
@json_option
@pass_cli
def retry_failed(cli: CliContext, name: str, as_json: bool) -> None:
    """Queue a new run for each failed one."""
    hive = cli.hive()
    count = hive.experiments.retry_failed(name_of(name))
    if as_json:
        print_json({"queued": count})
    else:
        say(f"{count} runs queued again")


@experiment.command("add-repeats")
@name_argument
@click.argument("count", type=int)
@json_option
@pass_cli
def add_repeats(cli: CliContext, name: str, count: int, as_json: bool) -> None:
    """Run every configuration COUNT more times with each seed."""
    with _counting("storing") as progress:
        status = cli.hive().experiments.add_repeats(name_of(name), count, progress)
    _show_status(status, as_json)


@experiment.command("report")
@name_argument
@click.option("--csv", "csv_file", type=click.Path(path_type=Path), help="Write the table to this CSV file.")
@json_option
@pass_cli
def report(cli: CliContext, name: str, csv_file: Path | None, as_json: bool) -> None:
    """Print a row for each configuration: runs, failures with reasons, mean and spread of the metrics.

    Each protocol has its own row.
    """
    experiments = cli.hive().experiments
    known = name_of(name)
    axes = varying(experiments.axes(known))
    cells = experiments.report(known)
    if csv_file is not None:
        write_aside(csv_file, csv_text(cells, axes))
        tell(f"written to {csv_file}")
    elif as_json:
        print_json([schema.Cell.of(cell).content for cell in cells])
    else:
        print_report(experiments.status(known), list(cells), axes)


def _show_status(status: ExperimentStatus, as_json: bool) -> None:
    if as_json:
        print_json(schema.ExperimentStatus.of(status).content)
    else:
        print_status(status)


def name_of(text: str) -> str:
    """The name of an experiment, given directly or by its file."""
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
        confirm(f"queue {found.runs} runs?", default=True)


@contextmanager
def _counting(title: str) -> Iterator[Progress]:
    with progress_bar(title) as show:
        yield lambda done, total: show(done / total if total else 1.0, f"{done:,} of {total:,} runs")


experiment.add_command(share_experiment)
COMMANDS = (experiment,)
