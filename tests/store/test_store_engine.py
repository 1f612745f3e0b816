"""URLs that cannot be used, and a database that is locked, away, full, damaged or not ours."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import event, text
from sqlalchemy.exc import DBAPIError, IntegrityError, OperationalError

from slamhive.base.clock import Clock
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.store import Store, Transaction, open_store
from slamhive.store.engine import database_label, make_engine
from tests import durability
from tests.store.conftest import NOW
from tests.store.store_samples import Samples
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.quick

SECRET = "hunter2!"


class ManualClock:
    """Time that passes only while somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.pauses: list[float] = []
        self.while_asleep: Callable[[], None] = lambda: None

    def as_clock(self) -> Clock:
        return Clock(monotonic_s=lambda: self.now_s, sleep=self.sleep)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.pauses.append(seconds)
        self.while_asleep()


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def sqlite_path(sqlite_template: Path, tmp_path: Path) -> Path:
    path = tmp_path / "slamhive.db"
    path.write_bytes(sqlite_template.read_bytes())
    return path


def impatient(path: Path, clock: ManualClock, retry_s: float = 60.0) -> Store:
    """A store whose SQLite waits for no lock itself."""
    store = Store(make_engine(f"sqlite:///{path}?timeout=0"), retry_s, clock.as_clock())
    store.write(lambda tx: tx.database.execute(text("DELETE FROM metrics")))
    return store


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("", "not a database URL"),
        ("slamhive.db", "not a database URL"),
        (f"mysql+pymysql//u:{SECRET}@host/db", "not a database URL"),
        (f"mysql+pymysql://u:{SECRET}@host:port/db", "not a database URL"),
        (f"postgresql://u:{SECRET}@host/db", "'postgresql' is not supported"),
        (f"mysql+mysqldb://u:{SECRET}@host/db", r"'mysql\+mysqldb' is not supported"),
        (f"oracel://u:{SECRET}@host/db", "'oracel' is not supported"),
        (f"mysql+pymysql://u:{SECRET}@host", "names no database"),
        ("sqlite://", "in-memory"),
        ("sqlite:///:memory:", "in-memory"),
        ("sqlite:///file:x?mode=memory&uri=true", "in-memory"),
        ("sqlite:////", "names the folder /; name a file in it"),
        ("sqlite:////nonexistent/dir/x.db", "folder /nonexistent/dir does not exist; make it"),
        (f"sqlite:////{'a' * 5000}", "cannot be used: File name too long; name another"),
        ("sqlite:////tmp/%00.db", r"'/tmp/\\x00.db' is not the name of a database"),
        (f"sqlite://user:{SECRET}@host/x.db", "names a user or a server, but SQLite has a file"),
        ("sqlite:////tmp/x.db?foo=1", "unknown option 'foo'; leave it out; the options are timeout, cached"),
        ("sqlite:////tmp/x.db?isolation_level=EXCLUSIVE", "unknown option 'isolation_level'"),
        ("sqlite:////tmp/x.db?timeout=abc", "option timeout=abc cannot be used: could not convert string to float"),
        ("sqlite:////tmp/x.db?timeout=5&timeout=6", "has the option 'timeout' 2 times; leave out all but one"),
        ("sqlite:////tmp/x.db?cached_statements=99999999999999", "too large"),
        ("sqlite:////tmp/x.db?check_same_thread=maybe", "option check_same_thread=maybe cannot be used"),
        (f"mysql+pymysql://u:{SECRET}@host/db?foo=1", "unknown option 'foo'; leave it out; the options are ssl_ca"),
        (f"mysql+pymysql://u@host/db?password={SECRET}", "unknown option 'password'"),
        (f"mysql+pymysql://u:{SECRET}@host/db?cursorclass=x", "unknown option 'cursorclass'"),
        (f"mysql+pymysql://u:{SECRET}@host/db?ssl_ca=/nowhere", "ssl_ca=/nowhere cannot be used: No such file"),
        (f"mysql+pymysql://u:{SECRET}@host/db?ssl_ca=/etc/passwd", "ssl_ca=/etc/passwd cannot be used: .*no cert"),
        (f"mysql+pymysql://u:{SECRET}@host/db?ssl_cert=/nowhere", "ssl_cert=/nowhere cannot be used: No such file"),
        (f"mysql+pymysql://u:{SECRET}@host/db?ssl_cipher=x", "ssl_cipher=x cannot be used"),
        (f"mysql+pymysql://u:{SECRET}@host/db?ssl_check_hostname=x", "ssl_check_hostname=x cannot be used"),
        (f"mysql+pymysql://u:{SECRET}@host/db?connect_timeout=x", "connect_timeout=x cannot be used: invalid lit"),
        (f"mysql+pymysql://u:{SECRET}@host/db?read_timeout=0", "read_timeout=0 cannot be used: .* > 0"),
        (f"mysql+pymysql://u:{SECRET}@host/db?read_default_file=/etc/passwd", "/etc/passwd cannot be used: File cont"),
        (f"mysql+pymysql://u:{SECRET}@host:99999/db", "99999 is not a port; use one from 1 to 65535"),
        (f"mysql+pymysql://u:{SECRET}@a..b/db", "'a..b' is not the name of a machine"),
        (f"mysql+pymysql://u:{SECRET}@{'a' * 70}/db", "is not the name of a machine"),
        (f"mysql+pymysql://u:{SECRET}漢@host/db", "password has letters that are not in Latin-1"),
    ],
)
def test_urls_that_cannot_be_used(url: str, message: str) -> None:
    with pytest.raises(InvalidInput, match=message) as caught:
        open_store(url)
    assert SECRET not in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize(
    "url",
    [
        "sqlite:////tmp/x.db?timeout=2.5&cached_statements=10&check_same_thread=false",
        "mysql+pymysql://u@host/db?charset=latin1&connect_timeout=3&read_timeout=9&write_timeout=9",
        "mysql+pymysql://u@host/db?ssl_check_hostname=false&unix_socket=/run/mysqld/mysqld.sock",
        "mysql+pymysql://u@[::1]:3307/db?bind_address=::1&program_name=hive&read_default_file=/nowhere",
    ],
)
def test_options_that_drivers_have_are_passed_on(url: str) -> None:
    assert make_engine(url).url.query.items() >= {"charset": "utf8mb4"}.items() or url.startswith("sqlite")


def test_names_of_mysql_mean_the_same() -> None:
    for name in ("mysql", "mariadb", "mysql+pymysql", "mariadb+pymysql"):
        engine = make_engine(f"{name}://u:{SECRET}@lab.example/slamhive")
        assert engine.url.drivername == "mysql+pymysql"
        assert database_label(engine) == "mysql lab.example/slamhive"


def test_the_folder_may_have_any_name(tmp_path: Path) -> None:
    (tmp_path / "data root" / "ü").mkdir(parents=True)
    store = open_store(f"sqlite:///{tmp_path}/data root/ü/slamhive.db")
    assert (tmp_path / "data root" / "ü" / "slamhive.db").is_file()
    store.close()


def test_a_wrong_path_makes_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="does not exist; make it, or correct DATABASE_URL"):
        open_store(f"sqlite:///{tmp_path}/mistyped/slamhive.db")
    assert not (tmp_path / "mistyped").exists()


def test_sqlite_is_durable_and_checks_references(sqlite_path: Path) -> None:
    durability.leave_out(False)
    store = open_store(f"sqlite:///{sqlite_path}")
    with store.engine.connect() as connection:
        found = [
            connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys")
        ]
    assert found == ["wal", 2, 1]
    with pytest.raises(IntegrityError):
        store.write(lambda tx: tx.database.execute(text("INSERT INTO metric_values VALUES (1, 1, 1, 0.5, 1)")))
    store.close()


def test_a_reader_does_not_wait_for_a_writer(sqlite_path: Path, clock: ManualClock) -> None:
    store = impatient(sqlite_path, clock)
    writer = sqlite3.connect(sqlite_path, isolation_level=None)
    writer.execute("BEGIN IMMEDIATE")
    assert store.read(lambda tx: tx.runs.page()).total == 0
    assert clock.pauses == []
    writer.close()
    store.close()


def test_a_commit_ends_the_waiting_and_reading_does_not(sqlite_path: Path) -> None:
    ours, other = open_store(f"sqlite:///{sqlite_path}"), open_store(f"sqlite:///{sqlite_path}")
    for store in (ours, other):
        store.read(lambda t: t.searches.total())
    before, never = ours.mark(), threading.Event()
    assert before is not None
    other.read(lambda t: t.searches.total())
    ours.wait_for_commit(before, never, 0.01)
    assert ours.mark() == before
    Samples(other, NOW).configuration()
    assert ours.mark() != before
    began_s = time.monotonic()
    ours.wait_for_commit(before, never, PATIENCE_S)
    assert time.monotonic() - began_s < PATIENCE_S
    ours.close()
    other.close()


def test_a_locked_database_is_tried_again_and_one_line_is_logged(
    sqlite_path: Path, clock: ManualClock, caplog: pytest.LogCaptureFixture
) -> None:
    store = impatient(sqlite_path, clock)
    other = sqlite3.connect(sqlite_path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")

    def let_go_in_time() -> None:
        if clock.now_s > 130 and other.in_transaction:
            other.execute("COMMIT")

    clock.while_asleep = let_go_in_time
    with caplog.at_level(logging.WARNING, "slamhive.store"):
        store.write(lambda tx: tx.metrics.ids(["ate.rmse"]))
    assert 30 <= sum(clock.pauses) < 33
    assert max(clock.pauses) <= 2.0
    assert [record.getMessage() for record in caplog.records] == [
        f"database sqlite {sqlite_path}: database is locked; trying again"
    ]
    other.close()
    store.close()


def test_a_database_locked_for_too_long_is_one_line(sqlite_path: Path, clock: ManualClock) -> None:
    store = impatient(sqlite_path, clock)
    other = sqlite3.connect(sqlite_path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(
        Unavailable, match=r"has not answered for 6\d s: database is locked; nothing .* is lost"
    ) as caught:
        store.write(lambda tx: tx.catalogue.algorithms())
    assert "\n" not in str(caught.value)
    other.close()
    store.close()


def test_a_full_disk_is_one_line_and_loses_nothing(sqlite_path: Path, clock: ManualClock) -> None:
    store = impatient(sqlite_path, clock)
    store.write(lambda tx: tx.catalogue.put_algorithm_named("kept", "kept", "mono"))

    def fill(tx) -> None:
        pages = tx.database.execute(text("PRAGMA page_count")).scalar()
        tx.database.execute(text(f"PRAGMA max_page_count={pages}"))
        for number in range(3000):
            tx.catalogue.put_algorithm_named(f"name-{number}" + "x" * 40, "package", "mono")

    with pytest.raises(Unavailable, match="cannot grow, the disk is full; free space"):
        store.write(fill)
    assert clock.pauses == []
    assert [record.name for record in store.read(lambda tx: tx.catalogue.algorithms())] == ["kept"]
    store.close()


@pytest.mark.parametrize("code", [sqlite3.SQLITE_IOERR_SHMSIZE, sqlite3.SQLITE_CANTOPEN])
def test_an_io_error_on_a_full_disk_is_said_to_be_one_at_once(
    sqlite_path: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    store = impatient(sqlite_path, clock)

    def fail(_tx) -> None:
        original = sqlite3.OperationalError("disk I/O error")
        original.sqlite_errorcode = code
        raise OperationalError("SELECT 1", None, original)

    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=0))
    with pytest.raises(Unavailable, match="cannot grow, the disk is full; free space"):
        store.read(fail)
    assert clock.pauses == []
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=10**9))
    with pytest.raises(Unavailable, match="has not answered for 6"):
        store.read(fail)
    store.close()


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"not a database at all, just text" * 40, "is not an SQLite database"), (None, "is damaged")],
)
def test_files_that_are_no_database(sqlite_path: Path, content: bytes | None, message: str) -> None:
    good = sqlite_path.read_bytes()
    sqlite_path.write_bytes(good[:100] + b"\xff" * (len(good) - 100) if content is None else content)
    with pytest.raises(Unavailable, match=message):
        open_store(f"sqlite:///{sqlite_path}")


def test_a_bug_keeps_its_traceback(sqlite_path: Path, clock: ManualClock) -> None:
    store = impatient(sqlite_path, clock)
    with pytest.raises(OperationalError, match="no such table"):
        store.read(lambda tx: tx.database.execute(text("SELECT * FROM absent")))
    assert clock.pauses == []
    store.close()


def test_errors_of_the_project_pass_through(sqlite_path: Path, clock: ManualClock) -> None:
    store = impatient(sqlite_path, clock)

    def refuse(_tx) -> None:
        raise SlamHiveError("stop")

    with pytest.raises(SlamHiveError, match="stop"):
        store.write(refuse)
    assert clock.pauses == []
    store.close()


@pytest.mark.integration
def test_a_server_that_is_not_there_is_one_line_without_the_password(clock: ManualClock) -> None:
    engine = make_engine(f"mysql+pymysql://u:{SECRET}@127.0.0.1:1/slamhive")
    store = Store(engine, 3.0, clock.as_clock())
    with pytest.raises(
        Unavailable, match=r"database mysql 127\.0\.0\.1:1/slamhive has not answered for \d s"
    ) as caught:
        store.read(lambda tx: tx.runs.page())
    assert SECRET not in str(caught.value)
    assert "see whether the server runs" in str(caught.value)


def test_reads_of_a_snapshot_are_of_one_moment(store: Store, database_url: str, samples: Samples) -> None:
    samples.queued()
    request = replace(samples.request(), uid="f" * 32)
    other = open_store(database_url)

    def total() -> int:
        return store.read(lambda tx: tx.searches.total())

    with store.snapshot():
        assert total() == 1
        other.write(lambda tx: tx.runs.add_runs([request], samples.now))
        with store.snapshot():
            assert total() == 1
        assert total() == 1
        store.write(lambda tx: tx.catalogue.put_algorithm_named("a", "a", "a"))
        assert total() == 2, "a write ends the snapshot"
    assert total() == 2
    other.close()


def test_a_snapshot_is_one_transaction_of_one_thread(store: Store) -> None:
    begun: list[object] = []
    count = begun.append  # one object, to be removed again
    event.listen(store.engine, "begin", count)
    try:
        with store.snapshot():
            assert begun == [], "it begins with the first read"
            for _ in range(3):
                store.read(lambda tx: tx.searches.total())
            assert len(begun) == 1
            with ThreadPoolExecutor(1) as pool:
                pool.submit(store.read, lambda tx: tx.searches.total()).result()
            assert len(begun) == 2
    finally:
        event.remove(store.engine, "begin", count)
    assert store.engine.pool.status().endswith("Checked out connections: 0"), "the connection is given back"


def test_a_snapshot_outlives_a_mistake_and_a_broken_connection(store: Store) -> None:
    def not_there(tx: Transaction) -> None:
        tx.runs.get(99)

    with store.snapshot():
        assert store.read(lambda tx: tx.searches.total()) == 0
        with pytest.raises(NotFound):
            store.read(not_there)
        with pytest.raises(DBAPIError):
            store.read(lambda tx: tx.database.execute(text("SELECT * FROM absent")))
        assert store.read(lambda tx: tx.searches.total()) == 0
