"""``slamhive evaluate``: figures and plots for runs that have succeeded."""

from __future__ import annotations

import threading

import click

from slamhive.cli.context import CliContext, choice, json_option, pass_cli, run_number
from slamhive.cli.output import counting_bar, messages, print_json
from slamhive.cli.runs import print_runs
from slamhive.domain.protocol import Alignment
from slamhive.domain.protocol_request import ProtocolRequest
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import Artefacts
from slamhive.services.current_protocols import CurrentProtocols
from slamhive.services.evaluations import Evaluations
from slamhive.services.hive import Hive
from slamhive.services.identity import worker_identity
from slamhive.services.run_json import run_to_json
from slamhive.store import EvaluationRecord

PAUSE_S = 0.5


@click.command()
@click.argument("run_ids", type=run_number, nargs=-1)
@click.option("--all-unevaluated", is_flag=True, help="All runs that succeeded and have no evaluation.")
@click.option("--protocol", metavar="NAME|FILE", help="`slamhive protocol list` names them; default: by the sensors.")
@click.option("--align", type=choice(Alignment), help="Short for a protocol of this alignment, the rest by default.")
@click.option("--current", is_flag=True, help="Lists and pages shall show the figures of this protocol from now on.")
@click.option("--plots", is_flag=True, help="Also draw the figures (trajectory, xyz, rpy, raw errors, error map).")
@json_option
@pass_cli
def evaluate(
    cli: CliContext,
    /,
    run_ids: tuple[int, ...],
    all_unevaluated: bool,
    current: bool,
    plots: bool,
    as_json: bool,
    **protocol: str | None,
) -> None:
    """Evaluate runs RUN_IDS against their ground truth.

    A run keeps the figures of every protocol it was evaluated under. Shown are those of the first, until --current
    or `slamhive protocol use` chooses another.
    """
    if bool(run_ids) == all_unevaluated:
        raise InvalidInput("name the runs to evaluate, or give --all-unevaluated", "slamhive runs lists them")
    hive = cli.hive()
    hive.check_writable()
    asked = _asked(hive, **protocol)
    service = hive.evaluations_service
    wanted = list(dict.fromkeys(run_ids)) or service.unevaluated()
    if not wanted:
        messages.print("every run that succeeded has been evaluated")
        print_json([]) if as_json else None
        return
    evaluation_ids = service.queue(wanted, asked, Artefacts.PLOTS if plots else Artefacts.FILES)
    place = {run_id: index for index, run_id in enumerate(wanted)}
    ended = work_until_ended(service, evaluation_ids, frozenset(wanted))
    ended.sort(key=lambda record: place[record.run_id])
    if current:
        hive.current_protocols.make_current(ended)
    _report(hive.current_protocols, ended, as_json=as_json)
    if any(record.reason is not None for record in ended):
        raise click.exceptions.Exit(1)


def _asked(hive: Hive, protocol: str | None, align: str | None) -> ProtocolRequest | None:
    if protocol is not None and align is not None:
        raise InvalidInput("--protocol and --align exclude each other", "write the alignment into the protocol")
    name = protocol if align is None else align
    return None if name is None else hive.protocols.find(name)


def _report(service: CurrentProtocols, ended: list[EvaluationRecord], *, as_json: bool) -> None:
    """The runs with the figures of the protocol they were evaluated under; failures on stderr."""
    reasons = {record.run_id: record.reason for record in ended if record.reason is not None}
    entries = service.as_evaluated(ended)
    if as_json:
        print_json([{**run_to_json(entry), "evaluation_reason": reasons.get(entry.id)} for entry in entries])
    else:
        print_runs(entries, as_json=False)
    for run_id, reason in reasons.items():
        messages.print(f"run {run_id} cannot be evaluated: {reason}", markup=False, soft_wrap=True)
    others = service.shown_otherwise(ended)
    if others:
        numbers = " ".join(map(str, others))
        fingerprint = next(record.protocol.fingerprint for record in ended if record.run_id == others[0])
        messages.print(
            f"lists go on showing other figures of run {numbers}; to change that: "
            f"slamhive protocol use {fingerprint} {numbers}",
            markup=False,
            soft_wrap=True,
        )


def work_until_ended(
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
