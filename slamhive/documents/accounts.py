"""Accounts, API tokens and the audit log as JSON. No document holds a secret."""

from __future__ import annotations

from typing import Annotated

from slamhive.documents.model import Document, Timestamp, described
from slamhive.domain.accounts import Role, Scope


class AccountDocument(Document):
    """Somebody who can sign in."""

    name: str
    role: Role
    created_at: Timestamp
    disabled_at: Annotated[Timestamp | None, described("Since when it cannot be used; null if it can.")]


class ApiToken(Document):
    """A personal API token, without its text."""

    id: int
    owner: Annotated[str, described("The name of its account.")]
    name: str
    scopes: Annotated[tuple[Scope, ...], described("What it may do, as far as the role of its owner allows it.")]
    created_at: Timestamp
    expires_at: Timestamp
    used_at: Annotated[Timestamp | None, described("When it was last used, to the hour; null for never.")]


class AuditLineDocument(Document):
    """Record of a user and the change they asked for. The line was stored in the transaction of the change."""

    id: int
    at: Timestamp
    account: Annotated[str, described("The account, or the user of the machine for a command.")]
    via: Annotated[str, described("pages, the name of an API token, or command line.")]
    address: Annotated[str, described("Network address of the caller; empty for a command.")]
    action: Annotated[str, described("The name of the page's action, API call or command.")]
    subject: Annotated[str, described("On what, and which runs and experiments were stored.")]
