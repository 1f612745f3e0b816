"""``slamhive dataset check``: what is wrong with a dataset, and what to do about it."""

from __future__ import annotations

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, progress_bar, tell
from slamhive.cli.visible import say
from slamhive.domain.checks import Severity
from slamhive.schema.checks import DatasetCheck, Finding


@click.command("check")
@click.argument("name", shell_complete=offers.DATASET)
@click.option("--strict", is_flag=True, help="Exit code 1 for warnings too.")
@json_option
@pass_cli
def check(cli: CliContext, name: str, strict: bool, as_json: bool) -> None:
    """Check the recording, the calibration and the ground truth of dataset NAME.

    Reads the recording once. The exit code is 1 if there is an error, with --strict also if there is a warning; else 0.
    """
    hive = cli.hive(indexed=False)
    entry = hive.catalogue.dataset(name)
    with progress_bar(f"checking {name}") as progress:
        report = hive.dataset_checks.check(entry, progress)
    if as_json:
        print_json(report.content)
    else:
        _print(report)
    bad = report.count(Severity.ERROR) + (report.count(Severity.WARNING) if strict else 0)
    if bad:
        raise click.exceptions.Exit(1)


def _print(report: DatasetCheck) -> None:
    """One line for each finding, however long: terminals wrap it, and ``grep`` finds all of it."""
    width = max([len(finding.check) for finding in report.findings], default=0)
    for finding in report.findings:
        place = f"{finding.severity.value:8}{finding.check:{width}}  {finding.about}, {_where(finding)}"
        say(f"{place}: {finding.message} To do: {finding.remedy}.")
    counts = ", ".join(f"{report.count(severity)} {severity.value}s" for severity in Severity)
    tell(f"{report.dataset}: {counts}; {len(report.checks)} checks")
    if report.not_checked:
        tell(f"{len(report.not_checked)} could not be done; --json says why")


def _where(finding: Finding) -> str:
    if finding.at_s is None:
        return "everywhere"
    return f"{finding.at_s:.2f} s" + (f" and {finding.count - 1} more" if finding.count > 1 else "")


COMMANDS = (check,)
