"""``slamhive evaluate``: metrics and plots of successful runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.batches import evaluate_to_end
from slamhive.cli.context import CliContext, choice, json_option, pass_cli, run_number
from slamhive.cli.hints import hints_of, print_hints
from slamhive.cli.output import print_json, tell
from slamhive.cli.runs import print_runs
from slamhive.domain.hint import Hint
from slamhive.domain.numbers import plural
from slamhive.domain.protocol import Alignment, Duplicates
from slamhive.domain.protocol_request import ProtocolRequest
from slamhive.domain.run import RunState
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import Artefacts
from slamhive.schema.model import dump
from slamhive.schema.run import Run
from slamhive.search.build import matching
from slamhive.search.grammar import join
from slamhive.services.hive import Hive
from slamhive.store import EvaluationRecord

_NAMED_RUNS = 20


@click.command()
@click.argument("run_ids", type=run_number, nargs=-1, shell_complete=offers.RUN)
@click.option("--all-unevaluated", is_flag=True, help="All successful runs that are not evaluated yet.")
@click.option("--where", metavar="FILTER", help="All successful runs that match, e.g. 'dataset ~ MH_*'.")
@click.option("--protocol", metavar="NAME|FILE", help="See `slamhive protocol list`; default: chosen from the sensors.")
@click.option("--align", type=choice(Alignment), help="Alignment; other fields of the protocol keep their defaults.")
@click.option("--duplicates", type=choice(Duplicates), help="Which poses count where a timestamp occurs twice.")
@click.option("--current", is_flag=True, help="Show the metrics of this protocol in lists and pages from now on.")
@click.option("--plots", is_flag=True, help="Also draw plots (trajectory, xyz, rpy, raw errors, error map).")
@json_option
@pass_cli
def evaluate(cli: CliContext, /, run_ids: tuple[int, ...], as_json: bool, **options: Any) -> None:
    """Evaluate runs RUN_IDS against their ground truth.

    A run keeps the metrics of every protocol it was evaluated under. Lists show those of the first, until --current
    or `slamhive protocol use` selects another. If the command is interrupted, the other evaluations stay queued.
    """
    if bool(run_ids) + options["all_unevaluated"] + (options["where"] is not None) != 1:
        raise InvalidInput(
            "name the runs to evaluate, or give --all-unevaluated, or --where: one of the three",
            "slamhive runs lists them",
        )
    hive = cli.hive()
    hive.check_writable()
    asked = _asked(hive, options["protocol"], options["align"], options["duplicates"])
    service = hive.evaluations
    waiting: list[int] = []
    if options["all_unevaluated"]:
        wanted, waiting = service.unevaluated(), [record.id for record in service.waiting()]
    else:
        wanted = list(dict.fromkeys(run_ids)) if run_ids else _succeeded(hive, options["where"])
    if not wanted and not waiting:
        none = "every run that succeeded has been evaluated" if options["all_unevaluated"] else "no such run succeeded"
        tell(none)
        print_json([]) if as_json else None
        return
    evaluation_ids = service.queue(wanted, asked, Artefacts.PLOTS if options["plots"] else Artefacts.FILES)
    ended = evaluate_to_end(service, list(dict.fromkeys([*waiting, *evaluation_ids])))
    place = {run_id: index for index, run_id in enumerate(wanted)}
    ended.sort(key=lambda record: (place.get(record.run_id, -1), record.id))
    if options["current"]:
        hive.current_protocols.make_current(ended)
    _report(hive, ended, as_json=as_json)
    if any(record.reason is not None for record in ended):
        raise click.exceptions.Exit(1)


def _succeeded(hive: Hive, where: str) -> list[int]:
    """The runs that match the filter and succeeded; raises InvalidInput pointing at a mistake in it."""
    search, succeeded = hive.searches.read(where), matching(states=(RunState.SUCCEEDED,))
    parts = [tree for tree in (search.tree, succeeded.tree) if tree is not None]
    return hive.searches.run_ids(replace(search, tree=join("and", parts)))


def _asked(hive: Hive, protocol: str | None, align: str | None, duplicates: str | None) -> ProtocolRequest | None:
    if protocol is not None and align is not None:
        raise InvalidInput("--protocol and --align exclude each other", "write the alignment into the protocol")
    name = protocol if align is None else align
    asked = None if name is None else hive.protocols.find(name)
    if duplicates is None:
        return asked
    asked = asked or ProtocolRequest()
    return ProtocolRequest({**asked.values, "duplicates": duplicates}, asked.name)


def _report(hive: Hive, ended: list[EvaluationRecord], *, as_json: bool) -> None:
    """Print the runs with the metrics of this evaluation; hints and failures go to stderr."""
    service = hive.current_protocols
    hints = hints_of(hive, ended)
    reasons = {record.run_id: record.reason for record in ended if record.reason is not None}
    entries = service.as_evaluated(ended)
    if as_json:
        print_json([_evaluated(Run.of(entry), reasons, hints) for entry in entries])
    else:
        print_runs(entries, as_json=False)
    print_hints(hints)
    for run_id, reason in reasons.items():
        tell(f"run {run_id} cannot be evaluated: {reason}")
    others = service.shown_otherwise(ended)
    if others:
        if len(others) > _NAMED_RUNS:
            words = f"{plural(len(others), 'run')}; to change that: the same command with --current"
        else:
            numbers = " ".join(map(str, others))
            fingerprint = next(record.protocol.fingerprint for record in ended if record.run_id == others[0])
            words = f"run {numbers}; to change that: slamhive protocol use {fingerprint} {numbers}"
        tell(f"lists still show metrics of another protocol for {words}")


def _evaluated(run: Run, reasons: Mapping[int, str], hints: Mapping[int, tuple[Hint, ...]]) -> dict[str, Any]:
    found = dump(tuple[Hint, ...], hints.get(run.id, ()))
    return {**run.content, "evaluation_reason": reasons.get(run.id), "hints": found}


COMMANDS = (evaluate,)
