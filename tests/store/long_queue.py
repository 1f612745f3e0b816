"""A long queue, and how long a claim from it takes."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from statistics import median
from typing import Any

from sqlalchemy import insert, text

from slamhive.domain.configuration import VariantStep
from slamhive.domain.placement import run_affinity
from slamhive.domain.run import RunState
from slamhive.store import Lease, Store, Transaction
from slamhive.store.models import RunRow

NOW = datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)
DATA = [run_affinity("room", (VariantStep("rate", ("cam0",), {"hz": hz}),), "orb-slam3") for hz in range(1, 101)]
NEARS = {"none": "", "queued": DATA[7], "not queued": run_affinity("kitti", (), "kiss-icp")}
"""What a worker did last."""


def fill(store: Store, configuration_id: int, first: int, count: int, *, held: bool) -> None:
    """Queue runs in the order of a sweep: those on the same data lie far apart."""

    def row(number: int) -> dict[str, Any]:
        return {
            "uid": f"{number:032x}",
            "configuration_id": configuration_id,
            "executor": "process",
            "state": RunState.QUEUED,
            "seed": 0,
            "priority": number % 3,
            "evaluate": False,
            "created_at": NOW,
            "attempt": 0,
            "cancel_requested": False,
            "held": held,
            "affinity": DATA[number % len(DATA)],
        }

    for begin in range(first, first + count, 10_000):
        _add(store, [row(number) for number in range(begin, min(begin + 10_000, first + count))])


def claim_s(store: Store, near: str, times: int = 25) -> float:
    """The median time of a claim near ``near``."""
    times_s = []
    for _ in range(times):
        began_s = time.perf_counter()
        run = store.write(lambda tx: tx.queue.claim(Lease("worker-1", NOW, 30.0), near=near))
        times_s.append(time.perf_counter() - began_s)
        assert run is not None
        assert not run.held
    return median(times_s)


def claim_steps(store: Store, near: str) -> int:
    """What a claim costs the database whatever else goes on: instructions on SQLite, rows read on a server."""

    def work(tx: Transaction) -> int:
        if tx.database.dialect.name == "mysql":
            before = _rows_read(tx)
            assert tx.queue.claim(Lease("worker-1", NOW, 30.0), near=near) is not None
            return _rows_read(tx) - before
        steps: list[None] = []
        connection: Any = tx.database.connection.driver_connection
        connection.set_progress_handler(lambda: steps.append(None), 1)
        try:
            assert tx.queue.claim(Lease("worker-1", NOW, 30.0), near=near) is not None
        finally:
            connection.set_progress_handler(None, 1)
        return len(steps)

    return store.write(work)


def _rows_read(tx: Transaction) -> int:
    rows = tx.database.execute(text("SHOW SESSION STATUS LIKE 'Handler_read%'"))
    return sum(int(row[1]) for row in rows)


def analyse(store: Store) -> None:
    """Count values for the planner, as a server does by itself after a while."""

    def work(tx: Transaction) -> None:
        tx.database.execute(text("ANALYZE TABLE runs" if tx.database.dialect.name == "mysql" else "ANALYZE"))

    store.write(work)


def _add(store: Store, rows: list[dict[str, Any]]) -> None:
    store.write(lambda tx: tx.database.execute(insert(RunRow.__table__), rows))
