"""``slamhive evaluate``: metrics and plots of successful runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import click

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.settings import Mode
from slamhive.base.strict_yaml import dump as yaml_text
from slamhive.cli import completion
from slamhive.cli.context import CliContext, choice, json_option, pass_cli, run_number
from slamhive.cli.output import hints_of, print_hints, print_json, print_table, tell
from slamhive.cli.runs import print_runs
from slamhive.cli.visible import say, write_out
from slamhive.cli.waiting import evaluate_to_end
from slamhive.documents import protocol as schema
from slamhive.documents.model import dump
from slamhive.documents.run import RunDocument
from slamhive.domain.claim import MetricFamily, PrintedUnit
from slamhive.domain.metrics import described
from slamhive.domain.names import plural
from slamhive.domain.protocol import Alignment, Duplicates, FrameFit, ProtocolRequest
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Hint
from slamhive.evaluation.job import Artefacts
from slamhive.filters.syntax import join
from slamhive.filters.words import matching
from slamhive.services.evaluations import SENSOR_FRAME, preset_documents, presets, protocols_document
from slamhive.services.hive import Hive
from slamhive.store import EvaluationRecord

_NAMED_RUNS = 20


@click.command()
@click.argument("run_ids", type=run_number, nargs=-1, shell_complete=completion.RUN)
@click.option("--all-unevaluated", is_flag=True, help="All successful runs that are not evaluated yet.")
@click.option("--where", metavar="FILTER", help="All successful runs that match, e.g. 'dataset ~ MH_*'.")
@click.option("--protocol", metavar="NAME|FILE", help="See `slamhive protocol list`; default: chosen from the sensors.")
@click.option("--align", type=choice(Alignment), help="Alignment; other fields of the protocol keep their defaults.")
@click.option("--duplicates", type=choice(Duplicates), help="Which poses count where a timestamp occurs twice.")
@click.option("--sensor-frame", metavar="SENSOR", help="Sensor of the dataset whose frame the trajectory describes.")
@click.option("--fit-frame", type=choice(FrameFit), help="Fit and report a constant transform between the frames.")
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
    asked = _asked(hive, options["protocol"], options["align"])
    changed = {
        name: options[option]
        for name, option in (
            ("duplicates", "duplicates"),
            (SENSOR_FRAME, "sensor_frame"),
            ("frame_fit", "fit_frame"),
        )
        if options[option] is not None
    }
    if changed:
        asked = asked or ProtocolRequest()
        asked = ProtocolRequest({**asked.values, **changed}, asked.name)
    service = hive.evaluations
    waiting: list[int] = []
    if options["all_unevaluated"]:
        wanted, waiting = service.unevaluated(), [record.id for record in service.waiting()]
    else:
        wanted = list(dict.fromkeys(run_ids))
    if options["where"] is not None:
        search, succeeded = hive.searches.read(options["where"]), matching(states=(RunState.SUCCEEDED,))
        parts = [tree for tree in (search.tree, succeeded.tree) if tree is not None]
        wanted = hive.searches.run_ids(replace(search, tree=join("and", parts)))
    if not wanted and not waiting:
        none = "every run that succeeded has been evaluated" if options["all_unevaluated"] else "no such run succeeded"
        tell(none)
        print_json([]) if as_json else None
        return
    artefacts = Artefacts.PLOTS if options["plots"] else Artefacts.FILES
    evaluation_ids = service.queue(wanted, asked, artefacts, makes_current=options["current"])
    ended = evaluate_to_end(service, list(dict.fromkeys([*waiting, *evaluation_ids])))
    place = {run_id: index for index, run_id in enumerate(wanted)}
    ended.sort(key=lambda record: (place.get(record.run_id, -1), record.id))
    _report(hive, ended, as_json=as_json)
    if any(record.reason is not None for record in ended):
        raise click.exceptions.Exit(1)


def _asked(hive: Hive, protocol: str | None, align: str | None) -> ProtocolRequest | None:
    if protocol is not None and align is not None:
        raise InvalidInput("--protocol and --align exclude each other", "write the alignment into the protocol")
    name = protocol if align is None else align
    return None if name is None else hive.protocols.find(name)


def _report(hive: Hive, ended: list[EvaluationRecord], *, as_json: bool) -> None:
    """Print the runs with the metrics of this evaluation; hints and failures go to stderr."""
    service = hive.current_protocols
    hints = hints_of(hive, ended)
    reasons = {record.run_id: record.reason for record in ended if record.reason is not None}
    entries = service.as_evaluated(ended)
    if as_json:
        print_json([_evaluated(RunDocument.of(entry), reasons, hints) for entry in entries])
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


def _evaluated(run: RunDocument, reasons: Mapping[int, str], hints: Mapping[int, tuple[Hint, ...]]) -> dict[str, Any]:
    found = dump(tuple[Hint, ...], hints.get(run.id, ()))
    return {**run.content, "evaluation_reason": reasons.get(run.id), "hints": found}


# ``slamhive protocol``: evaluation protocols by name, and metrics side by side.


@click.group("protocol")
def protocol() -> None:
    """Show evaluation protocols, and choose the one whose metrics are shown."""


@protocol.command("list")
@json_option
@pass_cli
def list_protocols(cli: CliContext, as_json: bool) -> None:
    """List presets, and protocols in use by fingerprint."""
    used = cli.hive().protocols.used()
    if as_json:
        print_json(protocols_document(used).content)
        return
    runs = {entry.protocol.fingerprint: entry.runs for entry in used}
    rows: list[tuple[str | None, str, int, str]] = [
        (name, preset.protocol.fingerprint, runs.pop(preset.protocol.fingerprint, 0), preset.title)
        for name, preset in presets()
    ]
    rows += [
        (None, entry.protocol.fingerprint, entry.runs, entry.protocol.label)
        for entry in used
        if entry.protocol.fingerprint in runs
    ]
    print_table(("name", "fingerprint", "runs", "what it is"), rows, right=("runs",))


@protocol.command("show")
@click.argument("name", metavar="NAME|FILE")
@json_option
@pass_cli
def show(cli: CliContext, name: str, as_json: bool) -> None:
    """Show a protocol as YAML: a preset, a fingerprint or a file."""
    request = cli.hive().protocols.find(name)
    preset = dict(presets()).get(name)
    if as_json:
        print_json(
            {"name": name, "values": dict(request.values)} if preset is None else preset_documents()[name].content
        )
        return
    if preset is not None:
        say(f"# {preset.title}\n# {preset.differs}\n# {preset.source}")
        say(f"# prints {', '.join(preset.metrics)}; fingerprint {preset.protocol.fingerprint}")
    values = {key: list(value) if isinstance(value, tuple) else value for key, value in request.values.items()}
    write_out(yaml_text({key: str(v) if isinstance(v, str) else v for key, v in values.items() if v is not None}))


@protocol.command("use", short_help="Show the metrics of PROTOCOL for runs")
@click.argument("name", metavar="PROTOCOL")
@click.argument("run_ids", type=run_number, nargs=-1, required=True, shell_complete=completion.RUN)
@pass_cli
def use(cli: CliContext, name: str, run_ids: tuple[int, ...]) -> None:
    """Show the metrics of PROTOCOL (a name, fingerprint or file) for runs RUN_IDS in lists and pages.

    The runs must have been evaluated under it. The metrics of their other protocols are kept.
    """
    hive = cli.hive()
    hive.check_writable()
    hive.current_protocols.use_asked(run_ids, hive.protocols.find(name))
    say(f"{plural(len(set(run_ids)), 'run')} changed")


@protocol.command("compare", short_help="Evaluate a run as each published tool does")
@click.argument("run_id", type=run_number, shell_complete=completion.RUN)
@json_option
@pass_cli
def compare(cli: CliContext, run_id: int, as_json: bool) -> None:
    """Evaluate run RUN_ID as each published tool does, and show the metrics side by side."""
    hive = cli.hive()
    if not hive.runs.get(run_id).state.ended:
        raise Conflict(f"run {run_id} has not ended", "wait for it")
    if hive.settings.mode is not Mode.VIEW_ONLY:
        evaluation_ids = hive.comparisons.queue(run_id)
        if evaluation_ids:
            evaluate_to_end(hive.evaluations, evaluation_ids)
    rows = hive.comparisons.of(run_id)
    if as_json:
        print_json(
            [
                schema.ToolMetrics(
                    name=row.name,
                    title=row.preset.title,
                    protocol=row.protocol,
                    fingerprint=None if row.protocol is None else row.protocol.fingerprint,
                    figures=schema.with_units(row.figures, row.samples),
                    note=row.note,
                    differs=row.preset.differs,
                ).content
                for row in rows
            ]
        )
        return
    table: list[tuple[Any, ...]] = []
    for row in rows:
        figures = [
            f"{key} {value:.6g} {described(key).unit}".rstrip()
            + (f" over {row.samples[key]}" if key in row.samples else "")
            for key, value in row.figures.items()
        ]
        fingerprint = None if row.protocol is None else row.protocol.fingerprint
        table.append((row.name, fingerprint, "\n".join(figures) or None, row.note))
    print_table(("tool", "protocol", "metrics", "note"), table)
    for row in rows:
        say(f"{row.name}: {row.preset.differs}")


@protocol.command("search", short_help="Find the protocols that give a printed number")
@click.argument("run_id", type=run_number, shell_complete=completion.RUN)
@click.option("--ate", metavar="NUMBER", help="ATE as the paper prints it, such as 0.016: its digits count.")
@click.option("--value", metavar="NUMBER", help="Another error as the paper prints it; needs --metric.")
@click.option("--metric", type=choice(MetricFamily), help="What the paper calls that error.")
@click.option("--unit", type=choice(PrintedUnit), help="Its unit.  [default: any that is usual]")
@json_option
@pass_cli
def search(cli: CliContext, /, run_id: int, as_json: bool, **options: str | None) -> None:
    """Find the protocols under which run RUN_ID gives a number that a paper prints, the most usual first.

    Alignment, association, frame, trajectory, crop, scale, statistic and unit are varied over the rules of all tools.
    """
    searches = cli.hive().protocol_searches
    ate, value, metric = options["ate"], options["value"], options["metric"]
    printed = ate if ate is not None else value
    if printed is None or (ate is not None and (value is not None or metric not in (None, MetricFamily.ATE))):
        raise InvalidInput("give one number: --ate NUMBER, or --value NUMBER with --metric", "such as --ate 0.016")
    if ate is None and metric is None:
        raise InvalidInput("--value needs --metric", f"use one of {', '.join(MetricFamily)}")
    found = searches.search(run_id, printed, metric or MetricFamily.ATE, options["unit"])
    if as_json:
        print_json(found.content)
        return
    if not found.matches:
        say(f"none of {found.tried:,} combinations gives {printed}")
        raise click.exceptions.Exit(1)
    rows = [
        (match.preset, match.key, f"{match.value:.6g} {match.unit}", match.words, len(match.alike) or None)
        for match in found.matches[:_SHOWN_MATCHES]
    ]
    print_table(("tool", "metric", "value", "protocol", "alike"), rows, right=("alike",))
    more = len(found.matches) - len(rows)
    left = f", {more} more with --json" if more else ""
    tell(f"{plural(len(found.matches), 'protocol')} of {found.tried:,} combinations gives {printed}{left}")


_SHOWN_MATCHES = 20


COMMANDS = (
    evaluate,
    protocol,
)
