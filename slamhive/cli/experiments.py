"""``slamhive experiment``: preview, start, watch, pause, cancel, retry, report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.cli import completion
from slamhive.cli.context import CliContext, id_option, json_option, pass_cli
from slamhive.cli.main import LazyGroup
from slamhive.cli.output import messages, print_json, print_table, progress_bar, tell
from slamhive.cli.sharing import share_experiment, visibility_option
from slamhive.cli.visible import confirm, say, write_out
from slamhive.cli.waiting import experiment_to_end
from slamhive.documents.plain import ConfigurationStanding, ExperimentStatusDocument
from slamhive.domain.accounts import Visibility
from slamhive.domain.names import mean_and_std, plural
from slamhive.domain.parameters import Value
from slamhive.domain.run import FailureReason
from slamhive.domain.verdict import DEFAULT_RULE, Outcome, failure_words
from slamhive.services.experiments import (
    GUESSED_START_S,
    NO_FIGURES,
    ExperimentSource,
    csv_text,
    failures_text,
    varying,
)

if TYPE_CHECKING:
    from slamhive.documents.experiment import ExperimentAnswerDocument, ExperimentPreviewDocument, NodesPlanDocument
    from slamhive.services.experiments import (
        Cell,
        MetricSpread,
        Progress,
    )
    from slamhive.services.hive import Hive

# Experiments on the terminal: the plan, the progress, the report.


FIGURES = (
    ("ATE m", "ate.rmse", 1.0),
    ("tracked", "tracked_fraction", 1.0),
    ("CPU cores", "cpu.mean", 1.0),
    ("RAM MB", "ram.max", 1e-6),
    ("time s", "duration", 1.0),
)
"""Heading, metric and factor of the metrics of a report."""


def print_preview(found: ExperimentPreviewDocument) -> None:
    """Print the preview of an experiment."""
    merged = f", {found.merged} of them identical to another" if found.merged else ""
    looks = f", and {plural(found.first_looks, 'first look')} at clips" if found.first_looks else ""
    say(
        f"{found.name}: {found.combinations:,} combinations, {found.cells - found.first_looks:,} "
        f"configurations{merged}{looks}"
    )
    varied = ", ".join(f"{axis} {count}" for axis, count in found.axes.items()) or "nothing varies"
    say(f"varied: {varied}")
    say(f"runs: {found.runs:,}; about {_time(found.time_s)} on {_places(found)}, {_basis(found)}")
    shares = [("to make variants", found.variant_time_s), ("to build packages", found.build_time_s)]
    parts = [f"{_time(time_s)} {words}" for words, time_s in shares if time_s]
    say(f"of this: {', '.join([*parts, f'{found.between_s:.1f} s to prepare, collect and evaluate each run'])}")
    if found.cluster is not None:
        say(_moved(found.cluster))
    if found.repeat_disturbed:
        say(f"disturbed runs: each is repeated up to {plural(found.repeat_disturbed, 'time')}, not counted here")
    if found.known_cells:
        say(f"stored already: {found.known_cells:,} of the configurations, with {found.known_runs:,} runs")
    missing = sum(not need.made for need in found.variants)
    say(
        f"variants: {len(found.variants)} needed, {missing} to be made, {found.variant_bytes / 1e6:,.0f} MB at most; "
        f"run folders: {found.run_bytes / 1e6:,.0f} MB; free: {found.free_bytes / 1e6:,.0f} MB"
    )
    if found.standing is not None:
        say(f"this experiment exists already: {found.standing}")
    axes = [axis for axis in found.rows[0].values if len({str(row.values.get(axis)) for row in found.rows}) > 1]
    print_table(
        ("name", *axes, "runs so far"),
        [(row.name, *(_value(row.values, axis) for axis in axes), row.known_runs or None) for row in found.rows],
        right=("runs so far",),
    )
    if found.cells > len(found.rows):
        say(f"… and {found.cells - len(found.rows):,} more")
    for text in found.warnings:
        tell(f"warning: {text}", style="yellow")
    if found.mixed is not None:
        tell(f"warning: {found.mixed.sentences}", style="yellow")
    for text in found.refusals:
        tell(f"refused: {text}", style="bold red")


def _places(found: ExperimentPreviewDocument) -> str:
    return plural(found.slots, "slot") if found.cluster is None else plural(found.slots, "node")


def _moved(cluster: NodesPlanDocument) -> str:
    idle = cluster.nodes - cluster.used_nodes
    without_run = f"; {plural(idle, 'node')} without a run" if idle else ""
    return (
        f"data to move: {cluster.moved_bytes / 1e9:,.2f} GB in all, at most {cluster.node_bytes / 1e9:,.2f} GB "
        f"to a node, at {cluster.bytes_per_s / 1e6:.0f} MB/s{without_run}"
    )


def _basis(found: ExperimentPreviewDocument) -> str:
    if found.measured_runs == found.runs:
        return "by earlier runs"
    guess = f"by the length of the recordings and {GUESSED_START_S:g} s to start"
    return guess if not found.measured_runs else f"{found.measured_runs:,} by earlier runs, the others {guess}"


def print_status(status: ExperimentStatusDocument) -> None:
    """Print the progress of one experiment."""
    counts = ", ".join(f"{count:,} {phase.label}" for phase, count in status.counts.items() if count)
    say(f"{status.name}: {status.state}; {status.runs:,} runs of {status.cells:,} configurations: {counts}")
    failures = {key: count for key, count in status.failures.items() if key is not FailureReason.LOST}
    if failures:
        say(f"failed: {', '.join(f'{failure_words(failure)} {count:,}' for failure, count in failures.items())}")
    if status.retried:
        say(f"not counted: {plural(status.retried, 'failed or disturbed run')} that another run replaces")
    if status.disturbed:
        say(f"measured on a disturbed machine: {plural(status.disturbed, 'run')} (filter: disturbed = yes)")
    if status.state is ConfigurationStanding.STORING:
        say(f"{status.missing:,} runs are not stored yet; starting the same file again completes it")
    if status.left is not None and status.left_s and status.state is ConfigurationStanding.ACTIVE:
        say(f"{status.left.words(', including builds and evaluations')}; now: {status.phase}")


def print_statuses(found: Sequence[ExperimentStatusDocument]) -> None:
    """Print one line for each experiment."""
    columns = (
        "no.",
        "name",
        "state",
        "configurations",
        "runs",
        *(outcome.label for outcome in Outcome),
        "created (UTC)",
    )
    rows = [
        (
            status.number,
            status.name,
            status.state.value,
            status.cells,
            status.runs,
            *(status.counts[outcome] or None for outcome in Outcome),
            f"{status.created_at:%Y-%m-%d %H:%M}",
        )
        for status in found
    ]
    print_table(columns, rows, right=("no.", "configurations", "runs", *(outcome.label for outcome in Outcome)))


def print_report(status: ExperimentStatusDocument, cells: Sequence[Cell], axes: Sequence[str]) -> None:
    """Print a row for each cell and protocol: counts, and mean ± standard deviation of the metrics."""
    ate, *others = (heading for heading, *_ in FIGURES)
    headings = (ate, "median", *others)
    columns = ("cell", *axes, "runs", "good", "failed", "failures", "disturbed", *headings, "protocol")
    _, median_key, median_factor = FIGURES[0]
    rows: list[tuple[Any, ...]] = []
    for cell in cells:
        for figures in cell.figures or (NO_FIGURES,):
            first, *rest = (_spread(figures.metrics.get(key), factor) for _, key, factor in FIGURES)
            median = figures.metrics.get(median_key)
            rows.append(
                (
                    cell.number,
                    *(_value(cell.values, axis) for axis in axes),
                    len(cell.runs),
                    cell.counts[Outcome.GOOD],
                    sum(cell.failures.values()) or None,
                    failures_text(cell),
                    figures.disturbed or None,
                    first,
                    None if median is None else mean_and_std(median.median * median_factor, None),
                    *rest,
                    figures.protocol[:8] if figures.protocol else None,
                )
            )
    numbers = ("cell", "runs", "good", "failed", "disturbed", *headings)
    print_table(columns, rows, right=numbers, spare=("failures", "time s", "disturbed", "median"))
    print_status(status)
    say("metrics: mean ± standard deviation of the runs that did not fail; failed ones are counted")
    say(DEFAULT_RULE.words)
    say("disturbed: how many of these were measured on a disturbed machine and are not replaced")


def print_answer(found: ExperimentAnswerDocument) -> None:
    """Print the question, the answer, that on each dataset if there are several, and what is left out."""
    say(found.question)
    say(found.sentence)
    for entry in found.datasets if len(found.datasets) > 1 else ():
        say(f"{entry.dataset}: {entry.sentence}")
    for note in found.notes:
        say(f"note: {note}")


def _spread(found: MetricSpread | None, factor: float) -> str | None:
    if found is None:
        return None
    return mean_and_std(found.mean * factor, None if found.std is None else found.std * factor)


def _value(values: Mapping[str, Value], axis: str) -> str | None:
    value = values.get(axis)
    return None if value is None else " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


SUFFIXES = (".yaml", ".yml")
MOST_NODES = 10_000
name_argument = click.argument("name", metavar="NAME|FILE", shell_complete=completion.EXPERIMENT)


@click.group(cls=LazyGroup, modules={"decide": "questions", "optimise": "questions"})
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
        print_json(found.content)
    else:
        print_preview(found)
    if found.refusals:
        raise click.exceptions.Exit(1)


@experiment.command("convert", short_help="Convert a combination file of the published system")
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
    elif not hive.worker_alive() and status.counts[Outcome.QUEUED]:
        tell("no worker is running here; start one with `slamhive worker` or `slamhive serve`")
    _show_status(status, as_json)
    if wait and status.counts[Outcome.GOOD] + status.counts[Outcome.UNJUDGED] < status.runs:
        raise click.exceptions.Exit(1)


@experiment.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List experiments, newest first."""
    found = cli.hive().experiments.list()
    if as_json:
        print_json([status.content for status in found])
    elif found:
        print_statuses(found)
    else:
        tell("no experiments; `slamhive experiment start FILE` starts one")


@experiment.command("status", short_help="Show the progress of one or all unfinished")
@click.argument("name", metavar="[NAME|FILE]", required=False, shell_complete=completion.EXPERIMENT)
@json_option
@pass_cli
def status_(cli: CliContext, name: str | None, as_json: bool) -> None:
    """Show the progress of an experiment, or of all unfinished ones."""
    hive = cli.hive()
    if name is not None:
        _show_status(hive.experiments.status(name_of(name)), as_json)
        return
    ended = (ConfigurationStanding.FINISHED, ConfigurationStanding.CANCELLED)
    found = [status for status in hive.experiments.list() if status.state not in ended]
    if as_json:
        print_json([status.content for status in found])
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


@experiment.command("answer", short_help="Say who is best, and what would decide")
@name_argument
@json_option
@pass_cli
def answer(cli: CliContext, name: str, as_json: bool) -> None:
    """Print the question and its answer: who is best, by which test, or the repeats that would decide."""
    found = cli.hive().experiments.answer(name_of(name))
    if as_json:
        print_json(found.content)
    else:
        print_answer(found)


@experiment.command("report", short_help="Print a row for each configuration")
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
        from slamhive.documents import experiment as schema  # noqa: PLC0415 - tables need no model

        print_json([schema.CellDocument.of(cell).content for cell in cells])
    else:
        print_report(experiments.status(known), list(cells), axes)
        print_answer(experiments.answer(known))


def _show_status(status: ExperimentStatusDocument, as_json: bool) -> None:
    if as_json:
        print_json(status.content)
    else:
        print_status(status)


def name_of(text: str) -> str:
    """The name of an experiment, given directly or by its file."""
    path = Path(text)
    if path.suffix not in SUFFIXES:
        return text
    from slamhive.experiments.file import parse_experiment  # noqa: PLC0415 - most commands take a name

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
