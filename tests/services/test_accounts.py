"""Accounts: who is let in, what ends a session, what a token is, and that no file holds any of it."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from argon2 import PasswordHasher
from argon2.profiles import get_default_parameters

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unauthenticated, Unavailable
from slamhive.base.settings import Auth, Mode, Settings
from slamhive.domain.accounts import MAY, Action, Role, Scope
from slamhive.services.accounts import Accounts, TokenRequest, accounts_needed, passwords
from slamhive.services.accounts.service import LONGEST_TOKEN_DAYS, SESSION_LASTS, TOKEN_BEGINS, digest_of
from slamhive.services.archive import ExportRequest, export_archive
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from slamhive.store import AuditAct
from tests.cheap_passwords import cheap_passwords
from tests.services.archive_world import make_runs

pytestmark = pytest.mark.quick

PASSWORD = "correct horse battery"
NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)


class Clock:
    def __init__(self) -> None:
        self.now = NOW

    def __call__(self) -> datetime:
        return self.now


@pytest.fixture(autouse=True)
def cheap() -> Iterator[None]:
    with cheap_passwords():
        yield


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def accounts(hive: Hive, clock: Clock) -> Accounts:
    """Anna may change things, and has an API token that may."""
    found = Accounts(hive.store, clock)
    found.add("anna", Role.MEMBER, PASSWORD)
    return found


@pytest.mark.parametrize(
    ("mode", "auth", "host", "needed"),
    [
        (Mode.WORKSTATION, Auth.AUTO, "127.0.0.1", False),
        (Mode.WORKSTATION, Auth.AUTO, "::1", False),
        (Mode.WORKSTATION, Auth.AUTO, "localhost", False),
        (Mode.WORKSTATION, Auth.AUTO, "0.0.0.0", True),
        (Mode.WORKSTATION, Auth.AUTO, "::", True),
        (Mode.WORKSTATION, Auth.AUTO, "lab-server", True),
        (Mode.WORKSTATION, Auth.NONE, "0.0.0.0", False),
        (Mode.WORKSTATION, Auth.ACCOUNTS, "127.0.0.1", True),
        (Mode.VIEW_ONLY, Auth.AUTO, "0.0.0.0", False),
        (Mode.VIEW_ONLY, Auth.ACCOUNTS, "0.0.0.0", False),
    ],
)
def test_when_callers_have_to_sign_in(mode: Mode, auth: Auth, host: str, needed: bool) -> None:
    assert accounts_needed(Settings(mode=mode, auth=auth), host) is needed


def test_the_right_password_begins_a_session(accounts: Accounts) -> None:
    session = accounts.sign_in("anna", PASSWORD)
    caller = accounts.by_session(session.secret)
    assert caller == session.caller
    assert caller is not None
    assert (caller.account, caller.role, caller.may, caller.token) == ("anna", Role.MEMBER, MAY[Role.MEMBER], "")
    accounts.sign_out(session.secret)
    accounts.sign_out(session.secret)
    assert accounts.by_session(session.secret) is None


@pytest.mark.parametrize(
    ("name", "password"),
    [("anna", "wrong"), ("anna", ""), ("ben", PASSWORD), ("ben", ""), ("ANNA", PASSWORD), ("", "")],
)
def test_whatever_is_wrong_the_words_are_the_same(accounts: Accounts, name: str, password: str) -> None:
    with pytest.raises(Unauthenticated) as refused:
        accounts.sign_in(name, password)
    assert str(refused.value) == "name or password is wrong"


def test_an_unknown_name_costs_as_much_as_a_wrong_password(accounts: Accounts, monkeypatch: pytest.MonkeyPatch) -> None:
    verified: list[str] = []
    verify = PasswordHasher.verify

    def counted(hasher: PasswordHasher, password_hash: str, password: str) -> bool:
        verified.append(password_hash.split("$")[3])
        return verify(hasher, password_hash, password)

    monkeypatch.setattr(PasswordHasher, "verify", counted)
    for name in ("anna", "ben"):
        with pytest.raises(Unauthenticated):
            accounts.sign_in(name, "wrong")
    assert len(verified) == 2
    assert verified[0] == verified[1], "other parameters take another time"


def test_sessions_expire(accounts: Accounts, clock: Clock) -> None:
    session = accounts.sign_in("anna", PASSWORD)
    clock.now += SESSION_LASTS - timedelta(seconds=1)
    assert accounts.by_session(session.secret) is not None
    clock.now += timedelta(seconds=1)
    assert accounts.by_session(session.secret) is None


def test_a_new_password_ends_sessions_and_leaves_tokens(accounts: Accounts) -> None:
    session = accounts.sign_in("anna", PASSWORD)
    _, text = accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))
    accounts.set_password("anna", "another long password")
    assert accounts.by_session(session.secret) is None
    with pytest.raises(Unauthenticated):
        accounts.sign_in("anna", PASSWORD)
    assert accounts.by_token(text).account == "anna"
    assert accounts.sign_in("anna", "another long password")


def test_a_disabled_account_is_refused_everywhere(accounts: Accounts) -> None:
    session = accounts.sign_in("anna", PASSWORD)
    _, text = accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))
    assert accounts.disable("anna").disabled_at == NOW
    assert accounts.by_session(session.secret) is None
    with pytest.raises(Unauthenticated, match="revoked"):
        accounts.by_token(text)
    with pytest.raises(Unauthenticated, match="name or password is wrong"):
        accounts.sign_in("anna", PASSWORD)
    accounts.enable("anna")
    assert accounts.by_session(session.secret) is None
    assert accounts.by_token(text).account == "anna"


def test_another_role_counts_at_once(accounts: Accounts) -> None:
    session = accounts.sign_in("anna", PASSWORD)
    _, text = accounts.create_token("anna", TokenRequest("ci", [Scope.CHANGE]))
    accounts.set_role("anna", Role.READER)
    caller = accounts.by_session(session.secret)
    assert caller is not None
    assert caller.may == MAY[Role.READER]
    assert accounts.by_token(text).may == {Action.VIEW, Action.SUBMIT}


def test_a_password_that_changes_while_somebody_signs_in_wins(
    accounts: Accounts, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(_hash: str, _password: str) -> bool:
        accounts.set_password("anna", "another long password")
        return True

    monkeypatch.setattr(passwords, "is_password", slow)
    with pytest.raises(Unauthenticated):
        accounts.sign_in("anna", PASSWORD)


@pytest.mark.integration
def test_hashes_are_renewed_when_the_parameters_are(accounts: Accounts, hive: Hive) -> None:
    def memory() -> str:
        return hive.store.read(lambda t: t.accounts.credentials("anna")).password_hash.split("$")[3]

    assert memory() == "m=8,t=1,p=1"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(passwords, "PARAMETERS", get_default_parameters())
        assert accounts.sign_in("anna", PASSWORD)
        assert memory() == "m=65536,t=3,p=4"


def test_only_so_many_passwords_are_hashed_at_once(accounts: Accounts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passwords, "LONGEST_WAIT_S", 0.01)
    for _ in range(passwords.MOST_AT_ONCE):
        passwords._slots.acquire()
    try:
        with pytest.raises(Unavailable, match="too many people"):
            accounts.sign_in("anna", PASSWORD)
    finally:
        passwords._slots.release(passwords.MOST_AT_ONCE)
    assert accounts.sign_in("anna", PASSWORD)


def test_a_token_is_shown_once_and_only_its_digest_is_stored(accounts: Accounts, hive: Hive, clock: Clock) -> None:
    key, text = accounts.create_token("anna", TokenRequest("ci", [Scope.CHANGE, Scope.READ], 30))
    assert text.startswith(TOKEN_BEGINS)
    assert (key.scopes, key.expires_at) == ((Scope.READ, Scope.CHANGE), NOW + timedelta(days=30))
    with hive.store.engine.connect() as connection:
        stored = str(connection.exec_driver_sql("SELECT * FROM account_keys").all())
    assert text not in stored
    assert digest_of(text) in stored
    caller = accounts.by_token(text)
    assert (caller.account, caller.token) == ("anna", "ci")
    clock.now += timedelta(minutes=59)
    accounts.by_token(text)
    assert [token.used_at for token in accounts.tokens()] == [NOW]
    clock.now += timedelta(minutes=2)
    accounts.by_token(text)
    assert [token.used_at for token in accounts.tokens("anna")] == [clock.now]
    clock.now = NOW + timedelta(days=30)
    with pytest.raises(Unauthenticated):
        accounts.by_token(text)


def test_a_session_is_no_token_and_a_token_no_session(accounts: Accounts) -> None:
    session = accounts.sign_in("anna", PASSWORD)
    _, text = accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))
    assert accounts.by_session(text) is None
    with pytest.raises(Unauthenticated):
        accounts.by_token(session.secret)


def test_tokens_are_revoked_by_their_owner_or_an_admin(accounts: Accounts) -> None:
    accounts.add("ben", Role.MEMBER, PASSWORD)
    key, text = accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))
    with pytest.raises(NotFound, match="unknown API token"):
        accounts.revoke(key.id, "ben")
    accounts.revoke(key.id, "anna")
    with pytest.raises(Unauthenticated):
        accounts.by_token(text)
    with pytest.raises(NotFound):
        accounts.revoke(key.id)


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (TokenRequest("", [Scope.READ]), "token name '' is not allowed"),
        (TokenRequest("x", []), "the token has no scope"),
        (TokenRequest("x", [Scope.READ], 0), "0 days are not allowed"),
        (TokenRequest("x", [Scope.READ], LONGEST_TOKEN_DAYS + 1), "days are not allowed"),
    ],
)
def test_tokens_that_are_refused(accounts: Accounts, request_: TokenRequest, said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        accounts.create_token("anna", request_)
    assert not accounts.tokens()


def test_two_tokens_of_one_account_have_two_names(accounts: Accounts) -> None:
    accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))
    with pytest.raises(Conflict, match="anna has a token 'ci' already"):
        accounts.create_token("anna", TokenRequest("ci", [Scope.READ]))


@pytest.mark.integration
def test_no_file_holds_accounts_and_reindexing_keeps_them(accounts: Accounts, hive: Hive, tmp_path: Path) -> None:
    """Neither ledger nor archive nor anything else in the data root but the database."""
    accounts.add("unmistakable", Role.ADMIN, PASSWORD)
    _, text = accounts.create_token("unmistakable", TokenRequest("ci", [Scope.READ]))
    make_runs(hive, 2)
    with hive.store.acting(AuditAct("1", NOW, "unmistakable", "pages", "", "runs.cancel", "")):
        hive.store.note_act()
    before = accounts.list(), accounts.tokens(), accounts.audit(10)
    reindex(hive, lambda _done, _total: None)
    assert (accounts.list(), accounts.tokens(), accounts.audit(10)) == before
    archive = tmp_path / "all.zip"
    export_archive(hive.settings, hive.store, ExportRequest(archive, unpublished=True), lambda _done, _total: None)
    with zipfile.ZipFile(archive) as content:
        members = {name: content.read(name) for name in content.namelist()}
    files = [path for path in hive.settings.data.rglob("*") if path.is_file() and "slamhive.db" not in path.name]
    assert len(members) > 5
    assert len(files) > 5
    secrets = [b"unmistakable", b"$argon2", digest_of(text).encode(), text.encode()]
    for name, content_ in [*members.items(), *((str(path), path.read_bytes()) for path in files)]:
        assert not any(secret in content_ for secret in secrets), name
