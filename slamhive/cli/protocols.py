"""``slamhive protocol``: evaluation protocols by name, and metrics side by side."""

from __future__ import annotations

from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.batches import evaluate_to_end
from slamhive.cli.context import CliContext, json_option, pass_cli, run_number
from slamhive.cli.output import print_json, print_table
from slamhive.cli.visible import say, write_out
from slamhive.domain.metrics import described
from slamhive.domain.numbers import plural
from slamhive.errors import Conflict
from slamhive.schema import protocol as schema
from slamhive.services.evaluations import ToolFigures, preset_documents, presets, protocols_document
from slamhive.settings import Mode
from slamhive.strict_yaml import dump


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
    write_out(dump({key: str(v) if isinstance(v, str) else v for key, v in values.items() if v is not None}))


@protocol.command("use")
@click.argument("name", metavar="PROTOCOL")
@click.argument("run_ids", type=run_number, nargs=-1, required=True, shell_complete=offers.RUN)
@pass_cli
def use(cli: CliContext, name: str, run_ids: tuple[int, ...]) -> None:
    """Show the metrics of PROTOCOL (a name, fingerprint or file) for runs RUN_IDS in lists and pages.

    The runs must have been evaluated under it. The metrics of their other protocols are kept.
    """
    hive = cli.hive()
    hive.check_writable()
    hive.current_protocols.use_asked(run_ids, hive.protocols.find(name))
    say(f"{plural(len(set(run_ids)), 'run')} changed")


@protocol.command("compare")
@click.argument("run_id", type=run_number, shell_complete=offers.RUN)
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
        print_json([_tool(row).content for row in rows])
        return
    print_table(("tool", "protocol", "metrics", "note"), [_tool_row(row) for row in rows])
    for row in rows:
        say(f"{row.name}: {row.preset.differs}")


def _tool_row(row: ToolFigures) -> tuple[Any, ...]:
    figures = [
        f"{key} {value:.6g} {described(key).unit}".rstrip()
        + (f" over {row.samples[key]}" if key in row.samples else "")
        for key, value in row.figures.items()
    ]
    return (row.name, None if row.protocol is None else row.protocol.fingerprint, "\n".join(figures) or None, row.note)


def _tool(row: ToolFigures) -> schema.ToolMetrics:
    return schema.ToolMetrics(
        name=row.name,
        title=row.preset.title,
        protocol=row.protocol,
        fingerprint=None if row.protocol is None else row.protocol.fingerprint,
        figures=schema.with_units(row.figures, row.samples),
        note=row.note,
        differs=row.preset.differs,
    )


COMMANDS = (protocol,)
