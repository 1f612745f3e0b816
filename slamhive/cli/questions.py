"""``slamhive experiment decide``: an experiment that runs only what its answer takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.cli.waiting import experiment_to_end
from slamhive.domain.question import ExperimentQuestion, QuestionAnswer
from slamhive.experiments.file import parse_experiment
from slamhive.services.experiments import ExperimentSource

if TYPE_CHECKING:
    from slamhive.documents.question import Decision

UNDECIDED = 3
"""The exit code of a gate that cannot decide, too."""


@click.command("decide", short_help="Find the best candidate with few runs")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--executor", help="As for `slamhive experiment start`.")
@click.option("--no-wait", is_flag=True, help="Only start it; a worker takes it to its end.")
@json_option
@pass_cli
def decide(cli: CliContext, file: Path, executor: str | None, no_wait: bool, as_json: bool) -> None:
    """Find out which candidate of FILE is best, with no more runs than that takes.

    The section `decide` of FILE says what is compared, which difference does not matter, and the budget. After a kill,
    the same command goes on. The exit code is 3 if the budget does not suffice to decide.
    """
    hive = cli.hive()
    hive.check_writable()
    source = ExperimentSource.read(file)
    asked = parse_experiment(source.text, source.name)
    if asked.question is not ExperimentQuestion.DECIDE:
        raise InvalidInput(f"{file} has no section decide", "docs/deciding.md shows one")
    name = hive.experiments.start(source, executor).name
    hive.questions.unfinished(name)
    if not no_wait:
        experiment_to_end(hive, name)
    found = hive.questions.decision(name)
    if as_json:
        print_json(found.content)
    else:
        print_decision(found)
    if found.answer is QuestionAnswer.UNDECIDED:
        raise click.exceptions.Exit(UNDECIDED)


def print_decision(found: Decision) -> None:
    """Print the candidates, the best first, and the answer."""
    unit = f" {found.unit}" if found.unit else ""
    heads = ("candidate", "", "rounds", "runs", "failed", f"{found.label}{unit}", "behind the best", "beaten by")
    rows = [
        (
            entry.label,
            entry.standing.value,
            entry.rounds,
            entry.runs,
            entry.failed or None,
            None if entry.mean is None else f"{entry.mean:.4g}",
            None
            if entry.difference is None or not entry.difference_within
            else f"{entry.difference:.3g} ± {entry.difference_within:.2g}",
            entry.beaten_by,
        )
        for entry in found.candidates
    ]
    print_table(heads, rows, right=heads[2:7])
    for note in found.notes:
        tell(note)
    say(f"{found.experiment}: {found.words}")
    if found.next:
        say(f"next: {found.next}")
