"""Accounts, their sessions and their API tokens. No file, ledger or archive has them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import Row, Select, delete, select, update

from slamhive.domain.accounts import Identity, Role, Scope
from slamhive.errors import Conflict, NotFound, unknown
from slamhive.store import account_models as models
from slamhive.store.account_records import Account, Credentials, Key, KeyKind, NewKey
from slamhive.store.rows import Repository, get_or_insert

MOST_SESSIONS = 20
"""Of one account; a further one ends the oldest."""
_ACCOUNTS = models.Account.__table__
_KEYS = models.AccountKey.__table__
_IDENTITIES = models.AccountIdentity.__table__


class AccountRepository(Repository):
    """Accounts are never removed, so that a name in the audit log always means the same person."""

    def add(self, name: str, role: Role, password_hash: str, now: datetime) -> Account:
        """Add an account; raises Conflict if the name is taken."""
        values = {"role": role, "password_hash": password_hash, "created_at": now}
        get_or_insert(self._connection, models.Account, {"name": name}, values)
        credentials = self.credentials(name)
        if credentials.password_hash != password_hash:  # its salt is random: after a lost answer, this one is ours
            raise Conflict(f"there is an account {name!r} already", "choose another name, or change its password")
        return credentials.account

    def all(self) -> list[Account]:
        """All accounts, by name."""
        return [_account(row) for row in self._connection.execute(select(_ACCOUNTS).order_by(_ACCOUNTS.c.name))]

    def exist(self) -> bool:
        """Whether anybody can sign in."""
        query = select(_ACCOUNTS.c.id).where(_ACCOUNTS.c.disabled_at.is_(None)).limit(1)
        return self._connection.execute(query).first() is not None

    def in_use(self) -> bool:
        """Whether there is any account, even if all are disabled."""
        return self._connection.execute(select(_ACCOUNTS.c.id).limit(1)).first() is not None

    def named(self, name: str) -> Account:
        """The account of that name; raises NotFound."""
        return self.credentials(name).account

    def credentials(self, name: str) -> Credentials:
        """The account of that name with the hash of its password; raises NotFound."""
        found = self.find(name)
        if found is None:
            raise unknown("account", name, [account.name for account in self.all()])
        return found

    def find(self, name: str, *, locked: bool = False) -> Credentials | None:
        """As :meth:`credentials`, or None. ``locked``: nobody changes the account until the transaction ends."""
        query = select(_ACCOUNTS).where(_ACCOUNTS.c.name == name)
        row = self._connection.execute(query.with_for_update() if locked else query).one_or_none()
        return None if row is None else Credentials(_account(row), row.password_hash)

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

    def known_as(self, identity: Identity) -> Credentials | None:
        """The account that this identity belongs to."""
        query = select(_ACCOUNTS).join(_IDENTITIES, _IDENTITIES.c.account_id == _ACCOUNTS.c.id)
        row = self._connection.execute(query.where(_IDENTITIES.c.digest == identity.digest)).one_or_none()
        return None if row is None else Credentials(_account(row), row.password_hash)

    def link(self, account_id: int, identity: Identity, now: datetime) -> None:
        """Let an identity belong to an account; raises Conflict if it belongs to another one."""
        values = {
            "account_id": account_id,
            "issuer": identity.issuer,
            "subject": identity.subject,
            "created_at": now,
        }
        get_or_insert(self._connection, models.AccountIdentity, {"digest": identity.digest}, values)
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
        key_id, _ = get_or_insert(self._connection, models.AccountKey, {"digest": key.digest}, values)
        if key.kind is KeyKind.SESSION:
            self._end_oldest_sessions(account_id)
        return self._key(_joined().where(_KEYS.c.id == key_id))

    def _end_oldest_sessions(self, account_id: int) -> None:
        query = select(_KEYS.c.id).where(_KEYS.c.account_id == account_id, _KEYS.c.kind == KeyKind.SESSION)
        surplus = self._column(query.order_by(_KEYS.c.id.desc()))[MOST_SESSIONS:]
        self._connection.execute(delete(_KEYS).where(_KEYS.c.id.in_(surplus)))

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
            raise NotFound("there is no such API token", "slamhive account token list shows those that exist")
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
