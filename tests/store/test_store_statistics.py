"""The numbers that a database plans by follow what is written, without anybody asking for it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text

from slamhive.store import Store, open_store
from slamhive.store import store as store_module
from tests.services.mariadb import DatabaseServer
from tests.store.conftest import NOW
from tests.store.store_samples import Samples

pytestmark = pytest.mark.quick

RECALCULATED_S = 60.0
"""InnoDB looks at a changed table again ten seconds after the last time at the earliest."""


@pytest.fixture
def sqlite_url(sqlite_template: Path, tmp_path: Path) -> str:
    """An empty database that no test has looked at the tables of."""
    return f"sqlite:///{shutil.copy(sqlite_template, tmp_path / 'runs.db')}"


def known_to_sqlite(store: Store) -> int:
    """How many runs SQLite plans for; 0: it has never looked."""
    with store.engine.connect() as connection:
        if not connection.execute(text("SELECT count(*) FROM sqlite_master WHERE name = 'sqlite_stat1'")).scalar_one():
            return 0
        rows = connection.execute(text("SELECT stat FROM sqlite_stat1 WHERE tbl = 'runs'")).scalars()
        return max(int(stat.split()[0]) for stat in rows)


def test_sqlite_looks_again_when_a_writer_leaves_and_runs_have_grown_by_a_quarter(sqlite_url: str):
    store = open_store(sqlite_url)
    samples = Samples(store, NOW)
    found = []
    for more in (100, 20, 10):
        samples.queued(more)
        store.close()
        found.append(known_to_sqlite(store))
    store.close()
    assert found == [100, 100, 130]


def test_who_only_reads_leaves_it_to_the_writer(sqlite_url: str):
    writer, reader = open_store(sqlite_url), open_store(sqlite_url)
    Samples(writer, NOW).queued(50)
    assert reader.read(lambda tx: tx.searches.total()) == 50
    reader.close()
    assert known_to_sqlite(writer) == 0
    writer.close()
    assert known_to_sqlite(reader) == 50
    reader.close()


def test_sqlite_looks_again_between_writes(sqlite_url: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(store_module, "WRITES_BETWEEN_LOOKS", 5)
    store = open_store(sqlite_url)
    samples = Samples(store, NOW)
    configuration_id = samples.configuration()
    seen = []
    for _ in range(9):
        samples.queued(10, configuration_id=configuration_id)
        seen.append(known_to_sqlite(store))
    store.close()
    assert seen == [0, 0, 0, 40, 40, 40, 40, 40, 90]


@pytest.fixture
def mysql_store(database_server: DatabaseServer) -> Iterator[Store]:
    """A store of its own: others' rows would count."""
    store = open_store(database_server.create_database("slamhive_statistics"))
    yield store
    store.close()
    database_server.drop_database("slamhive_statistics")


def known_to_mysql(store: Store) -> int:
    """How many runs the server plans for."""
    with store.engine.connect() as connection:
        query = (
            "SELECT table_rows FROM information_schema.tables WHERE table_schema = DATABASE() AND table_name = 'runs'"
        )
        return int(connection.execute(text(query), {"name": "runs"}).scalar_one())


@pytest.mark.mysql
def test_mysql_looks_at_once_when_told(mysql_store: Store):
    Samples(mysql_store, NOW).queued(400)
    mysql_store.refresh_statistics()
    assert 350 <= known_to_mysql(mysql_store) <= 450


@pytest.mark.mysql
def test_mysql_looks_by_itself(mysql_store: Store):
    Samples(mysql_store, NOW).queued(400)
    deadline = time.monotonic() + RECALCULATED_S
    while not 350 <= known_to_mysql(mysql_store) <= 450:
        assert time.monotonic() < deadline, known_to_mysql(mysql_store)
        time.sleep(0.1)
