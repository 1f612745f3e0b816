"""``slamhive runs share`` and ``slamhive experiment share``: who owns runs, and who may see them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.chosen_runs import ChosenRuns, SearchAction, runs_or_search
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json
from slamhive.cli.visible import say
from slamhive.domain.accounts import Sharing, Visibility, visibility_of

if TYPE_CHECKING:
    from slamhive.services.sharing import SharingChange

visibility_option = click.option(
    "--visibility", type=choice(Visibility), help="private: owner and admins; team: who signs in; public: everybody."
)
_OWNER = click.option("--owner", metavar="ACCOUNT", help="Give them to this account.")


def sharing_options(command: Callable[..., None]) -> Callable[..., None]:
    """The options of all commands that share."""
    for option in (pass_cli, json_option, _OWNER, visibility_option):
        command = option(command)
    return command


@click.command("share")
@runs_or_search
@sharing_options
def share_runs(cli: CliContext, /, visibility: str | None, owner: str | None, as_json: bool, **options: Any) -> None:
    """Choose who may see runs where there are accounts. See docs/accounts.md."""
    hive, chosen, change = cli.hive(), ChosenRuns(**options), change_of(visibility, owner)
    if chosen.where is not None:
        action = SearchAction("share", "change who may see {runs}?", "{runs} shared")
        share = hive.search_actions.share
        chosen.act(hive, action, lambda ids, progress: share(ids, change, progress), as_json=as_json)
        return
    runs = hive.sharings.runs(chosen.run_ids, change)
    if as_json:
        print_json([{"id": run.id, "owner": run.owner, "visibility": run.seen_by.value} for run in runs])
        return
    for run in runs:
        say(f"run {run.id}: {in_words(run.owner, run.seen_by)}")


@click.command("share", short_help="Choose who may see an experiment and its runs")
@click.argument("name", shell_complete=completion.EXPERIMENT)
@sharing_options
def share_experiment(cli: CliContext, name: str, visibility: str | None, owner: str | None, as_json: bool) -> None:
    """Choose who may see an experiment and its runs where there are accounts."""
    sharing: Sharing = cli.hive().sharings.experiment(name, change_of(visibility, owner))
    seen_by = visibility_of(sharing.audience())
    if as_json:
        print_json({"name": name, "owner": sharing.owner, "visibility": seen_by.value})
    else:
        say(f"experiment {name}: {in_words(sharing.owner, seen_by)}")


def in_words(owner: str | None, seen_by: Visibility) -> str:
    """``private, of anna``."""
    return f"{seen_by}, of {owner}" if owner else f"{seen_by}, of nobody"


def change_of(visibility: str | None, owner: str | None) -> SharingChange:
    """The change that these options ask for; raises InvalidInput without any."""
    from slamhive.services.sharing import SharingChange  # noqa: PLC0415 - other commands on experiments need none of it

    if visibility is None and owner is None:
        raise InvalidInput("nothing is to be changed", "use --visibility or --owner")
    return SharingChange(None if visibility is None else Visibility(visibility), owner)


COMMANDS = (share_runs,)
