"""``slamhive reindex``, ``slamhive doctor``, ``slamhive settings``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import click

from slamhive.base.files import temporary_folder
from slamhive.base.project import project_root
from slamhive.base.registry import PluginOrigin, Registry
from slamhive.base.settings_sources import settings_in_force
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import counting_bar, print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.documents.catalogue import PlugIn
from slamhive.domain.names import plural
from slamhive.executors.registry import declared_settings
from slamhive.services.doctor import (
    IN_FORCE,
    NOT_BUILT,
    DoctorCheck,
    DoctorVerdict,
    examine,
    examine_cluster,
    plugin_checks,
)
from slamhive.services.reindex import reindex, run_folders

# ``slamhive plugins``: what fills each seam, and what is wrong with plug-ins that cannot be used.


@click.command("plugins")
@click.option("--all", "with_shipped", is_flag=True, help="Also what ships with SLAM Hive.")
@json_option
def plugins(with_shipped: bool, as_json: bool) -> None:
    """List installed plug-ins: the seam that each one fills, its package, and whether it can be used."""
    shown = [origin for origin in all_origins() if with_shipped or origin.is_plugin]
    if as_json:
        print_json([_document(origin).content for origin in shown])
        return
    if not shown:
        say("no plug-ins installed; docs/extend/index.md shows how to write one")
        return
    rows = [
        (origin.seam, origin.name, origin.package, origin.version, origin.problem or "loaded", origin.remedy)
        for origin in shown
    ]
    print_table(("seam", "name", "package", "version", "state", "remedy"), rows)


def all_origins() -> list[PluginOrigin]:
    """Return the origins that fill each seam, seam by seam. Loads every plug-in and puts it to use."""
    # This takes seconds, so it is not done at the top.
    from slamhive.analysis.plot_types import PLOT_TYPES  # noqa: PLC0415
    from slamhive.domain.metrics import METRICS  # noqa: PLC0415
    from slamhive.evaluation.evaluators.builtin import EVALUATORS  # noqa: PLC0415
    from slamhive.evaluation.presets import PRESETS  # noqa: PLC0415
    from slamhive.executors.base import ExecutorContext  # noqa: PLC0415
    from slamhive.executors.registry import EXECUTORS, check_plugin_executors  # noqa: PLC0415
    from slamhive.packages.algorithm_file import ALGORITHM_FOLDERS  # noqa: PLC0415
    from slamhive.recordings.exporters import EXPORTERS  # noqa: PLC0415
    from slamhive.recordings.importers.registry import IMPORTERS  # noqa: PLC0415
    from slamhive.recordings.variants.steps import STEPS  # noqa: PLC0415
    from slamhive.services.executors import NO_INSTALLATION  # noqa: PLC0415
    from slamhive.web.app import check_plugin_pages  # noqa: PLC0415
    from slamhive.web.pages import PAGES  # noqa: PLC0415

    check_plugin_pages()
    with temporary_folder() as nowhere:
        check_plugin_executors(ExecutorContext(nowhere, project_root(), NO_INSTALLATION))
    registries: tuple[Registry[Any], ...] = (
        ALGORITHM_FOLDERS,
        IMPORTERS,
        EXPORTERS,
        STEPS,
        METRICS,
        EVALUATORS,
        PLOT_TYPES,
        PRESETS,
        EXECUTORS,
        PAGES,
    )
    return [origin for registry in registries for origin in registry.origins()]


def _document(origin: PluginOrigin) -> PlugIn:
    return PlugIn.of(origin, state="loaded" if origin.problem is None else "broken")


NEEDED = ("data root", "database", "executor")
"""The checks without which nothing can be run. All others concern one package, or what is measured."""


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
@click.option("--all", "everything", is_flag=True, help="Also what is fine.")
@json_option
@pass_cli
def doctor(cli: CliContext, what: str, everything: bool, as_json: bool) -> None:
    """Say whether this machine can start, what is not fine, and how to fix it.

    `slamhive doctor cluster` asks each node of the cluster instead: what it is, and which container runtime it has.
    """
    hive = cli.hive(indexed=False)
    checks = examine_cluster(hive) if what == "cluster" else [*examine(hive), *plugin_checks(all_origins())]
    if as_json:
        print_json([asdict(check) for check in checks])
    else:
        if what == "machine":
            say(_can_start(checks))
        shown = checks if everything or what == "cluster" else _not_fine(checks)
        rows = [(check.name, check.verdict.value, check.found, check.remedy) for check in shown]
        if rows:
            print_table(("what", "verdict", "found", "remedy"), rows)
        if len(shown) < len(checks):
            tell("slamhive doctor --all also shows what is fine")
    if any(check.verdict is DoctorVerdict.FAILED for check in checks):
        raise click.exceptions.Exit(1)


def _can_start(checks: Sequence[DoctorCheck]) -> str:
    """One line on whether runs can be started here."""
    failed = [check for check in checks if check.verdict is DoctorVerdict.FAILED]
    for check in failed:
        if check.name in NEEDED:
            remedy = f"; {check.remedy}" if check.remedy else ""
            return f"this machine cannot start yet: {check.name}: {check.found}{remedy}"
    chosen = "".join(f", runs use {check.found}" for check in checks if check.name == IN_FORCE)
    if failed:
        return f"this machine can start{chosen}, but {plural(len(failed), 'check')} failed"
    return f"this machine can start{chosen}"


def _not_fine(checks: Sequence[DoctorCheck]) -> list[DoctorCheck]:
    """The checks that a user may want to act on.

    A laptop lacks Slurm, and most packages are never built on it. So executors that cannot be used are left out if
    another one is in force, and packages that are not built are one row.
    """
    works = any(check.name == IN_FORCE and check.verdict is DoctorVerdict.OK for check in checks)
    open_ones = [
        check
        for check in checks
        if check.verdict is DoctorVerdict.FAILED
        or (check.verdict is DoctorVerdict.WARNING and not (works and check.name.startswith("executor ")))
    ]
    unbuilt = [check for check in open_ones if check.found == NOT_BUILT]
    if len(unbuilt) < 2:
        return open_ones
    count = sum(check.name.startswith("algorithm ") for check in checks)
    remedy = "the first run of each builds it; slamhive algorithm build NAME does so now"
    row = DoctorCheck(
        "algorithms", DoctorVerdict.WARNING, f"{len(unbuilt)} of {count} packages are not built yet", remedy
    )
    at = open_ones.index(unbuilt[0])
    return [*open_ones[:at], row, *(check for check in open_ones[at:] if check.found != NOT_BUILT)]


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


COMMANDS = (
    plugins,
    reindex_command,
    doctor,
    settings,
)
