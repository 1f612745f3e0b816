"""What the store says of accounts. Secrets go in as digests, and no secret comes out but the hash of a password."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from slamhive.domain.accounts import Role, Scope


class KeyKind(StrEnum):
    """What a key is for: the session of a browser, or a personal API token."""

    SESSION = "session"
    TOKEN = "token"  # noqa: S105 - a kind, not a secret


@dataclass(frozen=True, slots=True)
class Account:
    """One account; ``disabled_at`` is when it was disabled, None while it can be used."""

    id: int
    name: str
    role: Role
    created_at: datetime
    disabled_at: datetime | None


@dataclass(frozen=True, slots=True)
class Credentials:
    """An account with the hash of its password."""

    account: Account
    password_hash: str


@dataclass(frozen=True, slots=True)
class NewKey:
    """A session or token to store. ``digest`` is that of its secret. Sessions have no name and no scopes."""

    kind: KeyKind
    digest: str
    created_at: datetime
    expires_at: datetime
    name: str = ""
    scopes: tuple[Scope, ...] = ()


@dataclass(frozen=True, slots=True)
class Key:
    """A stored session or token with its account; ``used_at`` is when it was last used, to the hour."""

    id: int
    account: Account
    kind: KeyKind
    name: str
    digest: str
    scopes: tuple[Scope, ...]
    created_at: datetime
    expires_at: datetime
    used_at: datetime | None

    @property
    def owner(self) -> str:
        """The name of its account."""
        return self.account.name


@dataclass(frozen=True, slots=True)
class Act:
    """What somebody asked for. The first transaction that stores something for it stores a line of the audit log.

    ``uid``: identifies the line if a transaction is tried again. ``account``: who. ``via``: page, token or
    command line. ``address``: of the network, empty for the command line. ``action`` and ``subject``: what, on what.
    """

    uid: str
    at: datetime
    account: str
    via: str
    address: str
    action: str
    subject: str


@dataclass(frozen=True, slots=True)
class AuditLine:
    """A line of the audit log; see :class:`Act`."""

    id: int
    at: datetime
    account: str
    via: str
    address: str
    action: str
    subject: str
