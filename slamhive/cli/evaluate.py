"""``slamhive evaluate``: figures and plots for runs that have succeeded."""

from __future__ import annotations

import threading

import click

from slamhive.cli.context import CliContext, choice, json_option, pass_cli, run_number
from slamhive.cli.output import counting_bar, messages, print_json
from slamhive.cli.runs import print_runs
from slamhive.domain.protocol import Alignment
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import Artefacts
from slamhive.services.evaluations import Evaluations
from slamhive.services.identity import worker_identity
from slamhive.services.run_json import run_to_json
from slamhive.store import EvaluationRecord

PAUSE_S = 0.5


@click.command()
@click.argument("run_ids", type=run_number, nargs=-1)
@click.option("--all-unevaluated", is_flag=True, help="All runs that succeeded and have no evaluation.")
@click.option("--align", type=choice(Alignment), help="Alignment; default: what the sensors deserve.")
@click.option("--plots", is_flag=True, help="Also draw the figures (trajectory, xyz, rpy, raw errors, error map).")
@json_option
@pass_cli
def evaluate(
    cli: CliContext, run_ids: tuple[int, ...], all_unevaluated: bool, align: str | None, plots: bool, as_json: bool
) -> None:
    """Evaluate runs RUN_IDS against their ground truth with evo."""
    if bool(run_ids) == all_unevaluated:
        raise InvalidInput("name the runs to evaluate, or give --all-unevaluated", "slamhive runs lists them")
    hive = cli.hive()
    hive.check_writable()
    service = hive.evaluations_service
    wanted = list(dict.fromkeys(run_ids)) or service.unevaluated()
    if not wanted:
        messages.print("every run that succeeded has been evaluated")
        print_json([]) if as_json else None
        return
    evaluation_ids = service.queue(wanted, align, Artefacts.PLOTS if plots else Artefacts.FILES)
    ended = _work_until_ended(service, evaluation_ids, frozenset(wanted))
    reasons = {record.run_id: record.reason for record in ended if record.reason is not None}
    entries = [hive.run(run_id) for run_id in wanted]
    if as_json:
        print_json([{**run_to_json(e), "evaluation_reason": reasons.get(e.id)} for e in entries])
    else:
        print_runs(entries, as_json=False)
    for run_id, reason in reasons.items():
        messages.print(f"run {run_id} cannot be evaluated: {reason}", markup=False, soft_wrap=True)
    if reasons:
        raise click.exceptions.Exit(1)


def _work_until_ended(
    service: Evaluations, evaluation_ids: list[int], run_ids: frozenset[int]
) -> list[EvaluationRecord]:
    """Work on the evaluations, or wait for the worker that does; the evaluations as they ended."""
    stopping = threading.Event()
    with counting_bar("evaluating", len(evaluation_ids)) as show:
        while True:
            worked = service.work_once(worker_identity(), stopping, run_ids)
            records = service.records(evaluation_ids)
            ended = [record for record in records if record.ended_at is not None]
            show(len(ended), "")
            if len(ended) == len(records):
                return records
            if not worked:
                stopping.wait(PAUSE_S)


COMMANDS = (evaluate,)
