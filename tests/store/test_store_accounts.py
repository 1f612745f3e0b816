"""Accounts, their keys and the audit log, on both kinds of database."""

from __future__ import annotations

from datetime import timedelta

import pytest

from slamhive.base.errors import Conflict, NotFound
from slamhive.domain.accounts import Role, Scope
from slamhive.domain.run import RunState
from slamhive.filters.binding import read_search
from slamhive.filters.fields import Vocabulary
from slamhive.store import AuditAct, Key, KeyKind, NewKey, Store
from slamhive.store.accounts import MOST_SESSIONS, SUBJECT_LENGTH, in_ranges
from tests.store.conftest import NOW
from tests.store.store_samples import Samples

pytestmark = pytest.mark.quick

LATER = NOW + timedelta(days=1)


@pytest.fixture
def anna(store: Store) -> int:
    return store.write(lambda t: t.accounts.add("anna", Role.MEMBER, "hash", NOW)).id


def new_key(digest: str, kind: KeyKind = KeyKind.SESSION, name: str = "") -> NewKey:
    return NewKey(kind, digest, NOW, LATER, name, (Scope.READ,) if kind is KeyKind.TOKEN else ())


def found(store: Store, digest: str, kind: KeyKind = KeyKind.SESSION) -> Key | None:
    return store.read(lambda t: t.accounts.key(kind, digest, NOW))


def act(uid: str = "1", subject: str = "") -> AuditAct:
    return AuditAct(uid, NOW, "anna", "pages", "192.0.2.1", "runs.cancel", subject)


def subjects(store: Store) -> list[str]:
    return [line.subject for line in store.read(lambda t: t.audit.lines(100))]


def test_a_name_is_taken_once_and_adding_again_after_a_lost_answer_does_no_harm(store: Store, anna: int) -> None:
    assert store.write(lambda t: t.accounts.add("anna", Role.MEMBER, "hash", NOW)).id == anna
    with pytest.raises(Conflict, match="there is an account 'anna' already"):
        store.write(lambda t: t.accounts.add("anna", Role.ADMIN, "other", NOW))
    with pytest.raises(NotFound, match="did you mean 'anna'"):
        store.read(lambda t: t.accounts.named("ana"))
    assert store.read(lambda t: t.accounts.find("Anna")) is None


def test_role_password_and_state_are_replaced(store: Store, anna: int) -> None:
    store.write(lambda t: t.accounts.set_role("anna", Role.READER))
    store.write(lambda t: t.accounts.set_password("anna", "new"))
    store.write(lambda t: t.accounts.set_disabled("anna", LATER))
    credentials = store.read(lambda t: t.accounts.credentials("anna"))
    assert store.write(lambda t: t.accounts.find("anna", locked=True)) == credentials
    assert credentials.password_hash == "new"
    assert (credentials.account.role, credentials.account.disabled_at) == (Role.READER, LATER)
    assert not store.read(lambda t: t.accounts.exist())
    store.write(lambda t: t.accounts.set_disabled("anna", None))
    assert store.read(lambda t: t.accounts.exist())


def test_a_key_is_found_by_kind_and_digest_until_it_expires(store: Store, anna: int) -> None:
    store.write(lambda t: t.accounts.add_key(anna, new_key("s")))
    store.write(lambda t: t.accounts.add_key(anna, new_key("t", KeyKind.TOKEN, "ci")))
    token = found(store, "t", KeyKind.TOKEN)
    assert token is not None
    assert (token.owner, token.name, token.scopes, token.used_at) == ("anna", "ci", (Scope.READ,), None)
    assert found(store, "s") is not None
    assert found(store, "s", KeyKind.TOKEN) is None
    assert found(store, "t") is None
    assert store.read(lambda t: t.accounts.key(KeyKind.SESSION, "s", LATER)) is None
    store.write(lambda t: t.accounts.set_disabled("anna", NOW))
    assert found(store, "t", KeyKind.TOKEN) is None


def test_sessions_end_and_tokens_stay(store: Store, anna: int) -> None:
    for digest in ("a", "b"):
        store.write(lambda t: t.accounts.add_key(anna, new_key(digest)))  # noqa: B023
    store.write(lambda t: t.accounts.add_key(anna, new_key("t", KeyKind.TOKEN, "ci")))
    store.write(lambda t: t.accounts.end_session("a"))
    assert (found(store, "a") is None, found(store, "b") is None) == (True, False)
    store.write(lambda t: t.accounts.end_session("t"))
    store.write(lambda t: t.accounts.forget_expired_sessions(NOW))
    assert found(store, "b") is not None
    store.write(lambda t: t.accounts.end_sessions(anna))
    assert found(store, "b") is None
    (token,) = store.read(lambda t: t.accounts.tokens())
    assert store.read(lambda t: t.accounts.token(token.id, "anna")) == token
    with pytest.raises(NotFound, match="unknown API token"):
        store.read(lambda t: t.accounts.token(token.id, "ben"))
    store.write(lambda t: t.accounts.touch(token.id, LATER))
    assert store.read(lambda t: t.accounts.token(token.id)).used_at == LATER
    store.write(lambda t: t.accounts.revoke(token.id))
    assert store.read(lambda t: t.accounts.tokens("anna")) == []


def test_an_account_has_only_so_many_sessions(store: Store, anna: int) -> None:
    for number in range(MOST_SESSIONS + 1):
        store.write(lambda t: t.accounts.add_key(anna, new_key(f"s{number}")))  # noqa: B023
    assert [found(store, name) is None for name in ("s0", "s1", f"s{MOST_SESSIONS}")] == [True, False, False]


def test_the_line_of_an_act_is_stored_with_the_first_change_and_once(store: Store, samples: Samples) -> None:
    run = samples.run_in(RunState.QUEUED)
    with store.acting(act(subject="first")):
        store.read(lambda t: t.runs.get(run))
        assert subjects(store) == []
        store.write(lambda t: t.accounts.add("anna", Role.MEMBER, "hash", NOW))
        store.write(lambda t: t.accounts.add("ben", Role.MEMBER, "hash", NOW))
        store.note_act()
    store.write(lambda t: t.accounts.set_role("ben", Role.READER))
    store.note_act()
    assert subjects(store) == ["first"]


def test_a_change_that_fails_leaves_no_line(store: Store, anna: int) -> None:
    def fails(t: object) -> None:
        raise Conflict("no")

    with store.acting(act()):
        with pytest.raises(Conflict):
            store.write(fails)
        assert subjects(store) == []
        store.note_act()
    assert subjects(store) == [""]


def test_a_line_says_which_runs_and_experiments_were_stored(store: Store, samples: Samples, experiment: int) -> None:
    configuration = samples.configuration()
    with store.acting(act("1", "room")):
        runs = samples.queued(2, configuration_id=configuration)
    with store.acting(act("2")):
        store.write(lambda t: t.experiments.get_or_create("e" * 32, "trial"))
    with store.acting(act("3", "x" * 900)):
        store.note_act()
    long, started, queued = subjects(store)
    assert queued == f"room; queued runs {runs[0]} to {runs[1]}"
    assert started == "experiment trial"
    assert len(long) == SUBJECT_LENGTH


def test_lines_are_listed_by_account_and_in_pages(store: Store) -> None:
    for number, name in enumerate(("anna", "ben", "anna")):
        line = AuditAct(str(number), NOW, name, "pages", "", "runs.cancel", str(number))
        store.write(lambda t: t.audit.add(line))  # noqa: B023
        store.write(lambda t: t.audit.add(line))  # noqa: B023 - tried again after a lost answer
    newest, second, oldest = store.read(lambda t: t.audit.lines(10))
    assert [newest.subject, second.subject, oldest.subject] == ["2", "1", "0"]
    assert store.read(lambda t: t.audit.lines(1, newest.id)) == [second]
    assert store.read(lambda t: t.audit.lines(10, None, "anna")) == [newest, oldest]


def test_runs_belong_to_whoever_asked_and_their_repetitions_too(store: Store, samples: Samples) -> None:
    configuration = samples.configuration()
    with store.acting(act()):
        store.note_act()
        (first,) = samples.queued(configuration_id=configuration)
    (nobodys,) = samples.queued(configuration_id=configuration)
    (repeated,) = samples.queued(configuration_id=configuration, retry_of=first)
    with store.acting(AuditAct("2", NOW, "ben", "pages", "", "runs.retry", "")):
        (retried,) = samples.queued(configuration_id=configuration, retry_of=first)
    runs = [first, nobodys, repeated, retried]
    found = store.read(lambda t: t.runs.get_many(runs))
    assert [run.owner for run in found] == ["anna", None, "anna", "ben"]
    for where, ids in (
        ("owner = anna", [first, repeated]),
        ("owner != anna", [retried]),
        ("missing owner", [nobodys]),
        ("owner ~ b*", [retried]),
    ):
        search = read_search(where, Vocabulary())
        assert store.read(lambda t: t.searches.run_ids(search)) == sorted(ids), where  # noqa: B023


@pytest.mark.parametrize(
    ("numbers", "words"), [([7], "run 7"), ([3, 5, 6, 7], "runs 3, 5 to 7"), ([2, 1], "runs 1 to 2")]
)
def test_numbers_in_words(numbers: list[int], words: str) -> None:
    assert in_ranges(numbers) == words
