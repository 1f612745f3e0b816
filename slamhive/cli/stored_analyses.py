"""``slamhive analyses``: the analyses that the pages compute and keep."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.sharing import change_of, in_words, sharing_options
from slamhive.cli.visible import say

if TYPE_CHECKING:
    from slamhive.store.analysis_records import AnalysisRecord


@click.group("analyses")
def analyses() -> None:
    """List, share and delete analyses that were made on pages or by the web API."""


@analyses.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List the analyses that the pages list, the newest first."""
    found = cli.hive().stored_analyses.listed()
    if as_json:
        print_json([_content(record) for record in found])
        return
    columns = ("token", "name", "state", "owner", "seen by", "created_at")
    rows = [(r.token, r.name, r.state.value, r.owner, r.seen_by.value, r.created_at.isoformat()) for r in found]
    if rows:
        print_table(columns, rows)
    else:
        tell("there are no analyses; make one on the page of analyses, or compute a file with slamhive analyse")


@analyses.command("share")
@click.argument("token", shell_complete=offers.ANALYSIS)
@sharing_options
def share(cli: CliContext, token: str, visibility: str | None, owner: str | None, as_json: bool) -> None:
    """Choose who may see an analysis where there are accounts. A worker then computes it again."""
    record = cli.hive().sharings.analysis(token, change_of(visibility, owner))
    if as_json:
        print_json(_content(record))
    else:
        say(f"analysis {record.name}: {in_words(record.owner, record.seen_by)}")


@analyses.command("delete")
@click.argument("token", shell_complete=offers.ANALYSIS)
@pass_cli
def delete(cli: CliContext, token: str) -> None:
    """Remove an analysis with its files for good."""
    stored = cli.hive().stored_analyses
    name = stored.get(token).name
    stored.delete(token)
    say(f"analysis {name} deleted")


def _content(record: AnalysisRecord) -> dict[str, object]:
    from slamhive.schema.api_answers import Analysis  # noqa: PLC0415 - the table needs none of these models

    return Analysis.of(record).content


COMMANDS = (analyses,)
