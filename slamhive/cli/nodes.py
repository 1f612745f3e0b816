"""``slamhive nodes``: the machines that execute runs; drain one and take it back."""

from __future__ import annotations

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.domain.numbers import plural
from slamhive.schema import nodes as schema
from slamhive.services.nodes import NodeRun, NodeView, Overview

executor_option = click.option("--executor", help="Whose node it is; default: the executor in force.")
node_argument = click.argument("node")


@click.group(invoke_without_command=True)
@json_option
@pass_cli
@click.pass_context
def nodes(context: click.Context, cli: CliContext, as_json: bool) -> None:
    """List the machines that execute runs: their state, what runs there, throughput and disturbance."""
    if context.invoked_subcommand is not None:
        return
    found = cli.hive().nodes.overview()
    if as_json:
        print_json(schema.Overview.of(found).content)
    else:
        _print(found)


@nodes.command("drain")
@node_argument
@executor_option
@pass_cli
def drain(cli: CliContext, node: str, executor: str | None) -> None:
    """Let no further run start on NODE; active runs go on."""
    hive = cli.hive()
    hive.nodes.drain(executor or hive.executors.choose(), node, drained=True)
    tell(f"no further run starts on {node}; `slamhive nodes undrain {node}` ends that")


@nodes.command("undrain")
@node_argument
@executor_option
@pass_cli
def undrain(cli: CliContext, node: str, executor: str | None) -> None:
    """Let runs start on NODE again."""
    hive = cli.hive()
    hive.nodes.drain(executor or hive.executors.choose(), node, drained=False)
    tell(f"runs start on {node} again")


def _print(found: Overview) -> None:
    rows = [(engine.executor, *_row(node)) for engine in found.engines for node in engine.nodes]
    if rows:
        headings = ("executor", "node", "state", "CPU", "cores", "GB", "cache", "runs/h", "left", "runs")
        print_table(headings, rows, right=("cores", "GB", "cache", "runs/h", "left"))
    for engine in found.engines:
        if engine.problem is not None:
            tell(f"{engine.executor}: {engine.problem}", style="yellow")
        if engine.elsewhere:
            say(f"{engine.executor}, on no node yet: {_runs(engine.elsewhere)}")
    for machine in found.machines:
        share = machine.disturbed_fraction
        disturbed = "disturbance unknown" if share is None else f"{share:.0%} disturbed"
        say(
            f"{machine.cpu_model}, {machine.cpu_count} cores: {plural(machine.runs, 'run')} in {machine.hours:g} h, "
            f"{machine.runs_per_hour:.1f} per hour, {disturbed}"
        )
    left = f"; active experiments, one after the other: {found.left.words()}" if found.left_s else ""
    say(f"{plural(found.queued, 'run')} queued{left}")


def _row(node: NodeView) -> tuple[object, ...]:
    memory_gb = None if node.memory_bytes is None else f"{node.memory_bytes / 1e9:.1f}"
    left = None if node.left_s is None else f"{node.left_s / 60:.0f} min"
    cache = None
    if node.cache is not None:
        cache = f"{node.cache.used_bytes / 1e9:.1f} of {node.cache.limit_bytes / 1e9:.1f} GB"
    rates = (f"{node.runs_per_hour:.1f}", left)
    return (node.name, node.state, node.cpu_model, node.cpu_count, memory_gb, cache, *rates, _runs(node.runs))


def _runs(runs: tuple[NodeRun, ...]) -> str | None:
    return ", ".join(f"{run.id} {run.algorithm} on {run.dataset} ({run.state})" for run in runs) or None


COMMANDS = (nodes,)
