"""The names that the shell offers for the arguments of commands."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeAlias

import click
from click.shell_completion import CompletionItem

from slamhive.cli.visible import visible_line
from slamhive.domain.numbers import plural
from slamhive.errors import SlamHiveError

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

Offer: TypeAlias = tuple[str, str]
"""A name, and the words beside it in shells that show them."""
Completion: TypeAlias = Callable[[click.Context, click.Parameter, str], list[CompletionItem[str]]]

_LATEST_RUNS = 30


def _algorithms(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, entry.title) for entry in hive.catalogue.algorithms())


def _packages(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, entry.title) for entry in hive.catalogue.packages())


def _datasets(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, f"{entry.duration_s:.1f} s") for entry in hive.catalogue.datasets())


def _experiments(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, entry.standing.value) for entry in hive.experiments.list())


def _baselines(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, plural(entry.runs, "run")) for entry in hive.gates.baselines.briefs())


def _challenges(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, entry.title) for entry in hive.challenges.briefs())


def _searches(hive: Hive) -> Iterable[Offer]:
    return ((entry.name, entry.filter_text) for entry in hive.searches.saved())


def _analyses(hive: Hive) -> Iterable[Offer]:
    return ((entry.token, entry.name) for entry in hive.stored_analyses.listed())


def _runs(hive: Hive) -> Iterable[Offer]:
    latest = hive.stored_runs.page(limit=_LATEST_RUNS).records
    return ((str(run.id), f"{run.algorithm} on {run.dataset}, {run.state.value}") for run in latest)


def _completion_of(names: Callable[[Hive], Iterable[Offer]], *, or_file: bool = False) -> Completion:
    """Complete an argument by the names that begin so; ``or_file`` offers files where no name does."""

    def complete(context: click.Context, _: click.Parameter, begun: str) -> list[CompletionItem[str]]:
        found = [
            CompletionItem(name, help=visible_line(words))
            for name, words in _read(context, names)
            if name.startswith(begun) and name == visible_line(name)  # the shell prints it, and takes it as it is
        ]
        return found if found or not or_file else [CompletionItem(begun, type="file")]

    return complete


def _read(context: click.Context, names: Callable[[Hive], Iterable[Offer]]) -> list[Offer]:
    """The names in the data root of the command line. A data root that cannot be read has none: Tab prints no error."""
    from slamhive.services.data_root import DataRoot  # noqa: PLC0415 - only completion needs them here
    from slamhive.services.hive import open_hive  # noqa: PLC0415

    options = {key: value for key, value in context.find_root().params.items() if key in ("data", "database_url")}
    try:
        hive = open_hive(options, DataRoot.OPTIONAL)
        try:
            return list(names(hive))
        finally:
            hive.close()
    except SlamHiveError:
        return []


ANALYSIS = _completion_of(_analyses)
ALGORITHM = _completion_of(_algorithms)
PACKAGE = _completion_of(_packages)
DATASET = _completion_of(_datasets)
EXPERIMENT = _completion_of(_experiments, or_file=True)
BASELINE = _completion_of(_baselines, or_file=True)
CHALLENGE = _completion_of(_challenges)
SEARCH = _completion_of(_searches)
RUN = _completion_of(_runs)
