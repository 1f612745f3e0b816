"""Accounts of one installation, sign-in, and tokens. The store audits changes, if their caller has said who asks."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, Unauthenticated
from slamhive.base.settings import Auth, Mode, Settings
from slamhive.domain.accounts import (
    ANYBODY,
    LOOPBACK_HOSTS,
    MAY,
    WITHOUT_ACCOUNTS,
    Caller,
    Identity,
    Role,
    Scope,
    account_name_of,
    check_account_name,
    check_identity,
    check_password,
    token_may,
)
from slamhive.domain.names import check_name
from slamhive.services.accounts import passwords
from slamhive.store import Account, AccountCredentials, Key, KeyKind, NewKey, Store, Transaction

if TYPE_CHECKING:
    from slamhive.documents.machines import AuditLineDocument

SESSION_LASTS = timedelta(days=14)
LONGEST_TOKEN_DAYS = 366
MOST_TOKENS = 50
TOKEN_BEGINS = "slamhive_"  # noqa: S105 - by which scanners of repositories find tokens
TOUCHED_EVERY = timedelta(hours=1)
_SECRET_BYTES = 32


@dataclass(frozen=True, slots=True)
class AccountSession:
    """Somebody who has signed in; ``secret`` belongs into the browser's cookie."""

    secret: str
    caller: Caller


@dataclass(frozen=True, slots=True)
class TokenRequest:
    """An API token that somebody wants; it can be used for ``days``."""

    name: str
    scopes: Sequence[Scope]
    days: int = 90


class Accounts:
    """Accounts, sessions, tokens and the audit log.

    Args:
        store: The database.
        clock: The time.
    """

    def __init__(self, store: Store, clock: Callable[[], datetime] = utc_now) -> None:
        self._store = store
        self._now = clock

    # -- accounts ----------------------------------------------------------------------------------------------------

    def add(self, name: str, role: Role, password: str) -> Account:
        """Add an account; raises InvalidInput for a bad name or password, Conflict for a name that is taken."""
        password_hash = passwords.hash_password(check_password(check_account_name(name), password))
        now = self._now()
        return self._store.write(lambda t: t.accounts.add(name, role, password_hash, now))

    def list(self) -> Sequence[Account]:
        """All accounts, by name."""
        return self._store.read(lambda t: t.accounts.all())

    def named(self, name: str) -> Account:
        """One account; raises NotFound."""
        return self._store.read(lambda t: t.accounts.named(name))

    def exist(self) -> bool:
        """Tell if anybody can sign in."""
        return self._store.read(lambda t: t.accounts.exist())

    def in_use(self) -> bool:
        """Tell if there ever was an account: then not everybody may see everything."""
        return self._store.read(lambda t: t.accounts.in_use())

    def set_role(self, name: str, role: Role) -> Account:
        """Give the account another role, at once for its sessions and tokens too."""
        return self._changed(name, lambda t, _account: t.accounts.set_role(name, role))

    def disable(self, name: str) -> Account:
        """Nobody can use the account any more. Its sessions end; its tokens work again if it is enabled."""
        now = self._now()

        def work(t: Transaction, account: Account) -> None:
            t.accounts.set_disabled(name, now)
            t.accounts.end_sessions(account.id)

        return self._changed(name, work)

    def enable(self, name: str) -> Account:
        """The account can be used again."""
        return self._changed(name, lambda t, _account: t.accounts.set_disabled(name, None))

    def set_password(self, name: str, password: str) -> Account:
        """Replace the password and end all sessions; tokens stay."""
        password_hash = passwords.hash_password(check_password(self.named(name).name, password))

        def work(t: Transaction, account: Account) -> None:
            t.accounts.set_password(name, password_hash)
            t.accounts.end_sessions(account.id)

        return self._changed(name, work)

    def _changed(self, name: str, work: Callable[[Transaction, Account], None]) -> Account:
        """Change an account while nobody else does; raises NotFound."""

        def change(t: Transaction) -> Account:
            t.accounts.find(name, locked=True)
            work(t, t.accounts.named(name))
            return t.accounts.named(name)

        return self._store.write(change)

    # -- sessions ----------------------------------------------------------------------------------------------------

    def sign_in(self, name: str, password: str) -> AccountSession:
        """Begin a session. Raises Unauthenticated, in the same words and after the same time whatever is wrong."""
        found = self._store.read(lambda t: t.accounts.find(name))
        if not passwords.is_password(None if found is None else found.password_hash, password) or found is None:
            raise _refused()
        renewed = passwords.hash_password(password) if passwords.is_outdated(found.password_hash) else None
        secret = secrets.token_urlsafe(_SECRET_BYTES)
        key = self._new_key(KeyKind.SESSION, secret, SESSION_LASTS)
        self._store.write(lambda t: _open_session(t, found, key, renewed))
        return AccountSession(secret, _session_caller(found.account))

    def sign_in_as(self, identity: Identity, new: Role | None = None) -> AccountSession:
        """Begin a session for somebody whom a provider vouches for.

        Args:
            identity: Who they are there.
            new: The role of an account that is made for somebody unknown; None makes none.

        Raises:
            Unauthenticated: No account belongs to them, or it is disabled.
            Conflict: The name that a new account would have is taken.
        """
        check_identity(identity)
        found = self._store.read(lambda t: t.accounts.known_as(identity))
        if found is None:
            if new is None:
                raise Unauthenticated(
                    f"no account here belongs to {identity.name or identity.subject!r}",
                    "ask an admin, who links one with slamhive account link",
                )
            # Add an account with a password that nobody knows.
            name, now = account_name_of(identity.name or identity.subject), self._now()
            password_hash = passwords.hash_password(secrets.token_urlsafe(_SECRET_BYTES))

            def work(t: Transaction) -> AccountCredentials:
                if t.accounts.find(name, locked=True) is not None:
                    raise Conflict(
                        f"the name {name!r} is taken here", "ask an admin to link it (slamhive account link)"
                    )
                account = t.accounts.add(name, new, password_hash, now)
                t.accounts.link(account.id, identity, now)
                return AccountCredentials(account, password_hash)

            found = self._store.write(work)
        secret = secrets.token_urlsafe(_SECRET_BYTES)
        key, known = self._new_key(KeyKind.SESSION, secret, SESSION_LASTS), found
        self._store.write(lambda t: _open_session(t, known, key, None))
        return AccountSession(secret, _session_caller(found.account))

    def link(self, name: str, identity: Identity) -> Account:
        """Let somebody whom a provider vouches for use an account; raises NotFound, InvalidInput or Conflict."""
        check_identity(identity)
        now = self._now()
        return self._changed(name, lambda t, account: t.accounts.link(account.id, identity, now))

    def unlink(self, name: str) -> Account:
        """Nobody comes from a provider to this account any more. Its sessions end."""

        def work(t: Transaction, account: Account) -> None:
            t.accounts.unlink(account.id)
            t.accounts.end_sessions(account.id)

        return self._changed(name, work)

    def identities(self, name: str) -> Sequence[Identity]:
        """Find the account of a person from a provider; raises NotFound."""
        return self._store.read(lambda t: t.accounts.identities(t.accounts.named(name).id))

    def check_own_password(self, name: str, password: str) -> None:
        """Raise Unauthenticated unless this is the password of the account."""
        found = self._store.read(lambda t: t.accounts.credentials(name))
        if not passwords.is_password(found.password_hash, password):
            raise Unauthenticated("the present password is wrong")

    def sign_out(self, secret: str) -> None:
        """End a session; one that has ended stays so."""
        self._store.write(lambda t: t.accounts.end_session(digest_of(secret)))

    def by_session(self, secret: str) -> Caller | None:
        """Whose session this is; None if it has ended, or its account is disabled."""
        now = self._now()
        key = self._store.read(lambda t: t.accounts.key(KeyKind.SESSION, digest_of(secret), now))
        return None if key is None else _session_caller(key.account)

    # -- tokens ------------------------------------------------------------------------------------------------------

    def create_token(self, name: str, request: TokenRequest) -> tuple[Key, str]:
        """A new API token of an account, and its text, which is stored nowhere."""
        check_name("token", request.name)
        if not request.scopes:
            raise InvalidInput("the token has no scope", f"choose from {', '.join(Scope)}")
        if not 1 <= request.days <= LONGEST_TOKEN_DAYS:
            raise InvalidInput(f"{request.days} days are not allowed", f"use 1 to {LONGEST_TOKEN_DAYS}")
        text = TOKEN_BEGINS + secrets.token_urlsafe(_SECRET_BYTES)
        scopes = tuple(scope for scope in Scope if scope in request.scopes)
        key = self._new_key(KeyKind.TOKEN, text, timedelta(days=request.days), request.name, scopes)

        def work(t: Transaction) -> Key:
            account = t.accounts.named(name)
            # Without ours, which is there after a lost answer.
            tokens = [token for token in t.accounts.tokens(name) if token.digest != key.digest]
            if any(token.name == key.name for token in tokens):
                raise Conflict(f"{name} has a token {key.name!r} already", "revoke it, or choose another name")
            if len(tokens) >= MOST_TOKENS:
                raise Conflict(f"{name} has {MOST_TOKENS} tokens already", "revoke those that nobody uses")
            return t.accounts.add_key(account.id, key)

        return self._store.write(work), text

    def tokens(self, name: str | None = None) -> Sequence[Key]:
        """The API tokens of one account, or of all; raises NotFound."""
        return self._store.read(lambda t: t.accounts.tokens(None if name is None else t.accounts.named(name).name))

    def revoke(self, key_id: int, owner: str | None = None) -> Key:
        """End an API token; raises NotFound, also if it is not that of ``owner``."""
        key = self._store.read(lambda t: t.accounts.token(key_id, owner))
        self._store.write(lambda t: t.accounts.revoke(key_id))
        return key

    def by_token(self, text: str) -> Caller:
        """Whose token this is; raises Unauthenticated if it is unknown, has expired, or its account is disabled."""
        now = self._now()
        key = self._store.read(lambda t: t.accounts.key(KeyKind.TOKEN, digest_of(text), now))
        if key is None:
            raise Unauthenticated(
                "the API token is unknown, was revoked or has expired",
                "create another on your account page",
            )
        if key.used_at is None or now - key.used_at > TOUCHED_EVERY:
            self._store.write(lambda t: t.accounts.touch(key.id, now))
        return Caller(token_may(key.account.role, key.scopes), key.owner, key.account.role, key.name)

    # -- audit log ---------------------------------------------------------------------------------------------------

    def audit(self, limit: int, before: int | None = None, account: str | None = None) -> Sequence[AuditLineDocument]:
        """The newest lines of the audit log; ``before`` continues after the line of that number."""
        return self._store.read(lambda t: t.audit.lines(limit, before, account))

    def _new_key(
        self, kind: KeyKind, secret: str, lasts: timedelta, name: str = "", scopes: tuple[Scope, ...] = ()
    ) -> NewKey:
        now = self._now()
        return NewKey(kind, digest_of(secret), now, now + lasts, name, scopes)


def digest_of(secret: str) -> str:
    """Return the stored form of a secret. It has 256 random bits, so that a slow hash would add nothing."""
    return hashlib.sha256(secret.encode()).hexdigest()


def _session_caller(account: Account) -> Caller:
    return Caller(MAY[account.role], account.name, account.role)


def _open_session(t: Transaction, found: AccountCredentials, key: NewKey, renewed: str | None) -> None:
    """Store a session, unless password or account have changed since ``found`` was read."""
    current = t.accounts.find(found.account.name, locked=True)
    if current != found or found.account.disabled_at is not None:
        raise _refused()
    if renewed is not None:
        t.accounts.set_password(found.account.name, renewed)
    t.accounts.forget_expired_sessions(key.created_at)
    t.accounts.add_key(found.account.id, key)


def _refused() -> Unauthenticated:
    return Unauthenticated("name or password is wrong")


def accounts_needed(settings: Settings, host: str) -> bool:
    """Tell if a server that binds to ``host`` asks for sign-in. One that only shows never does."""
    if settings.mode is Mode.VIEW_ONLY:
        return False
    if settings.auth is Auth.AUTO:
        return host not in LOOPBACK_HOSTS
    return settings.auth is Auth.ACCOUNTS


# Where there are accounts, only what is public leaves, unless somebody asks for all of it.


@contextmanager
def published(store: Store, *, unpublished: bool = False) -> Iterator[None]:
    """In the block, this thread finds only what is public; in an installation without accounts, all but private runs.

    ``unpublished``: it finds everything all the same.
    """
    viewer = store.viewer
    if not unpublished:
        viewer = ANYBODY if store.read(lambda t: t.accounts.in_use()) else WITHOUT_ACCOUNTS
    with store.seen_by(viewer):
        yield
