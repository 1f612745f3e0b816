"""``slamhive plugins``: what fills each seam, and what is wrong with plug-ins that cannot be used."""

from __future__ import annotations

from typing import Any

import click

from slamhive.cli.context import json_option
from slamhive.cli.output import print_json, print_table
from slamhive.cli.visible import say
from slamhive.files import temporary_folder
from slamhive.project import project_root
from slamhive.registry import Origin, Registry
from slamhive.schema.plugin import PlugIn


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


def all_origins() -> list[Origin]:
    """Return the origins that fill each seam, seam by seam. Loads every plug-in."""
    return [origin for registry in _registries() for origin in registry.origins()]


def _registries() -> tuple[Registry[Any], ...]:
    """Every seam, with its plug-ins put to use. Loading them all takes seconds, so it is not done at the top."""
    from slamhive.analysis.plot_types import PLOT_TYPES  # noqa: PLC0415
    from slamhive.bags.exporters import EXPORTERS  # noqa: PLC0415
    from slamhive.bags.importers import IMPORTERS  # noqa: PLC0415
    from slamhive.bags.variants.steps import STEPS  # noqa: PLC0415
    from slamhive.catalogue.algorithm_folders import ALGORITHM_FOLDERS  # noqa: PLC0415
    from slamhive.domain.metrics import METRICS  # noqa: PLC0415
    from slamhive.evaluation.evaluators.builtin import EVALUATORS  # noqa: PLC0415
    from slamhive.evaluation.presets import PRESETS  # noqa: PLC0415
    from slamhive.executors.base import ExecutorContext  # noqa: PLC0415
    from slamhive.executors.registry import EXECUTORS, check_plugin_executors  # noqa: PLC0415
    from slamhive.services.executors import NO_INSTALLATION  # noqa: PLC0415
    from slamhive.web.app import check_plugin_pages  # noqa: PLC0415
    from slamhive.web.pages import PAGES  # noqa: PLC0415

    check_plugin_pages()
    with temporary_folder() as nowhere:
        check_plugin_executors(ExecutorContext(nowhere, project_root(), NO_INSTALLATION))
    return (
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


def _document(origin: Origin) -> PlugIn:
    return PlugIn.of(origin, state="loaded" if origin.problem is None else "broken")


COMMANDS = (plugins,)
