"""The data root that each command expects, and the commands whose changes are in the audit log."""

from __future__ import annotations

import getpass
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from slamhive.base.clock import utc_now
from slamhive.cli.context import CliContext
from slamhive.services.data_root import DataRoot

if TYPE_CHECKING:
    from slamhive.services.accounts import Accounts

EXPECTED: dict[str, DataRoot] = {
    "algorithm build": DataRoot.MADE,
    "algorithm import": DataRoot.MADE,
    "algorithm weights": DataRoot.MADE,
    "archive import": DataRoot.MADE,
    "challenge create": DataRoot.MADE,
    "dataset fetch": DataRoot.MADE,
    "dataset import": DataRoot.MADE,
    "dataset room": DataRoot.MADE,
    "demo": DataRoot.MADE,
    "replay": DataRoot.MADE,
    "runs import": DataRoot.MADE,
    "serve": DataRoot.MADE,
    "worker": DataRoot.MADE,
    "account add": DataRoot.FOUND,
    "challenge cancel": DataRoot.FOUND,
    "challenge close": DataRoot.FOUND,
    "challenge evaluate": DataRoot.FOUND,
    "challenge phase": DataRoot.FOUND,
    "challenge remove": DataRoot.FOUND,
    "challenge submit": DataRoot.FOUND,
    "configuration create": DataRoot.FOUND,
    "configuration import": DataRoot.FOUND,
    "algorithm test": DataRoot.FOUND,
    "experiment start": DataRoot.FOUND,
    "gate bisect": DataRoot.FOUND,
    "gate check": DataRoot.FOUND,
    "gate shrink": DataRoot.FOUND,
    "reindex": DataRoot.FOUND,
    "run": DataRoot.FOUND,
    "algorithm list": DataRoot.OPTIONAL,
    "algorithm show": DataRoot.OPTIONAL,
    "cloud down": DataRoot.OPTIONAL,
    "cloud status": DataRoot.OPTIONAL,
    "cloud sweep": DataRoot.OPTIONAL,
    "dataset links": DataRoot.OPTIONAL,
    "dataset search": DataRoot.OPTIONAL,
    "doctor": DataRoot.OPTIONAL,
    "experiment convert": DataRoot.OPTIONAL,
    "plugins": DataRoot.OPTIONAL,
}
"""By the name of a command. All others read, and refuse a data root that does not exist."""

LISTS = frozenset(
    {
        *(
            "account audit",
            "account list",
            "algorithm list",
            "compare",
            "configuration groups",
            "configuration list",
            "configuration show",
            "dataset list",
            "find",
        ),
        *("experiment list", "experiment report", "experiment status", "protocol compare", "protocol list"),
        *("algorithm versions", "compare", "runs", "runs show", "search list", "variants list"),
    }
)
"""Commands that print what is stored. All that one of them reads is of the same moment."""


def expected_of(context: click.Context) -> DataRoot:
    """Return what the command that runs in ``context`` expects of the data root."""
    return EXPECTED.get(command_name(context), DataRoot.READ)


def command_name(context: click.Context) -> str:
    """The name of the command with those of its groups, without the program's: ``dataset room``."""
    names: list[str] = []
    while context.parent is not None:
        names.insert(0, context.command.name or "")
        context = context.parent
    return " ".join(names)


COMMAND_LINE = "command line"


@contextmanager
def acting(cli: CliContext, subject: str) -> Iterator[Accounts]:
    """The accounts. What the block changes is in the audit log as done by the user of this machine."""
    # Lists ask this module what they expect of the data root, and need neither the accounts nor the store's records.
    from slamhive.store import AuditAct  # noqa: PLC0415

    hive = cli.hive()
    action = command_name(click.get_current_context())
    try:
        user = getpass.getuser()[:64]
    except (KeyError, OSError):
        user = f"user {os.getuid()}"  # users of containers may have no name
    with hive.store.acting(AuditAct(uuid.uuid4().hex, utc_now(), user, COMMAND_LINE, "", action, subject[:200])):
        yield hive.accounts
