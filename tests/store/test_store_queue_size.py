"""Claiming from a long queue takes as many steps through the index as from a short one (see benchmarks/queue.py)."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from statistics import median
from typing import Any

import pytest
from sqlalchemy import insert, text

from slamhive.domain.affinity import run_affinity
from slamhive.domain.run import RunState
from slamhive.domain.variant import VariantStep
from slamhive.store import Store, Transaction
from slamhive.store.models import Run
from tests.store.store_samples import WORKER, Samples

pytestmark = pytest.mark.integration

NOW = datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)
DATA = [run_affinity("room", (VariantStep("rate", ("cam0",), {"hz": hz}),), "orb-slam3") for hz in range(1, 101)]
FEW, MANY = 200, 10_000


def fill(store: Store, configuration_id: int, first: int, count: int, *, held: bool) -> None:
    """Queue runs in the order of a sweep: repeats of a variant lie far apart."""

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
        rows = [row(number) for number in range(begin, min(begin + 10_000, first + count))]
        add(store, rows)


def add(store: Store, rows: list[dict[str, Any]]) -> None:
    store.write(lambda tx: tx.session.execute(insert(Run.__table__), rows))


def claim_s(store: Store, near: str) -> float:
    """The median time of a claim near ``near``."""
    times_s = []
    for _ in range(25):
        began_s = time.perf_counter()
        run = store.write(lambda tx: tx.queue.claim(WORKER, NOW, 30.0, near=near))
        times_s.append(time.perf_counter() - began_s)
        assert run is not None
        assert not run.held
    return median(times_s)


def analyse(tx: Transaction) -> None:
    """What a server does by itself after a while."""
    tx.session.execute(text("ANALYZE TABLE runs" if tx.session.get_bind().dialect.name == "mysql" else "ANALYZE"))


@pytest.mark.parametrize("analysed", [False, True])
def test_a_long_queue_and_many_runs_on_hold_cost_a_claim_nothing(
    store: Store, samples: Samples, analysed: bool
) -> None:
    configuration_id = samples.configuration()
    fill(store, configuration_id, 1, FEW, held=False)
    few_s = {near: claim_s(store, near) for near in ("", DATA[7], run_affinity("kitti", (), "x"))}
    fill(store, configuration_id, FEW + 1, MANY, held=False)
    fill(store, configuration_id, FEW + MANY + 1, MANY, held=True)
    if analysed:
        store.write(analyse)
    for near, before_s in few_s.items():
        after_s = claim_s(store, near)
        # A walk through the queue would be fifty times as long.
        assert after_s < 5 * before_s, f"near {near!r}: {before_s * 1e3:.2f} ms, then {after_s * 1e3:.2f} ms"
