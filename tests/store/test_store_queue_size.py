"""Claiming from a long queue takes as many steps through the index as from a short one: benchmarks/taking_runs.py."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.store import Store, open_store
from tests.store.conftest import BOTH
from tests.store.long_queue import NEARS, NOW, analyse, claim_steps, fill
from tests.store.store_samples import Samples

pytestmark = pytest.mark.integration

FEW, MANY = 200, 5000


@pytest.fixture(params=BOTH)
def own_store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """A store that no other test has to empty: every run is looked for in all others when it is deleted."""
    if request.param == "mysql":
        server = request.getfixturevalue("database_server")
        store = open_store(server.create_database("slamhive_long_queue"))
        yield store
        store.close()
        server.drop_database("slamhive_long_queue")
        return
    store = open_store(f"sqlite:///{shutil.copy(request.getfixturevalue('sqlite_template'), tmp_path / 'queue.db')}")
    yield store
    store.close()


@pytest.mark.parametrize("analysed", [False, True])
def test_a_long_queue_and_many_runs_on_hold_cost_a_claim_nothing(own_store: Store, analysed: bool) -> None:
    store = own_store
    configuration_id = Samples(store, NOW).configuration()
    fill(store, configuration_id, 1, FEW, held=False)
    before = {what: claim_steps(store, near) for what, near in NEARS.items()}
    fill(store, configuration_id, FEW + 1, MANY, held=False)
    fill(store, configuration_id, FEW + MANY + 1, MANY, held=True)
    if analysed:
        analyse(store)
    after = {what: claim_steps(store, near) for what, near in NEARS.items()}
    # A walk through the queue would be twenty times as long or more.
    assert all(after[what] < 2 * before[what] for what in NEARS), f"{before}, then {after}"
