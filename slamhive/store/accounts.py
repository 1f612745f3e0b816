"""Accounts, their sessions and their API tokens. No file, ledger or archive has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from sqlalchemy import ForeignKey, Index, Integer, Row, Select, String, delete, select, update

from slamhive.base.errors import Conflict, NotFound, unknown
from slamhive.domain.accounts import Identity, Role, Scope
from slamhive.store.changes import changes_of
from slamhive.store.models import NAME_LENGTH
from slamhive.store.rows import Repository, cut, get_or_insert
from slamhive.store.tables import TABLE_OPTIONS, JsonText, TableBase, UtcDateTime, column, enum_column, optional

if TYPE_CHECKING:
    from slamhive.documents.machines import AuditLineDocument

# -- values: secrets go in as digests, and no secret comes out but the hash of a password ------------------------------


class KeyKind(StrEnum):
    """The purpose of a key: the session of a browser, or a personal API token."""

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
class AccountCredentials:
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
class AuditAct:
    """A request by an account. The first transaction that stores something for it stores a line of the audit log.

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


# -- tables ------------------------------------------------------------------------------------------------------------


class AccountRow(TableBase):
    """Somebody who can sign in. Rows are never removed."""

    __tablename__ = "accounts"
    id = column(Integer, primary_key=True)
    name = column(String(NAME_LENGTH), unique=True)
    role = column(enum_column(Role))
    password_hash = column(String(190))
    created_at = column(UtcDateTime)
    disabled_at = optional(UtcDateTime)


class AccountKeyRow(TableBase):
    """A session or an API token. Only the SHA-256 digest of its secret is stored."""

    __tablename__ = "account_keys"
    id = column(Integer, primary_key=True)
    account_id = column(Integer, ForeignKey("accounts.id"), index=True)
    kind = column(enum_column(KeyKind))
    name = column(String(NAME_LENGTH))
    digest = column(String(64), unique=True)
    scopes = column(JsonText)
    created_at = column(UtcDateTime)
    expires_at = column(UtcDateTime)
    used_at = optional(UtcDateTime)


class AccountIdentityRow(TableBase):
    """An account's identity at an OpenID Connect provider; ``digest`` identifies issuer and subject together."""

    __tablename__ = "account_identities"
    id = column(Integer, primary_key=True)
    account_id = column(Integer, ForeignKey("accounts.id"), index=True)
    digest = column(String(64), unique=True)
    issuer = column(String(500))
    subject = column(String(255))
    created_at = column(UtcDateTime)


class AuditLineRow(TableBase):
    """A line of the audit log. The name of the account is text, so that the line needs no other row."""

    __tablename__ = "audit_log"
    __table_args__ = (Index("ix_audit_log_account", "account", "id"), TABLE_OPTIONS)
    id = column(Integer, primary_key=True)
    uid = column(String(32), unique=True)
    at = column(UtcDateTime)
    account = column(String(NAME_LENGTH))
    via = column(String(100))
    address = column(String(64))
    action = column(String(64))
    subject = column(String(500))


MOST_SESSIONS = 20
"""Of one account; a further one ends the oldest."""
_ACCOUNTS = AccountRow.__table__
_KEYS = AccountKeyRow.__table__
_IDENTITIES = AccountIdentityRow.__table__


class AccountRepository(Repository):
    """Accounts are never removed, so that a name in the audit log always means the same person."""

    def add(self, name: str, role: Role, password_hash: str, now: datetime) -> Account:
        """Add an account; raises Conflict if the name is taken."""
        values = {"role": role, "password_hash": password_hash, "created_at": now}
        get_or_insert(self._connection, AccountRow, {"name": name}, values)
        credentials = self.credentials(name)
        if credentials.password_hash != password_hash:  # its salt is random: after a lost answer, this one is ours
            raise Conflict(f"there is an account {name!r} already", "choose another name, or change its password")
        return credentials.account

    def all(self) -> list[Account]:
        """All accounts, by name."""
        return [_account(row) for row in self._connection.execute(select(_ACCOUNTS).order_by(_ACCOUNTS.c.name))]

    def exist(self) -> bool:
        """True if anybody can sign in."""
        query = select(_ACCOUNTS.c.id).where(_ACCOUNTS.c.disabled_at.is_(None)).limit(1)
        return self._connection.execute(query).first() is not None

    def in_use(self) -> bool:
        """True if there is any account, even a disabled one."""
        return self._connection.execute(select(_ACCOUNTS.c.id).limit(1)).first() is not None

    def named(self, name: str) -> Account:
        """The account of that name; raises NotFound."""
        return self.credentials(name).account

    def credentials(self, name: str) -> AccountCredentials:
        """The account of that name with the hash of its password; raises NotFound."""
        found = self.find(name)
        if found is None:
            raise unknown("account", name, [account.name for account in self.all()])
        return found

    def find(self, name: str, *, locked: bool = False) -> AccountCredentials | None:
        """Like :meth:`credentials`, or None. ``locked``: nobody changes the account until the transaction ends."""
        query = select(_ACCOUNTS).where(_ACCOUNTS.c.name == name)
        row = self._connection.execute(query.with_for_update() if locked else query).one_or_none()
        return None if row is None else AccountCredentials(_account(row), row.password_hash)

    def set_password(self, name: str, password_hash: str) -> None:
        """Replace the hash of a password."""
        self._update(name, password_hash=password_hash)

    def set_role(self, name: str, role: Role) -> None:
        """Replace the role."""
        self._update(name, role=role)

    def set_disabled(self, name: str, at: datetime | None) -> None:
        """Disable the account, or enable it again (None)."""
        self._update(name, disabled_at=at)

    def _update(self, name: str, **values: Any) -> None:
        self._connection.execute(update(_ACCOUNTS).where(_ACCOUNTS.c.name == name).values(values))

    # -- who somebody is elsewhere -----------------------------------------------------------------------------------

    def known_as(self, identity: Identity) -> AccountCredentials | None:
        """The account that this identity belongs to."""
        query = select(_ACCOUNTS).join(_IDENTITIES, _IDENTITIES.c.account_id == _ACCOUNTS.c.id)
        row = self._connection.execute(query.where(_IDENTITIES.c.digest == identity.digest)).one_or_none()
        return None if row is None else AccountCredentials(_account(row), row.password_hash)

    def link(self, account_id: int, identity: Identity, now: datetime) -> None:
        """Let an identity belong to an account; raises Conflict if it belongs to another one."""
        values = {
            "account_id": account_id,
            "issuer": identity.issuer,
            "subject": identity.subject,
            "created_at": now,
        }
        get_or_insert(self._connection, AccountIdentityRow, {"digest": identity.digest}, values)
        found = self.known_as(identity)
        if found is None or found.account.id != account_id:
            owner = "nobody" if found is None else found.account.name
            raise Conflict(f"{identity.subject!r} belongs to the account {owner}", "unlink it first")

    def identities(self, account_id: int) -> list[Identity]:
        """The identities of an account."""
        query = select(_IDENTITIES.c.issuer, _IDENTITIES.c.subject).where(_IDENTITIES.c.account_id == account_id)
        return [Identity(row.issuer, row.subject) for row in self._connection.execute(query.order_by(_IDENTITIES.c.id))]

    def unlink(self, account_id: int) -> None:
        """Remove all identities of an account."""
        self._connection.execute(delete(_IDENTITIES).where(_IDENTITIES.c.account_id == account_id))

    # -- sessions and tokens -----------------------------------------------------------------------------------------

    def add_key(self, account_id: int, key: NewKey) -> Key:
        """Store a session or token. Of sessions, the newest few are kept."""
        values = {
            **{name: getattr(key, name) for name in ("kind", "name", "created_at", "expires_at")},
            "account_id": account_id,
            "scopes": list(key.scopes),
        }
        key_id, _ = get_or_insert(self._connection, AccountKeyRow, {"digest": key.digest}, values)
        if key.kind is KeyKind.SESSION:
            mine = select(_KEYS.c.id).where(_KEYS.c.account_id == account_id, _KEYS.c.kind == KeyKind.SESSION)
            surplus = self._column(mine.order_by(_KEYS.c.id.desc()))[MOST_SESSIONS:]
            self._connection.execute(delete(_KEYS).where(_KEYS.c.id.in_(surplus)))
        return self._key(_joined().where(_KEYS.c.id == key_id))

    def key(self, kind: KeyKind, digest: str, now: datetime) -> Key | None:
        """The session or token of this digest; None if there is none, it has expired, or its account is disabled."""
        query = _joined().where(
            _KEYS.c.digest == digest,
            _KEYS.c.kind == kind,
            _KEYS.c.expires_at > now,
            _ACCOUNTS.c.disabled_at.is_(None),
        )
        row = self._connection.execute(query).one_or_none()
        return None if row is None else _key(row)

    def tokens(self, name: str | None = None) -> list[Key]:
        """The API tokens of one account, or of all; also those that have expired."""
        query = _joined().where(_KEYS.c.kind == KeyKind.TOKEN)
        if name is not None:
            query = query.where(_ACCOUNTS.c.name == name)
        rows = self._connection.execute(query.order_by(_ACCOUNTS.c.name, _KEYS.c.id))
        return [_key(row) for row in rows]

    def token(self, key_id: int, owner: str | None = None) -> Key:
        """One API token; raises NotFound, also if it is not that of ``owner``."""
        query = _joined().where(_KEYS.c.id == key_id, _KEYS.c.kind == KeyKind.TOKEN)
        return self._key(query if owner is None else query.where(_ACCOUNTS.c.name == owner))

    def touch(self, key_id: int, now: datetime) -> None:
        """Note that a token is used."""
        self._connection.execute(update(_KEYS).where(_KEYS.c.id == key_id).values(used_at=now))

    def revoke(self, key_id: int) -> None:
        """Remove an API token."""
        self._connection.execute(delete(_KEYS).where(_KEYS.c.id == key_id, _KEYS.c.kind == KeyKind.TOKEN))

    def end_session(self, digest: str) -> None:
        """Remove one session, if it is there."""
        self._connection.execute(delete(_KEYS).where(_KEYS.c.digest == digest, _KEYS.c.kind == KeyKind.SESSION))

    def end_sessions(self, account_id: int) -> None:
        """Remove all sessions of an account."""
        self._connection.execute(delete(_KEYS).where(_KEYS.c.account_id == account_id, _KEYS.c.kind == KeyKind.SESSION))

    def forget_expired_sessions(self, now: datetime) -> None:
        """Remove sessions that have expired. Expired tokens stay in the list of their owner."""
        self._connection.execute(delete(_KEYS).where(_KEYS.c.kind == KeyKind.SESSION, _KEYS.c.expires_at <= now))

    def _key(self, query: Select[Any]) -> Key:
        row = self._connection.execute(query).one_or_none()
        if row is None:
            raise NotFound("unknown API token", "slamhive account token list shows those that exist")
        return _key(row)


_OF_KEY = ("id", "kind", "name", "digest", "scopes", "created_at", "expires_at", "used_at")


def _joined() -> Select[Any]:
    """Keys with their accounts."""
    own = [_KEYS.c[name].label(f"key_{name}") for name in _OF_KEY]
    return select(*own, *_ACCOUNTS.c).join(_ACCOUNTS, _KEYS.c.account_id == _ACCOUNTS.c.id)


def _account(row: Row[Any]) -> Account:
    return Account(row.id, row.name, row.role, row.created_at, row.disabled_at)


def _key(row: Row[Any]) -> Key:
    return Key(
        id=row.key_id,
        account=_account(row),
        kind=row.key_kind,
        name=row.key_name,
        digest=row.key_digest,
        scopes=tuple(Scope(scope) for scope in row.key_scopes),
        created_at=row.key_created_at,
        expires_at=row.key_expires_at,
        used_at=row.key_used_at,
    )


# -- the audit log: a line is stored in the transaction of its change, so neither is there alone -----------------------

SUBJECT_LENGTH = 500
_AUDIT = AuditLineRow.__table__


class AuditRepository(Repository):
    """Lines are added and read; nothing changes or removes them."""

    def add(self, act: AuditAct) -> None:
        """Store the line of ``act``, with what the transaction has stored so far; twice does no harm."""
        subject = "; ".join(part for part in (act.subject, *self._stored()) if part)
        values = {
            **{name: getattr(act, name) for name in ("at", "account", "via", "address", "action")},
            "subject": cut(subject, SUBJECT_LENGTH),
        }
        get_or_insert(self._connection, AuditLineRow, {"uid": act.uid}, values)

    def lines(self, limit: int, before: int | None = None, account: str | None = None) -> list[AuditLineDocument]:
        """The newest lines, of one account or of all; ``before`` continues after the line of that id."""
        from slamhive.documents.machines import AuditLineDocument  # noqa: PLC0415 - loads pydantic

        query = (
            select(*(_AUDIT.c[name] for name in AuditLineDocument.model_fields))
            .order_by(_AUDIT.c.id.desc())
            .limit(limit)
        )
        if before is not None:
            query = query.where(_AUDIT.c.id < before)
        if account is not None:
            query = query.where(_AUDIT.c.account == account)
        return [AuditLineDocument(**row._mapping) for row in self._connection.execute(query)]

    def _stored(self) -> Iterator[str]:
        """The numbers of new runs and names of experiments: the request does not have them."""
        changes = changes_of(self._connection)
        runs = [row.id for row in changes.runs]
        if runs:
            yield f"queued {in_ranges(runs)}"
        yield from sorted(changes.started)


def in_ranges(numbers: Sequence[int]) -> str:
    """Numbers of runs in words: ``runs 3, 5 to 8``."""
    ranges: list[list[int]] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    words = [str(first) if first == last else f"{first} to {last}" for first, last in ranges]
    return f"run{'s' if len(numbers) > 1 else ''} {', '.join(words)}"
