"""``slamhive run``: queue runs and, with ``--wait``, work on them to their end."""

from __future__ import annotations

from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.matching import print_match
from slamhive.cli.output import print_json, tell
from slamhive.cli.run_options import submission_options, submission_values
from slamhive.cli.runs import print_runs
from slamhive.cli.waiting import run_to_end
from slamhive.domain.run import RunState
from slamhive.schema.matching import Match
from slamhive.schema.submission import Submission
from slamhive.services.configurations import unwatchable


@click.command()
@click.argument("algorithm", shell_complete=offers.ALGORITHM)
@click.argument("dataset", shell_complete=offers.DATASET)
@submission_options()
@click.option("--wait", is_flag=True, help="Wait until the runs have ended; run them here if there is no worker.")
@click.option("--preview", is_flag=True, help="Only print which sensors are used and what is taken from them.")
@json_option
@pass_cli
def run(cli: CliContext, as_json: bool, wait: bool, preview: bool, **options: Any) -> None:
    """Run ALGORITHM on DATASET."""
    hive = cli.hive()
    submission = Submission(**submission_values(options))
    if preview:
        match = Match.of_match(hive.configurations.check(submission).match)
        print_json(match.content) if as_json else print_match(match)
        return
    submitted = hive.runs.submit(submission)
    unseen = unwatchable(submission.stop_when, [hive.catalogue.algorithm(submission.algorithm)])
    for note in (unseen, hive.configurations.map_note(submission)):
        if note is not None:
            tell(f"note: {note}")
    run_ids = [entry.id for entry in submitted]
    if wait:
        run_to_end(hive, run_ids, evaluate=submission.evaluate)
    elif not hive.worker_alive():
        tell("no worker is running here; start one with `slamhive worker` or `slamhive serve`")
    ended = [hive.runs.get(run_id) for run_id in run_ids]
    print_runs(ended, as_json)
    if wait and any(entry.state is not RunState.SUCCEEDED for entry in ended):
        raise click.exceptions.Exit(1)


COMMANDS = (run,)
