"""In which order, and where, a worker takes what is queued: affinity, pauses, several slots, an absent engine."""

from __future__ import annotations

import os
import threading
import time
from typing import Any

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.configuration import VariantStep
from slamhive.domain.run import RunState
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Running
from slamhive.recordings.variants import build as building
from slamhive.recordings.variants.build import build_variant
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.worker import turns as turns_module
from tests.services.fake_executor import FakeDocker, FakeExecutor, write_trajectory
from tests.services.test_variant_runs import HALF, hive
from tests.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.integration

__all__ = ["hive"]

THIRD = (VariantStep("rate", ("lidar",), {"every": 3}),)
EXPERIMENT = """
name: pausing
algorithms: tiny
datasets: track
parameters: {seconds: 0.1 | 0.2 | 0.3 | 0.4}
evaluate: false
executor: process
"""


def queue(hive: Hive, executor: FakeExecutor, *variants: Any) -> list[int]:
    hive.executors.opened["process"] = executor
    runs = [hive.runs.submit(Submission("tiny", "track", variant=variant, evaluate=False))[0] for variant in variants]
    return [run.id for run in runs]


def order(executor: FakeExecutor) -> list[int]:
    return [spec.run_id for spec in executor.starts]


def test_a_slot_does_runs_on_the_same_data_one_after_the_other(hive):
    executor = FakeExecutor(on_start=write_trajectory())
    first, second, third, fourth = queue(hive, executor, HALF, THIRD, HALF, THIRD)
    hive.worker().run(until_idle=True)
    assert order(executor) == [first, third, second, fourth]


def test_the_oldest_has_its_turn_after_so_many_in_a_row(hive, monkeypatch):
    monkeypatch.setattr(turns_module, "MOST_IN_A_ROW", 2)
    executor = FakeExecutor(on_start=write_trajectory())
    first, other, second, third = queue(hive, executor, HALF, THIRD, HALF, HALF)
    hive.worker().run(until_idle=True)
    assert order(executor) == [first, second, other, third]


def test_two_slots_make_a_variant_once_and_stay_on_their_cores(hive, monkeypatch):
    built, builders = [], []

    def build(*arguments: Any) -> Any:
        built.append(arguments[1])
        builders.append(os.sched_getaffinity(0))
        time.sleep(0.3)
        return make(*arguments)

    make = build_variant
    monkeypatch.setattr(building, "build_variant", build)
    together = threading.Barrier(2, timeout=PATIENCE_S)

    def start(spec: RunSpec) -> None:
        together.wait()
        seen.append((spec.limits.cpuset, os.sched_getaffinity(0)))
        write_trajectory()(spec)

    seen: list[Any] = []
    both = open_hive({"worker_slots": 2})
    queue(both, FakeExecutor(on_start=start), *[HALF] * 4)
    both.worker().run(until_idle=True)
    both.close()
    assert both.runs.counts()[RunState.SUCCEEDED] == 4
    assert len(built) == 1
    shares = {cpuset for cpuset, _ in seen}
    assert len(shares) == 2
    assert not set.intersection(*map(set, shares))
    assert all(set(cpuset) == cores for cpuset, cores in seen)
    assert tuple(sorted(builders[0])) in shares


def test_a_paused_experiment_lets_the_run_end_that_goes_on(hive):
    def start(spec: RunSpec) -> None:
        write_trajectory()(spec)
        if len(executor.starts) == 2:
            hive.experiments.pause("pausing")

    executor = FakeExecutor(on_start=start)
    hive.executors.opened["process"] = executor
    hive.experiments.start(ExperimentSource(EXPERIMENT, "pausing.yaml"))
    hive.worker().run(until_idle=True)
    counts = hive.runs.counts()
    assert (counts[RunState.SUCCEEDED], counts[RunState.QUEUED]) == (2, 2)
    hive.experiments.resume("pausing")
    hive.worker().run(until_idle=True)
    assert hive.runs.counts()[RunState.SUCCEEDED] == 4


def test_runs_of_other_executors_go_on_while_an_engine_is_away(hive):
    docker: Any = FakeDocker([Running(), Exited(0)], write_trajectory())
    process = FakeExecutor([Exited(0)], write_trajectory())
    hive.executors.opened.update(docker=docker, process=process)
    waiting, going = (
        hive.runs.submit(Submission("tiny", "track", executor=name, priority=priority, evaluate=False))[0].id
        for name, priority in (("docker", 5), ("process", 0))
    )
    docker.unavailable_because = lambda: "no Docker engine answers"
    docker.build_error = EngineUnavailable("no Docker engine answers")
    thread = threading.Thread(target=hive.worker().run, kwargs={"until_idle": True})
    thread.start()
    eventually(lambda: hive.runs.get(going).state is RunState.SUCCEEDED, "the run that can go on")
    assert hive.runs.get(waiting).state is RunState.QUEUED
    assert [event.why for event in hive.runs.events(waiting)][-1] == "waits: no Docker engine answers"
    assert thread.is_alive(), "it waits for the engine"

    docker.build_error = None
    docker.unavailable_because = lambda: None
    thread.join(PATIENCE_S)
    assert hive.runs.get(waiting).state is RunState.SUCCEEDED


def test_an_engine_that_comes_back_between_two_looks_leaves_no_run_behind(hive, monkeypatch):
    """It was away when the worker looked for a run, and there when the worker asked whether it may end."""
    monkeypatch.setattr("slamhive.services.worker.worker.TROUBLE_PAUSE_S", 0.0)
    docker: Any = FakeDocker([Running(), Exited(0)], write_trajectory())
    hive.executors.opened.update(docker=docker)
    (waiting,) = hive.runs.submit(Submission("tiny", "track", executor="docker", evaluate=False))
    docker.build_error = EngineUnavailable("no Docker engine answers")
    answers = iter(["no Docker engine answers"])

    def away_once() -> str | None:
        docker.build_error = None
        return next(answers, None)

    docker.unavailable_because = away_once
    hive.worker().run(until_idle=True)
    assert hive.runs.get(waiting.id).state is RunState.SUCCEEDED


def test_a_run_that_waits_for_an_engine_can_be_cancelled(hive):
    docker: Any = FakeDocker()
    hive.executors.opened["docker"] = docker
    (run,) = hive.runs.submit(Submission("tiny", "track", executor="docker", evaluate=False))
    docker.unavailable_because = lambda: "no Docker engine answers"
    docker.build_error = EngineUnavailable("no Docker engine answers")
    thread = threading.Thread(target=hive.worker().run, kwargs={"until_idle": True})
    thread.start()
    eventually(lambda: any(event.why.startswith("waits") for event in hive.runs.events(run.id)), "waiting")
    hive.runs.cancel(run.id)
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert hive.runs.get(run.id).state is RunState.CANCELLED
