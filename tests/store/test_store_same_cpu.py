"""Which machine may take the runs of an experiment that stays on one CPU model."""

from __future__ import annotations

import threading
from datetime import timedelta
from typing import Any

import pytest

from slamhive.domain.run import Host, RunState
from slamhive.store import Lease, MeasuredMachine, Store, open_store
from slamhive.store.durations import NOT_KNOWN, NodeSeen
from tests.store.conftest import NOW
from tests.store.store_samples import Samples

pytestmark = pytest.mark.quick

OLD, NEW = MeasuredMachine("Old CPU"), MeasuredMachine("New CPU")
CLUSTER = MeasuredMachine("Login node", lambda executor: executor == "cluster")


def claim(store: Store, machine: MeasuredMachine | None, owner: str = "worker", later_s: float = 0.0) -> int | None:
    lease = Lease(owner, NOW + timedelta(seconds=later_s), 30.0)
    run = store.write(lambda tx: tx.queue.claim(lease, machine=machine))
    return None if run is None else run.id


def state(store: Store, experiment: int, **values: Any) -> None:
    store.write(lambda tx: tx.experiments.change(experiment, **values))


def pinned(store: Store) -> str | None:
    return store.read(lambda tx: tx.experiments.get("trial").cpu_model)


def start(store: Store, run_id: int, cpu_model: str, node: str | None = None) -> None:
    """The run starts on a machine with this CPU, on this node."""
    data = {} if node is None else {"node": node}

    def work(tx: Any) -> None:
        host_id = tx.catalogue.put_host(Host(cpu_model, 8, 10**9, "6.1", "Debian"))
        for target in (RunState.STARTING, RunState.RUNNING):
            fields = {"host_id": host_id, "handle": {"executor": "cluster", "data": data}}
            tx.runs.move(run_id, target, why="test", now=NOW, **fields)

    store.write(work)


@pytest.fixture
def three(store: Store, samples: Samples, experiment: int) -> list[int]:
    """Three queued runs of an experiment that stays on a CPU model nobody knows yet."""
    state(store, experiment, cpu_model=NOT_KNOWN)
    return samples.queued(3, experiment_id=experiment)


def test_the_first_machine_decides(store: Store, samples: Samples, three: list[int]) -> None:
    assert claim(store, OLD) == three[0]
    assert pinned(store) == "Old CPU"
    (free,) = samples.queued()
    assert claim(store, NEW) == free, "other runs are not held up"
    assert claim(store, NEW) is None
    assert [entry.name for entry in store.read(lambda tx: tx.same_cpu.barred(NEW))] == ["trial"]
    assert store.read(lambda tx: tx.same_cpu.barred(OLD)) == []
    assert [claim(store, OLD) for _ in range(3)] == [three[1], three[2], None]
    assert store.read(lambda tx: tx.same_cpu.barred(NEW)) == [], "nothing of it waits any more"


def test_whoever_asks_for_any_run_gets_it(store: Store, three: list[int]) -> None:
    assert [claim(store, machine) for machine in (OLD, None)] == three[:2]


def test_an_experiment_that_may_have_several(store: Store, samples: Samples, experiment: int) -> None:
    first, second = samples.queued(2, experiment_id=experiment)
    assert [claim(store, machine) for machine in (OLD, NEW)] == [first, second]
    assert pinned(store) is None


def test_what_was_measured_before_decides(store: Store, three: list[int], experiment: int) -> None:
    """As after a reindex, or for runs that came in an archive."""
    start(store, claim(store, OLD) or 0, "Old CPU")
    state(store, experiment, cpu_model=NOT_KNOWN)
    assert claim(store, NEW) is None
    assert pinned(store) == "Old CPU"
    assert claim(store, OLD) == three[1]


def test_an_orphan_that_has_not_started_waits_for_its_cpu(store: Store, three: list[int]) -> None:
    assert claim(store, OLD) == three[0]
    assert claim(store, NEW, "other", 60.0) is None
    assert claim(store, OLD, "other", 60.0) == three[0]


def test_an_orphan_that_has_started_is_adopted_by_anybody(store: Store, three: list[int]) -> None:
    assert claim(store, OLD) == three[0]
    start(store, three[0], "Old CPU")
    assert claim(store, NEW, "other", 60.0) == three[0]


def test_where_an_engine_chooses_the_first_run_goes_alone(store: Store, samples: Samples, experiment: int) -> None:
    state(store, experiment, cpu_model=NOT_KNOWN, executor="cluster")
    first, second, third = samples.queued(3, experiment_id=experiment, executor="cluster")
    (free,) = samples.queued(executor="cluster")
    assert [claim(store, CLUSTER) for _ in range(3)] == [first, free, None]
    assert store.read(lambda tx: tx.same_cpu.known(experiment)) is None
    start(store, first, "Node CPU", "n1")
    assert [claim(store, CLUSTER) for _ in range(3)] == [second, third, None]
    assert pinned(store) == store.read(lambda tx: tx.same_cpu.known(experiment)) == "Node CPU"


def test_a_first_run_that_never_started_lets_the_next_go(store: Store, samples: Samples, experiment: int) -> None:
    state(store, experiment, cpu_model=NOT_KNOWN, executor="cluster")
    first, second = samples.queued(2, experiment_id=experiment, executor="cluster")
    assert claim(store, CLUSTER) == first
    store.write(lambda tx: tx.runs.request_cancel(first, NOW))
    store.write(lambda tx: tx.runs.move(first, RunState.CANCELLING, why="test", now=NOW))
    store.write(lambda tx: tx.runs.move(first, RunState.CANCELLED, why="test", now=NOW))
    assert claim(store, CLUSTER) == second


def test_of_machines_that_ask_at_once_one_decides(
    database_url: str, store: Store, samples: Samples, experiment: int
) -> None:
    state(store, experiment, cpu_model=NOT_KNOWN)
    ids = samples.queued(8, experiment_id=experiment)
    taken: dict[str, list[int]] = {"Old CPU": [], "New CPU": []}
    together = threading.Barrier(2)

    def work(machine: MeasuredMachine) -> None:
        own = open_store(database_url)
        together.wait()
        while (run_id := claim(own, machine, machine.cpu_model)) is not None:
            taken[machine.cpu_model].append(run_id)
        own.close()

    threads = [threading.Thread(target=work, args=(machine,)) for machine in (OLD, NEW)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(map(len, taken.values())) == [0, 8]
    assert sorted([*taken["Old CPU"], *taken["New CPU"]]) == ids
    assert pinned(store) == next(model for model, runs in taken.items() if runs)


def test_what_runs_tell_about_nodes(store: Store, samples: Samples) -> None:
    first, second, third = samples.queued(3, executor="cluster", affinity="a-b")
    for run_id, node in ((first, "n1"), (second, "n2"), (third, None)):
        assert claim(store, None) == run_id
        start(store, run_id, f"CPU of {node}", node)
    seen = store.read(lambda tx: tx.placing.seen("cluster"))
    assert seen == [NodeSeen("n2", "CPU of n2", "a-b"), NodeSeen("n1", "CPU of n1", "a-b")]
    assert store.read(lambda tx: tx.placing.seen("another")) == []
    assert store.read(lambda tx: tx.placing.recording_s("room")) == 15.0
    assert store.read(lambda tx: tx.placing.measured_s(1)) is None


def test_how_many_runs_ended_on_each_node(store: Store, samples: Samples) -> None:
    ids = samples.queued(4, executor="cluster")
    for run_id, node in zip(ids, ("n1", "n2", "n1", None), strict=True):
        assert claim(store, None) == run_id
        start(store, run_id, "X", node)
    for run_id in ids[:1] + ids[2:]:
        for target in (RunState.COLLECTING, RunState.SUCCEEDED):
            store.write(lambda tx, i=run_id, to=target: tx.runs.move(i, to, why="test", now=NOW))  # type: ignore[misc]
    ended = store.read(lambda tx: tx.placing.ended_on(NOW - timedelta(hours=1)))
    assert ended == {("cluster", "n1"): 2, ("cluster", None): 1}
    assert store.read(lambda tx: tx.placing.ended_on(NOW + timedelta(hours=1))) == {}
