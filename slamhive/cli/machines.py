"""``slamhive nodes``: the machines that execute runs; drain one and take it back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import messages, print_json, print_table, tell
from slamhive.cli.visible import confirm, say
from slamhive.domain.names import plural

if TYPE_CHECKING:
    from slamhive.documents.machines import CloudPlanDocument, CloudStatus
    from slamhive.documents.plain import NodeDocument, NodeRunDocument, OverviewDocument

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
        print_json(found.content)
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


def _print(found: OverviewDocument) -> None:
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


def _row(node: NodeDocument) -> tuple[object, ...]:
    memory_gb = None if node.memory_bytes is None else f"{node.memory_bytes / 1e9:.1f}"
    left = None if node.left_s is None else f"{node.left_s / 60:.0f} min"
    cache = None
    if node.cache is not None:
        cache = f"{node.cache.used_bytes / 1e9:.1f} of {node.cache.limit_bytes / 1e9:.1f} GB"
    rates = (f"{node.runs_per_hour:.1f}", left)
    return (node.name, node.state, node.cpu_model, node.cpu_count, memory_gb, cache, *rates, _runs(node.runs))


def _runs(runs: tuple[NodeRunDocument, ...]) -> str | None:
    return ", ".join(f"{run.id} {run.algorithm} on {run.dataset} ({run.state})" for run in runs) or None


# ``slamhive cloud``: rent machines, and give them back.


file_argument = click.argument("file", type=click.Path(path_type=Path))


@click.group()
def cloud() -> None:
    """Rent machines of EC2 or Alibaba ECS for an experiment. docs/cloud.md explains the file."""


@cloud.command()
@file_argument
@json_option
@pass_cli
def plan(cli: CliContext, file: Path, as_json: bool) -> None:
    """Show machines, hours and price of FILE. Nothing is created, and no provider is asked."""
    found = cli.hive().clouds.plan(file)
    if as_json:
        print_json(found.content)
    else:
        _print_plan(found)


@cloud.command()
@file_argument
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@json_option
@pass_cli
def up(cli: CliContext, file: Path, yes: bool, as_json: bool) -> None:
    """Rent what the plan of FILE shows. Running it again continues an interrupted start."""
    clouds = cli.hive().clouds
    if messages.is_terminal and not (yes or as_json):
        _print_plan(clouds.plan(file))
        confirm("rent these machines?")
    status = clouds.up(file, tell)
    if as_json:
        print_json(status.content)
    else:
        _print_status(status)


@cloud.command("status")
@click.argument("name", required=False)
@json_option
@pass_cli
def status_(cli: CliContext, name: str | None, as_json: bool) -> None:
    """Show what the cluster NAME has, or all clusters that are not down."""
    found = cli.hive(indexed=False).clouds.status(name)
    if as_json:
        print_json([status.content for status in found])
        return
    for status in found:
        _print_status(status)
    if not found:
        tell("no cluster is up; `slamhive cloud up FILE` rents one")


@cloud.command(short_help="Delete all that a cluster has")
@click.argument("name")
@pass_cli
def down(cli: CliContext, name: str) -> None:
    """Delete all that the cluster NAME has: machines, disks, image, snapshots and firewall."""
    deleted = cli.hive(indexed=False).clouds.down(name, tell)
    say(f"cluster {name} is down; {plural(deleted, 'resource')} deleted, nothing is left")


@cloud.command(short_help="Find and delete what clusters have left behind")
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--all", "everything", is_flag=True, help="Also what other installations have; theirs may be in use.")
@pass_cli
def sweep(cli: CliContext, file: Path | None, everything: bool) -> None:
    """Find by tag, and delete, what clusters have left that are down, unknown or past their end.

    It searches the region of FILE, or the regions of all clusters of this data root.
    """
    for swept in cli.hive(indexed=False).clouds.sweep(file, tell, everything=everything):
        foreign = f"; {plural(swept.foreign, 'resource')} of other installations left" if swept.foreign else ""
        say(f"{swept.provider} {swept.region}: {plural(swept.deleted, 'resource')} deleted{foreign}")


def _print_plan(found: CloudPlanDocument) -> None:
    money = found.currency
    runs = "" if found.runs is None else f" for {plural(found.runs, 'run')}"
    say(f"{found.name}: {found.nodes} × {found.instance_type}, {found.provider} {found.region}{runs}")
    say(f"created: {', '.join(_created(found))}")
    say(
        f"hours: {found.prepare_h:.1f} until all machines work, {found.run_h:.1f} for the runs, "
        f"{found.total_h:.1f} in all; machines end themselves after {found.lifetime_h:.1f}"
    )
    say(f"data to copy to the first machine: {found.data_bytes / 1e9:,.2f} GB")
    say(
        f"price: about {found.expected_cost:,.2f} {money}, at most {found.most_cost:,.2f} of {found.budget:,.2f} "
        f"{money}; {found.hour_price:,.4f} for a machine and hour, prices of {found.prices_date}"
    )
    if found.image_day_cost:
        say(f"the image costs {found.image_day_cost:,.2f} {money} a day until `slamhive cloud down {found.name}`")


def _created(found: CloudPlanDocument) -> list[str]:
    image = ["1 image with its snapshot"] if "image" in found.roles else []
    return ["1 firewall", f"{plural(found.nodes, 'machine')} with a disk of {found.disk_gb} GB", *image]


def _print_status(status: CloudStatus) -> None:
    cost = f"at most {status.cost_until_now:,.2f} of {status.most_cost:,.2f} {status.currency} until now"
    say(f"{status.name}: {status.state}, {status.provider} {status.region}, {cost}")
    say(f"machines end themselves at {status.ends_at:%Y-%m-%d %H:%M} UTC")
    rows = [(entry.kind, entry.role or None, entry.id, entry.state, entry.address) for entry in status.resources]
    if rows:
        print_table(("kind", "role", "id", "state", "address"), rows)
    else:
        say("the provider has nothing of it")


COMMANDS = (
    nodes,
    cloud,
)
