"""Runs that a command names by number, or all runs of a search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.context import run_number
from slamhive.cli.output import counting_bar, print_json, tell
from slamhive.cli.visible import confirm, say
from slamhive.domain.names import plural

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from slamhive.services.search_actions import Acted, Progress

_OPTIONS = (
    click.argument("run_ids", type=run_number, nargs=-1, shell_complete=completion.RUN),
    click.option("--where", metavar="FILTER", help="All runs that match, e.g. 'dataset ~ MH_*', instead of numbers."),
    click.option("--yes", is_flag=True, help="With --where: do not ask for confirmation."),
)


def runs_or_search(command: Callable[..., Any]) -> Callable[..., Any]:
    """The argument RUN_IDS and the options ``--where`` and ``--yes``: the fields of :class:`ChosenRuns`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


@dataclass(frozen=True, slots=True)
class SearchAction:
    """An action on all runs of a search: the ``title`` of its progress, what it ``asks``, and what it ``says`` then.

    ``asks`` and ``says`` contain ``{runs}``, which becomes ``12 runs``.
    """

    title: str
    asks: str
    says: str


@dataclass(frozen=True, slots=True)
class ChosenRuns:
    """The runs of a command: ``run_ids``, or all that match the filter ``where``. Raises InvalidInput for both or none.

    ``yes``: do not ask before all runs of a search are changed.
    """

    run_ids: tuple[int, ...]
    where: str | None
    yes: bool

    def __post_init__(self) -> None:
        if bool(self.run_ids) == (self.where is not None):
            raise InvalidInput("name runs by number, or give --where: one of the two", "slamhive runs lists them")

    def act(
        self, hive: Hive, action: SearchAction, act: Callable[[list[int], Progress], Acted], *, as_json: bool
    ) -> Acted:
        """Count the runs that match, ask, act on them with a progress bar, and print how many were changed."""
        hive.check_writable()
        run_ids = hive.searches.find(self.where or "")
        asks = action.asks.format(runs=plural(len(run_ids), "run"))
        if run_ids and not self.yes:
            confirm(asks)
        with counting_bar(action.title, len(run_ids)) as bar:
            acted = act(run_ids, lambda done: bar(done, ""))
        if as_json:
            at = {} if acted.at is None else {"deleted_at": acted.at.isoformat()}
            print_json({"done": acted.done, "left_out": acted.left_out, "reasons": list(acted.reasons), **at})
            return acted
        say(action.says.format(runs=plural(acted.done, "run")) if run_ids else "no run matches this filter")
        if acted.left_out:
            tell(f"{plural(acted.left_out, 'run')} left out:")
        for words in acted.words:
            tell(f"  {words}")
        return acted
