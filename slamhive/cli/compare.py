"""``slamhive compare``: a few runs side by side."""

from __future__ import annotations

from typing import Any

import click

from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli, run_number
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.documents.protocol import ComparedValue
from slamhive.domain.verdict import Outcome
from slamhive.services.run_comparison import RunComparison, read_run_ids


@click.command()
@click.argument("run_ids", type=run_number, nargs=-1, required=True, shell_complete=completion.RUN)
@click.option("--protocol", metavar="FINGERPRINT", help="Compare under this one.  [default: the one most runs have]")
@click.option(
    "--group", type=click.Choice(["configuration"]), help="One column for all repeats, with mean and interval."
)
@click.option("--all", "everything", is_flag=True, help="Also print settings and metrics that are the same.")
@json_option
@pass_cli
def compare(cli: CliContext, /, run_ids: tuple[int, ...], as_json: bool, **options: Any) -> None:
    """Compare the runs RUN_IDS: settings that differ, and metrics; * marks the better value.

    There is no mark on a tie, for a metric without a better direction, for a failed run, across datasets, and where
    repeats differ by no more than chance. The last line is the path of the same comparison on the web pages.
    """
    hive = cli.hive()
    numbers, grouped = read_run_ids(map(str, run_ids)), options["group"] is not None
    comparison = hive.run_comparisons.of(numbers, options["protocol"], grouped=grouped)
    if as_json:
        print_json(comparison.document.content)
    else:
        _print(comparison, everything=options["everything"])
    for note in _notes(comparison):
        tell(note)


def _print(comparison: RunComparison, *, everything: bool) -> None:
    kind = "configuration" if comparison.grouped else "run"
    first = [column.runs[0] for column in comparison.columns]
    heads = [f"{kind} {run.configuration_id if comparison.grouped else run.id}" for run in first]
    settings = [(line.key, *line.texts) for line in comparison.settings if everything or line.differs]
    if settings:
        print_table(("setting", *heads), settings)
        say()
    shown = [line for line in comparison.metrics if everything or line.differs]
    rows = [
        (
            line.metric.label,
            line.metric.unit or None,
            *(_figure(figure, best=place == line.best) for place, figure in enumerate(line.figures)),
        )
        for line in shown
    ]
    print_table(("metric", "unit", *heads), rows, right=heads)
    say(comparison.address)


def _figure(figure: ComparedValue | None, *, best: bool) -> str | None:
    if figure is None:
        return None
    interval = "" if figure.low is None else f" ({figure.low:.3g} to {figure.high:.3g})"
    return f"{'* ' if best else ''}{figure.shown}{interval}"


def _notes(comparison: RunComparison) -> list[str]:
    """Return the limits of the comparison."""
    if comparison.protocol is None:
        return ["none of these runs is evaluated; `slamhive evaluate` evaluates them"]
    notes = [f"protocol: {comparison.protocol.label} ({comparison.protocol.fingerprint})"]
    notes += comparison.sentences
    if comparison.mixed is not None:
        notes.append(comparison.mixed.sentences)
    lacking = comparison.protocol.lacking
    if lacking:
        numbers = " ".join(map(str, lacking))
        command = f"slamhive evaluate {numbers} --protocol {comparison.protocol.fingerprint}"
        notes.append(f"not evaluated under this protocol: run {numbers}; to change that: {command}")
    failed = {run_id for column in comparison.columns for run_id in column.failed}
    told: dict[str, list[int]] = {}
    for run in comparison.runs:
        if run.outcome is not Outcome.GOOD or run.id in failed:
            told.setdefault("failed" if run.outcome is Outcome.GOOD else run.outcome_words, []).append(run.id)
        if run.trust is not None and run.trust.doubt:
            told.setdefault(run.trust.doubt, []).append(run.id)
    notes += [f"{words}: run {', '.join(map(str, runs))}" for words, runs in told.items()]
    for kind, runs in comparison.mixed_trajectories.items():
        notes.append(f"kinds of trajectories are mixed: {kind} of run {', '.join(map(str, runs))}")
    notes += [entry.words for entry in comparison.unmarked]
    if comparison.single_runs and not comparison.marks_nothing:
        notes.append("* is the best value of one run each; repeats may change this")
    return notes


COMMANDS = (compare,)
