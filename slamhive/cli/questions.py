"""``slamhive experiment decide`` and ``optimise``: experiments that run only what their answer takes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.cli.waiting import experiment_to_end
from slamhive.documents.experiment import all_failed
from slamhive.domain.names import value_within
from slamhive.domain.question import ExperimentQuestion, QuestionAnswer
from slamhive.experiments.file import parse_experiment
from slamhive.services.experiments import ExperimentSource

if TYPE_CHECKING:
    from slamhive.documents.experiment import Decision, SearchStanding
    from slamhive.services.hive import Hive

UNDECIDED = 3
"""The exit code of a gate that cannot decide, too."""


def _options(command: Callable[..., None]) -> Callable[..., None]:
    """The argument and options of both commands."""
    for option in (
        pass_cli,
        json_option,
        click.option("--no-wait", is_flag=True, help="Only start it; a worker takes it to its end."),
        click.option("--executor", help="As for `slamhive experiment start`."),
        click.argument("file", type=click.Path(path_type=Path)),
    ):
        command = option(command)
    return command


@click.command("decide", short_help="Find the best candidate with few runs")
@_options
def decide(cli: CliContext, file: Path, executor: str | None, no_wait: bool, as_json: bool) -> None:
    """Find out which candidate of FILE is best, with no more runs than that takes.

    The section `decide` of FILE says what is compared, which difference does not matter, and the budget. After a kill,
    the same command goes on. The exit code is 3 if the budget does not suffice to decide.
    """
    hive = cli.hive()
    name = _taken_to_its_end(hive, file, ExperimentQuestion.DECIDE, executor, no_wait)
    found = hive.questions.decision(name)
    print_json(found.content) if as_json else print_decision(found)
    if found.answer is QuestionAnswer.UNDECIDED:
        raise click.exceptions.Exit(UNDECIDED)


@click.command("optimise", short_help="Search the combinations for the best")
@_options
def optimise(cli: CliContext, file: Path, executor: str | None, no_wait: bool, as_json: bool) -> None:
    """Search the combinations of FILE for the best one, with no more runs than that takes.

    The section `optimise` of FILE says what is to be best, what a run must keep, how near is near enough, and the
    budget. After a kill, the same command goes on. The exit code is 3 if the budget is spent before it is near enough.
    """
    hive = cli.hive()
    name = _taken_to_its_end(hive, file, ExperimentQuestion.OPTIMISE, executor, no_wait)
    found = hive.questions.search(name)
    print_json(found.content) if as_json else print_search(found)
    if found.answer is QuestionAnswer.UNDECIDED:
        raise click.exceptions.Exit(UNDECIDED)


def _taken_to_its_end(hive: Hive, file: Path, question: ExperimentQuestion, executor: str | None, no_wait: bool) -> str:
    """Start the experiment in a file, and wait unless asked not to; returns its name."""
    hive.check_writable()
    source = ExperimentSource.read(file)
    if parse_experiment(source.text, source.name).question is not question:
        raise InvalidInput(f"{file} has no section {question}", "docs/deciding.md shows one")
    name = hive.experiments.start(source, executor).name
    hive.questions.unfinished(name)
    if not no_wait:
        experiment_to_end(hive, name)
    return name


def print_search(found: SearchStanding) -> None:
    """Print the candidates that may be best, what matters, and the answer."""
    unit = f" {found.unit}" if found.unit else ""
    others = [f"{other.label}{f' {other.unit}' if other.unit else ''}" for other in found.against]
    heads = ("candidate", "runs", "failed", f"{found.label}{unit}", "from", "to", "failing", *others)
    rows = [
        (
            entry.label,
            entry.runs,
            entry.failed or None,
            all_failed(entry.runs, entry.failed) or _number(entry.expected),
            _number(entry.low),
            _number(entry.high),
            f"{entry.failing:.0%}",
            *(_number(value.expected) for value in entry.against.values()),
        )
        for entry in found.candidates
    ]
    if rows:
        print_table(heads, rows, right=heads[1:])
        for key, label in ((found.metric, found.label), *((other.metric, other.label) for other in found.against)):
            shares = ", ".join(f"{one.axis} {one.share:.0%}" for one in found.importance if one.objective == key)
            say(f"what matters for {label}: {shares}")
    for note in found.notes:
        tell(note)
    say(f"{found.experiment}: {found.words}")
    if found.expected_gain is not None and found.answer is not QuestionAnswer.BEST:
        say(f"going on may gain {found.expected_gain:.1%} on average")
    if found.next:
        say(f"next: {found.next}")


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.4g}"


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
            all_failed(entry.runs, entry.failed) or _number(entry.mean),
            None
            if entry.difference is None or not entry.difference_within
            else value_within(entry.difference, entry.difference_within),
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


COMMANDS = (decide, optimise)
