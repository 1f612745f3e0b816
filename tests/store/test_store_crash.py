"""Killed writers, and a server that goes away: nothing that was committed is lost, nothing happens twice."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.run import RunState
from slamhive.store import Store, open_store
from slamhive.store.engine import make_engine
from tests.services.mariadb import DatabaseServer, running_server
from tests.store.store_samples import Samples

pytestmark = pytest.mark.integration

NOW = datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)
WRITER = """
import sys
from datetime import UTC, datetime
from slamhive.store import open_store
from tests.store.store_samples import Samples
store = open_store(sys.argv[1])
samples = Samples(store, datetime(2026, 5, 4, tzinfo=UTC))
configuration_id = samples.configuration()
while True:
    ids = samples.queued(5, configuration_id=configuration_id)
    print(*ids, flush=True)
"""


def committed_before_the_kill(url: str, lines: int) -> list[int]:
    """Ids that a writer said were committed before it was killed in the middle of the next ones."""
    root = Path(__file__).resolve().parents[2]
    process = subprocess.Popen([sys.executable, "-c", WRITER, url], stdout=subprocess.PIPE, text=True, cwd=root)
    assert process.stdout is not None
    said = [process.stdout.readline() for _ in range(lines)]
    process.send_signal(signal.SIGKILL)
    said += process.stdout.readlines()
    process.stdout.close()
    process.wait()
    return [int(word) for line in said if line.endswith("\n") for word in line.split()]


@pytest.mark.integration
@pytest.mark.parametrize("lines", [1, 7, 20])
def test_a_killed_writer_loses_nothing_committed(database_url: str, lines: int) -> None:
    promised = committed_before_the_kill(database_url, lines)
    store = open_store(database_url)
    assert len(promised) >= 5 * lines
    found = store.read(lambda tx: tx.runs.get_many(promised))
    assert {run.state for run in found} == {RunState.QUEUED}
    total = store.read(lambda tx: tx.runs.page(limit=1)).total
    assert total % 5 == 0, "half a batch was stored"
    for run in found:
        assert len(store.read(lambda tx, run_id=run.id: tx.runs.events(run_id))) == 1  # type: ignore[misc]
    store.close()


@pytest.fixture
def own_server() -> Iterator[DatabaseServer]:
    """A server that the test may kill."""
    with running_server() as server:
        yield server


@pytest.mark.mysql
def test_a_server_that_is_killed_and_comes_back(own_server: DatabaseServer) -> None:
    store = open_store(own_server.create_database("slamhive"), retry_s=30.0)
    samples = Samples(store, NOW)
    first = samples.queued(3)
    own_server.kill()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(samples.queued, 2, configuration_id=1)
        time.sleep(0.5)
        assert not waiting.done()
        own_server.start()
        second = waiting.result(30)
    assert [run.id for run in store.read(lambda tx: tx.runs.get_many(first + second))] == first + second
    assert store.read(lambda tx: tx.runs.page()).total == 5
    store.close()


@pytest.mark.mysql
def test_a_server_that_stays_away_is_one_line(own_server: DatabaseServer) -> None:
    url = own_server.create_database("slamhive")
    store = open_store(url, retry_s=0.5)
    own_server.kill()
    with pytest.raises(Unavailable, match=r"has not answered for \d s: .*; nothing that was stored is lost") as caught:
        store.read(lambda tx: tx.runs.page())
    assert own_server.password not in str(caught.value)
    store.close()


@pytest.mark.mysql
def test_wrong_password_and_unknown_database_are_one_line(database_server: DatabaseServer) -> None:
    good = make_engine(database_server.url("slamhive_none")).url
    wrong = good.set(password="hunter2!").render_as_string(hide_password=False)
    with pytest.raises(InvalidInput, match="refuses the user or the password; check DATABASE_URL") as caught:
        open_store(wrong)
    assert "hunter2!" not in str(caught.value)
    with pytest.raises(InvalidInput, match="does not exist; create it"):
        open_store(database_server.url("slamhive_none"))
    with pytest.raises(InvalidInput, match="refuses the user"):
        open_store(database_server.url("elsewhere"))


@pytest.mark.mysql
@pytest.mark.parametrize("store", ["mysql"], indirect=True)
def test_the_loser_of_a_deadlock_tries_again(store: Store, database_url: str) -> None:
    store.write(lambda tx: [tx.catalogue.put_algorithm_named(name, "p", "m") for name in ("first", "second")])
    meeting = threading.Barrier(2, timeout=10)
    attempts: list[str] = []

    def cross(own: Store, names: tuple[str, str]) -> None:
        def work(tx) -> None:
            attempts.append(names[0])
            tx.catalogue.put_algorithm_named(names[0], "changed by " + names[0], "m")
            if len(attempts) <= 2:
                meeting.wait()
            tx.catalogue.put_algorithm_named(names[1], "changed by " + names[0], "m")

        own.write(work)
        own.close()

    threads = [
        threading.Thread(target=cross, args=(open_store(database_url), names))
        for names in (("first", "second"), ("second", "first"))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    packages = {record.package for record in store.read(lambda tx: tx.catalogue.algorithms()) if record.package != "p"}
    assert len(attempts) == 3
    assert len(packages) == 1
