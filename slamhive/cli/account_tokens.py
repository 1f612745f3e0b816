"""``slamhive account token``: personal API tokens."""

from __future__ import annotations

import click

from slamhive.cli.acting import acting
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.domain.accounts import Scope
from slamhive.schema.accounts import ApiToken
from slamhive.services.accounts import LONGEST_TOKEN_DAYS, TokenRequest


@click.group("token")
def token() -> None:
    """Make, list and revoke API tokens, by which programs use the web API."""


@token.command("create")
@click.argument("account")
@click.argument("name")
@click.option("--scope", "scopes", type=choice(Scope), multiple=True, default=[Scope.READ.value], show_default=True)
@click.option(
    "--days", type=click.IntRange(1, LONGEST_TOKEN_DAYS), default=90, show_default=True, help="How long it can be used."
)
@json_option
@pass_cli
def create(cli: CliContext, account: str, name: str, scopes: tuple[str, ...], days: int, as_json: bool) -> None:
    """Make the token NAME for ACCOUNT, and print its text, which is stored nowhere."""
    request = TokenRequest(name, [Scope(scope) for scope in scopes], days)
    with acting(cli, f"{account}: {name}, {', '.join(scopes)}, {days} d") as accounts:
        made, text = accounts.create_token(account, request)
    if as_json:
        print_json({**ApiToken.of(made).content, "text": text})
        return
    tell(f"token {made.id} of {account}, until {made.expires_at:%Y-%m-%d}; it is shown only now:")
    say(text)


@token.command("list")
@click.argument("account", required=False)
@json_option
@pass_cli
def list_(cli: CliContext, account: str | None, as_json: bool) -> None:
    """List the tokens of ACCOUNT, or of all accounts."""
    found = cli.hive().accounts.tokens(account)
    if as_json:
        print_json([ApiToken.of(entry).content for entry in found])
    elif found:
        rows = [
            (
                entry.id,
                entry.owner,
                entry.name,
                ", ".join(entry.scopes),
                f"{entry.expires_at:%Y-%m-%d}",
                "never" if entry.used_at is None else f"{entry.used_at:%Y-%m-%d %H:%M}",
            )
            for entry in found
        ]
        print_table(("id", "account", "name", "scopes", "until", "used"), rows, right=("id",))
    else:
        tell("there are no tokens")


@token.command("revoke")
@click.argument("token_id", type=click.IntRange(1, 2**31 - 1))
@json_option
@pass_cli
def revoke(cli: CliContext, token_id: int, as_json: bool) -> None:
    """End the token with this id, at once."""
    with acting(cli, str(token_id)) as accounts:
        revoked = accounts.revoke(token_id)
    if as_json:
        print_json(ApiToken.of(revoked).content)
    else:
        say(f"token {revoked.id} {revoked.name} of {revoked.owner} is revoked")
