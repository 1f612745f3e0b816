"""``slamhive reindex``, ``slamhive doctor``, ``slamhive settings``."""

from __future__ import annotations

from dataclasses import asdict

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import counting_bar, print_json, print_table, tell
from slamhive.cli.plugins import all_origins
from slamhive.cli.visible import say
from slamhive.executors.registry import declared_settings
from slamhive.project import project_root
from slamhive.services.doctor import Verdict, examine, examine_cluster, plugin_checks
from slamhive.services.reindex import reindex, run_folders
from slamhive.settings_sources import settings_in_force


@click.command("reindex")
@json_option
@pass_cli
def reindex_command(cli: CliContext, as_json: bool) -> None:
    """Rebuild the database from the folders of runs, experiments and analyses, and the ledger."""
    hive = cli.hive(indexed=False)
    hive.check_writable()
    with counting_bar("reading run folders", len(run_folders(hive.settings.runs_folder))) as show:
        report = reindex(hive, lambda done, _total: show(done, ""))
    if as_json:
        skipped = [{"folder": str(folder), "reason": reason} for folder, reason in report.skipped]
        counts = {
            name: getattr(report, name)
            for name in ("runs", "evaluations", "experiments", "analyses", "waiting", "queued")
        }
        print_json({**counts, "skipped": skipped})
    else:
        say(f"{report.runs} runs and {report.evaluations} evaluations filed, {len(report.skipped)} left out")
        if report.experiments:
            say(f"{report.experiments} experiments filed, {report.queued} runs of theirs queued again")
        if report.waiting:
            say(f"{report.waiting} runs without a folder restored from the ledger")
        if report.analyses:
            say(f"{report.analyses} analyses filed")
        for folder, reason in report.skipped:
            tell(f"left out: {folder}: {reason}")
    if report.skipped:
        raise click.exceptions.Exit(1)


@click.command("doctor")
@click.argument("what", type=click.Choice(["machine", "cluster"]), default="machine")
@json_option
@pass_cli
def doctor(cli: CliContext, what: str, as_json: bool) -> None:
    """Check what works on this machine, and say how to fix the rest.

    `slamhive doctor cluster` asks each node of the cluster instead: what it is, and which container runtime it has.
    """
    hive = cli.hive(indexed=False)
    checks = examine_cluster(hive) if what == "cluster" else [*examine(hive), *plugin_checks(all_origins())]
    if as_json:
        print_json([asdict(check) for check in checks])
    else:
        rows = [(check.name, check.verdict.value, check.found, check.remedy) for check in checks]
        print_table(("what", "verdict", "found", "remedy"), rows)
    if any(check.verdict is Verdict.FAILED for check in checks):
        raise click.exceptions.Exit(1)


@click.command("settings")
@json_option
@pass_cli
def settings(cli: CliContext, as_json: bool) -> None:
    """List all settings with value, source, unit and meaning."""
    entries = settings_in_force(project_root(), options=cli.options, further=declared_settings())
    if as_json:
        print_json([{**asdict(entry.info), "value": entry.value, "source": entry.source} for entry in entries])
        return
    rows = [(entry.info.name, entry.value, entry.source, entry.info.unit, entry.info.help) for entry in entries]
    print_table(("setting", "value", "from", "unit", "meaning"), rows)


COMMANDS = (reindex_command, doctor, settings)
