"""``slamhive algorithm versions``, ``verify``, ``export``, ``remove-version`` and ``prune``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table
from slamhive.cli.visible import say
from slamhive.domain.numbers import plural
from slamhive.schema.catalogue import Version

_IDENTITY_DIGITS = 19
"""So much of a digest is shown: ``sha256:`` and twelve digits."""


@click.command("versions")
@click.argument("name", shell_complete=offers.PACKAGE)
@json_option
@pass_cli
def versions(cli: CliContext, name: str, as_json: bool) -> None:
    """List the versions of the package or algorithm NAME with their number of runs."""
    reports = cli.hive().versions.reports(name)
    if as_json:
        print_json([Version.of(report).content for report in reports])
        return
    rows = [
        (
            report.record.label,
            report.record.version,
            report.record.identity[:_IDENTITY_DIGITS],
            f"{report.record.created_at:%Y-%m-%d %H:%M}",
            report.record.runs,
            ", ".join(report.runs_on) or ("removed" if report.record.removed_at else "gone"),
        )
        for report in reports
    ]
    print_table(("version", "upstream", "identity", "since", "runs", "runs on"), rows, right=("runs",))


@click.command("verify")
@click.argument("name", required=False, shell_complete=offers.PACKAGE)
@json_option
@pass_cli
def verify(cli: CliContext, name: str | None, as_json: bool) -> None:
    """Find changed or vanished images and folders, of NAME or of all packages; exit code 1 if there are any."""
    findings = cli.hive().versions.verify(name)
    if as_json:
        print_json([asdict(finding) for finding in findings])
    elif findings:
        print_table(("version", "finding", "what"), [(entry.version, entry.kind, entry.words) for entry in findings])
    else:
        say("all versions are as they were")
    if findings:
        raise click.exceptions.Exit(1)


@click.command("export")
@click.argument("version", metavar="NAME[@VERSION]", shell_complete=offers.PACKAGE)
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--executor", help="The executor that has the image; default: the one in force.")
@pass_cli
def export(cli: CliContext, version: str, file: Path, executor: str | None) -> None:
    """Write image and package of a version to FILE, for `slamhive algorithm import` on another machine."""
    hive = cli.hive()
    chosen = hive.executors.get(hive.executors.choose(executor))
    record = hive.versions.export(version, file, chosen)
    say(f"{record.label}: {file}, {file.stat().st_size / 1e6:.0f} MB")


@click.command("remove-version")
@click.argument("version", metavar="NAME@VERSION", shell_complete=offers.PACKAGE)
@click.option("--with-runs", is_flag=True, help="Also if runs used it: they stay, but cannot be repeated with it.")
@pass_cli
def remove_version(cli: CliContext, version: str, with_runs: bool) -> None:
    """Remove image, environment and folder of a version. Its number and its runs stay."""
    record = cli.hive().versions.remove(version, with_runs=with_runs)
    say(f"{record.label} is removed; {plural(record.runs, 'run')} used it")


@click.command("prune")
@click.argument("name", required=False, shell_complete=offers.PACKAGE)
@click.option("--dry-run", is_flag=True, help="Only list what would be removed.")
@pass_cli
def prune(cli: CliContext, name: str | None, dry_run: bool) -> None:
    """Remove the versions, of NAME or of all packages, that no run used. The newest of each package stays."""
    hive = cli.hive()
    unused = hive.versions.unused(name)
    for record in unused:
        if not dry_run:
            hive.versions.remove(record.label)
        say(f"{record.label}{'' if dry_run else ' is removed'}: {record.identity[:_IDENTITY_DIGITS]}")
    if not unused:
        say("no version is unused")


COMMANDS = (versions, verify, export, remove_version, prune)
