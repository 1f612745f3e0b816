"""Runs of an experiment stay on one CPU model: on workstations that share a queue, and on the nodes of a cluster."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import pytest

from slamhive.domain.placement import run_affinity
from slamhive.domain.run import FailureReason, Host, RunState
from slamhive.executors.base import Capabilities, StartFailed
from slamhive.executors.spec import Limit, Placing, RunSpec
from slamhive.executors.status import Exited, RunHandle
from slamhive.experiments.file import parse_experiment
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from slamhive.services.worker import turns
from slamhive.services.worker import worker as worker_module
from slamhive.services.worker.turns import placing_of
from slamhive.store.durations import NodeSeen
from slamhive.store.records import RunRecord
from tests.services.fake_executor import FakeExecutor, write_trajectory

pytestmark = pytest.mark.integration

ONE = "name: one\nalgorithms: tiny\ndatasets: track\nevaluate: false\nrepeats: 3\nexecutor: process\n"
FAST, SLOW = (Host(name, 8, 10**9, "6.1", "Debian") for name in ("Fast CPU", "Slow CPU"))


def source(text: str = ONE) -> ExperimentSource:
    return ExperimentSource(text, "one.yaml")


def runs_of(hive: Hive) -> tuple[RunRecord, ...]:
    return hive.store.read(lambda t: t.runs.get_many(hive.experiments.run_ids("one")))


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Sets the processor of this machine."""

    def change(host: Host) -> None:
        monkeypatch.setattr(turns, "describe_host", lambda: host)
        monkeypatch.setattr("slamhive.services.worker.driver.describe_host", lambda: host)

    return change


def work(hive: Hive, executor: FakeExecutor, only: list[int] | None = None) -> None:
    hive.executors.opened["process"] = executor
    hive.worker(only).run(until_idle=True)


def finished() -> FakeExecutor:
    return FakeExecutor([Exited(0)], write_trajectory(3))


def test_another_workstation_leaves_the_runs_alone_and_says_so(
    hive: Hive, at: Any, caplog: pytest.LogCaptureFixture
) -> None:
    hive.experiments.start(source())
    at(FAST)
    work(hive, finished(), [runs_of(hive)[0].id])
    at(SLOW)
    with caplog.at_level(logging.WARNING):
        work(hive, finished())
    assert [run.state for run in runs_of(hive)] == [RunState.SUCCEEDED, RunState.QUEUED, RunState.QUEUED]
    said = [line for line in caplog.messages if "stays on" in line]
    assert said == [f"experiment one stays on Fast CPU, this is Slow CPU: {turns.ANY_CPU_HINT}"]
    status = hive.experiments.status("one")
    assert status.phase == "waiting for a worker, runs stay on Fast CPU"
    shown = status.content
    assert (shown["same_cpu"], shown["cpu_model"]) == (True, "Fast CPU")
    at(FAST)
    work(hive, finished())
    assert {run.host.cpu_model for run in runs_of(hive) if run.host} == {"Fast CPU"}


def test_a_setting_lets_a_new_machine_go_on(hive: Hive, at: Any) -> None:
    hive.experiments.start(source())
    at(FAST)
    work(hive, finished(), [runs_of(hive)[0].id])
    at(SLOW)
    hive.settings = hive.settings.with_values({"any_cpu": True})
    work(hive, finished())
    assert {run.host.cpu_model for run in runs_of(hive) if run.host} == {"Fast CPU", "Slow CPU"}


def test_an_experiment_can_allow_several(hive: Hive, at: Any) -> None:
    hive.experiments.start(source(f"{ONE}same_cpu: false\n"))
    at(FAST)
    work(hive, finished(), [runs_of(hive)[0].id])
    at(SLOW)
    work(hive, finished())
    assert {run.state for run in runs_of(hive)} == {RunState.SUCCEEDED}
    assert not hive.experiments.status("one").content["same_cpu"]


def test_a_reindex_knows_where_the_experiment_began(hive: Hive, at: Any) -> None:
    hive.experiments.start(source())
    at(FAST)
    work(hive, finished(), [runs_of(hive)[0].id])
    hive.store.write(lambda t: t.experiments.change(1, cpu_model=""))  # what a new database would hold
    reindex(hive, lambda _done, _total: None)
    at(SLOW)
    work(hive, finished())
    assert [run.state for run in runs_of(hive)] == [RunState.SUCCEEDED, RunState.QUEUED, RunState.QUEUED]


@dataclasses.dataclass
class FakeCluster(FakeExecutor):
    """Starts each run on the first node that the run may be on."""

    capabilities = Capabilities(limits=frozenset(Limit), elsewhere=True)
    nodes_here: tuple[tuple[str, Host], ...] = ()
    attempts: list[tuple[int, str, Placing]] = dataclasses.field(default_factory=list)

    def start(self, spec: RunSpec) -> RunHandle:
        free = [entry for entry in self.nodes_here if entry[0] not in spec.placing.other_nodes]
        if not free:
            raise StartFailed(f"run {spec.run_id}: {spec.placing.nobody}", "same_cpu: false allows others")
        node, host = free[0]
        self.attempts.append((spec.run_id, node, spec.placing))
        self.starts.append(spec)
        self.on_start(spec)
        return RunHandle("process", {"key": spec.key, "node": node}, host=host)


def cluster(*nodes: tuple[str, Host]) -> FakeCluster:
    return FakeCluster([Exited(0)], write_trajectory(3), nodes_here=nodes)


def test_a_run_leaves_a_node_with_another_processor(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "TROUBLE_PAUSE_S", 0.01)
    hive.experiments.start(source())
    one, two, three = (run.id for run in runs_of(hive))
    work(hive, cluster(("a", FAST)), [one])
    later = cluster(("b", SLOW), ("a", FAST))
    work(hive, later)
    assert [(run_id, node) for run_id, node, _ in later.attempts] == [(two, "b"), (two, "a"), (three, "a")]
    assert later.removed == 1 + 2, "the start that did not fit, and two runs that ended"
    placings = [placing for _, _, placing in later.attempts]
    assert [entry.cpu_model for entry in placings] == ["Fast CPU"] * 3
    assert [entry.other_nodes for entry in placings] == [(), ("b",), ("b",)]
    assert placings[0].near_nodes == ("a",)
    assert all((entry.expected_s or 0.0) > 0.0 for entry in placings)
    found = runs_of(hive)
    assert [run.state for run in found] == [RunState.SUCCEEDED] * 3
    assert {run.host.cpu_model for run in found if run.host} == {"Fast CPU"}
    assert {(run.handle or {})["data"]["node"] for run in found} == {"a"}


def test_what_a_run_left_on_the_wrong_node_is_gone(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "TROUBLE_PAUSE_S", 0.01)
    hive.experiments.start(source(ONE.replace("repeats: 3", "repeats: 2")))
    one, two = (run.id for run in runs_of(hive))
    work(hive, cluster(("a", FAST)), [one])
    later = cluster(("b", SLOW), ("a", FAST))
    seen: list[list[Path]] = []

    def on_start(spec: RunSpec) -> None:
        result = hive.runs.folder(spec.run_id).result
        seen.append(list(result.iterdir()))
        (result / "half.txt").write_text("begun")
        write_trajectory(3)(spec)

    later.on_start = on_start
    work(hive, later, [two])
    assert seen == [[], []]


def test_no_node_has_the_processor(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "TROUBLE_PAUSE_S", 0.01)
    hive.experiments.start(source())
    work(hive, cluster(("a", FAST)), [runs_of(hive)[0].id])
    work(hive, cluster(("b", SLOW)), [runs_of(hive)[1].id])
    failed = runs_of(hive)[1]
    assert (failed.state, failed.reason) == (RunState.FAILED, FailureReason.START_ERROR)
    assert failed.detail == (
        f"run {failed.id}: no node has Fast CPU, the CPU model of its experiment; same_cpu: false allows others"
    )


def test_hints() -> None:
    room, hall = (run_affinity(name, (), "tiny") for name in ("room", "hall"))
    other = run_affinity("room", (), "another")
    seen = [NodeSeen("a", "X", hall), NodeSeen("b", "Y", room), NodeSeen("a", "Z", other), NodeSeen("c", "X", other)]
    assert placing_of("X", seen, {}, room, 5.0) == Placing("X", ("b",), ("a", "c"), 5.0)
    assert placing_of("X", seen, {"c": "Y", "d": "Y"}, room, None) == Placing("X", ("b", "c", "d"), ("a",))
    assert placing_of(None, seen, {"c": "Y"}, room, None) == Placing(None, (), ("a", "b", "c"))
    assert placing_of("X", [], {}, "", None) == Placing("X")


@pytest.mark.parametrize("text", ["maybe", "3", "[true]"])
def test_a_wrong_value_names_the_line(text: str) -> None:
    with pytest.raises(Exception, match=r"one\.yaml line 7: same_cpu"):
        parse_experiment(f"{ONE}same_cpu: {text}\n", "one.yaml")


def test_experiments_that_are_stored_keep_their_hash() -> None:
    stored = parse_experiment(ONE)
    assert parse_experiment(f"{ONE}same_cpu: true\n").content_hash == stored.content_hash
    assert parse_experiment(f"{ONE}same_cpu: false\n").content_hash != stored.content_hash
