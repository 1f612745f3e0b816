"""``slamhive cite``: what to cite for runs, as BibTeX."""

from __future__ import annotations

from pathlib import Path

import click

from slamhive.base.errors import NotFound
from slamhive.cli.context import CliContext, pass_cli
from slamhive.cli.visible import write_out
from slamhive.domain.bibliography import Reference, bibtex
from slamhive.services.hive import Hive


@click.command()
@click.argument("what", metavar="RUN|EXPERIMENT|ANALYSIS")
@pass_cli
def cite(cli: CliContext, /, what: str) -> None:
    """Print BibTeX of everything that a run, an experiment or an analysis used.

    That is SLAM Hive, evo, the algorithms and the datasets. ANALYSIS is an analysis file, or the last part of the
    address of an analysis page.
    """
    write_out(bibtex(_references(cli.hive(), what)))


def _references(hive: Hive, what: str) -> tuple[Reference, ...]:
    if what.isdecimal():
        return hive.citations.of_runs([hive.stored_runs.get(int(what)).id])
    if Path(what).is_file():
        return hive.analyses.references(hive.analyses.read_file(Path(what)))
    if hive.stored_analyses.is_token(what):
        hive.stored_analyses.get(what)
        return hive.analyses.references(hive.analyses.read(hive.stored_analyses.folder(what).source))
    try:
        return hive.citations.of_experiment(what)
    except NotFound as error:
        raise NotFound(f"{what!r} is no run, no file and no experiment: {error.message}", error.remedy) from None


COMMANDS = (cite,)
