"""Commands whose changes are in the audit log."""

from __future__ import annotations

import getpass
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

import click

from slamhive.cli.context import CliContext
from slamhive.cli.data_root import command_name
from slamhive.clock import utc_now
from slamhive.services.accounts import Accounts
from slamhive.store import Act

COMMAND_LINE = "command line"


@contextmanager
def acting(cli: CliContext, subject: str) -> Iterator[Accounts]:
    """The accounts. What the block changes is in the audit log as done by the user of this machine."""
    hive = cli.hive()
    action = command_name(click.get_current_context())
    with hive.store.acting(Act(uuid.uuid4().hex, utc_now(), _user(), COMMAND_LINE, "", action, subject[:200])):
        yield hive.accounts


def _user() -> str:
    """Return the user who runs this command; the number of a user without a name, as containers have them."""
    try:
        return getpass.getuser()[:64]
    except (KeyError, OSError):
        return f"user {os.getuid()}"
