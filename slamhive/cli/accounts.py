"""``slamhive account``: who may use the web server, with which role, and what they did."""

from __future__ import annotations

import sys

import click

from slamhive.cli.account_tokens import token
from slamhive.cli.acting import acting
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.domain.accounts import Identity, Role
from slamhive.errors import InvalidInput
from slamhive.input_bounds import check_text
from slamhive.schema.accounts import Account, AuditLine
from slamhive.store import Account as AccountRecord

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
        print_json([Account.of(entry).content for entry in found])
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


@account.command("disable")
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


@account.command("link")
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
        print_json([AuditLine.of(line).content for line in lines])
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


def _state(entry: AccountRecord) -> str:
    return "active" if entry.disabled_at is None else f"disabled {entry.disabled_at:%Y-%m-%d}"


def _show(entry: AccountRecord, *, as_json: bool) -> None:
    if as_json:
        print_json(Account.of(entry).content)
    else:
        say(f"{entry.name}: {entry.role}, {_state(entry)}")


account.add_command(token)
COMMANDS = (account,)
