"""``slamhive account``: who may use the web server, with which role, and what they did."""

from __future__ import annotations

import sys

import click

from slamhive.base.bounds import check_text
from slamhive.base.errors import InvalidInput
from slamhive.cli.acting import acting
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.documents.machines import AccountDocument, ApiToken
from slamhive.domain.accounts import Identity, Role, Scope
from slamhive.services.accounts import LONGEST_TOKEN_DAYS, TokenRequest
from slamhive.store import Account

# ``slamhive account token``: personal API tokens.


@click.group("token", short_help="Make, list and revoke API tokens")
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
    """Make the token NAME for ACCOUNT, and print its text.

    The text is stored nowhere.
    """
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
def list_tokens(cli: CliContext, account: str | None, as_json: bool) -> None:
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


MOST_LINES = 10_000
_LONGEST_LINE = 10_000


@click.group("account")
def account() -> None:
    """Say who may use the web server, and see what they did. See docs/accounts.md."""


@account.command("add")
@click.argument("name")
@click.option("--role", type=choice(Role), default=Role.MEMBER.value, show_default=True, help="What it may do.")
@json_option
@pass_cli
def add(cli: CliContext, name: str, role: str, as_json: bool) -> None:
    """Add an account. The password is asked for, or read from standard input."""
    with acting(cli, f"{name} as {role}") as accounts:
        _show(accounts.add(name, Role(role), _new_password()), as_json=as_json)


@account.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List the accounts."""
    found = cli.hive().accounts.list()
    if as_json:
        print_json([AccountDocument.of(entry).content for entry in found])
    elif found:
        rows = [(entry.name, entry.role, f"{entry.created_at:%Y-%m-%d}", _state(entry)) for entry in found]
        print_table(("name", "role", "since", "state"), rows)
    else:
        tell("there are no accounts; slamhive account add NAME --role admin adds the first")


@account.command("role")
@click.argument("name")
@click.argument("role", type=choice(Role))
@json_option
@pass_cli
def role_(cli: CliContext, name: str, role: str, as_json: bool) -> None:
    """Give an account another role, at once."""
    with acting(cli, f"{name} as {role}") as accounts:
        _show(accounts.set_role(name, Role(role)), as_json=as_json)


@account.command("password")
@click.argument("name")
@json_option
@pass_cli
def password(cli: CliContext, name: str, as_json: bool) -> None:
    """Replace a password, asked for or read from standard input. Ends all sessions of the account."""
    with acting(cli, name) as accounts:
        accounts.named(name)
        _show(accounts.set_password(name, _new_password()), as_json=as_json)


@account.command("disable", short_help="Disable an account: its sessions and tokens end")
@click.argument("name")
@json_option
@pass_cli
def disable(cli: CliContext, name: str, as_json: bool) -> None:
    """Disable an account: its sessions end, and its tokens are refused. Its name stays taken."""
    with acting(cli, name) as accounts:
        _show(accounts.disable(name), as_json=as_json)


@account.command("enable")
@click.argument("name")
@json_option
@pass_cli
def enable(cli: CliContext, name: str, as_json: bool) -> None:
    """Let a disabled account be used again, with its tokens."""
    with acting(cli, name) as accounts:
        _show(accounts.enable(name), as_json=as_json)


@account.command("link", short_help="Let a user of OpenID Connect use an account")
@click.argument("name")
@click.argument("subject")
@click.option("--issuer", help="Address of the provider.  [default: OIDC_ISSUER]")
@json_option
@pass_cli
def link(cli: CliContext, name: str, subject: str, issuer: str | None, as_json: bool) -> None:
    """Let the user SUBJECT of a provider of OpenID Connect use the account NAME. SUBJECT is the provider's `sub`."""
    issuer = issuer or cli.hive().settings.oidc_issuer
    if not issuer:
        raise InvalidInput("no provider is named", "give --issuer, or set OIDC_ISSUER")
    with acting(cli, f"{name} to {subject}") as accounts:
        _show(accounts.link(name, Identity(issuer, subject)), as_json=as_json)


@account.command("unlink")
@click.argument("name")
@json_option
@pass_cli
def unlink(cli: CliContext, name: str, as_json: bool) -> None:
    """Let nobody from a provider use the account NAME any more. Ends its sessions."""
    with acting(cli, name) as accounts:
        _show(accounts.unlink(name), as_json=as_json)


@account.command("audit")
@click.option("--account", "name", metavar="NAME", help="Only what this account did.")
@click.option("--limit", type=click.IntRange(1, MOST_LINES), default=50, show_default=True, help="Most lines.")
@json_option
@pass_cli
def audit(cli: CliContext, name: str | None, limit: int, as_json: bool) -> None:
    """List who started, deleted or changed what, the newest first."""
    lines = cli.hive().accounts.audit(limit, account=name)
    if as_json:
        print_json([line.content for line in lines])
    elif lines:
        rows = [
            (f"{line.at:%Y-%m-%d %H:%M:%S}", line.account, line.via, line.address, line.action, line.subject)
            for line in lines
        ]
        print_table(("at", "account", "via", "address", "action", "subject"), rows, cut=("subject",))
    else:
        tell("the audit log is empty")


def _new_password() -> str:
    """A password, typed twice or read as one line. It is no argument, since others can see those."""
    if sys.stdin.isatty():
        return str(click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True))
    line = sys.stdin.readline(_LONGEST_LINE).rstrip("\r\n")
    if not line:
        raise InvalidInput("no password was given", "type it in a terminal, or send it on standard input")
    return check_text(line, "the password")


def _state(entry: Account) -> str:
    return "active" if entry.disabled_at is None else f"disabled {entry.disabled_at:%Y-%m-%d}"


def _show(entry: Account, *, as_json: bool) -> None:
    if as_json:
        print_json(AccountDocument.of(entry).content)
    else:
        say(f"{entry.name}: {entry.role}, {_state(entry)}")


account.add_command(token)


COMMANDS = (account,)
