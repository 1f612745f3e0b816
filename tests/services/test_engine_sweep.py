"""What killed workers have left in an engine is removed, even if it appears after the next worker has started."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import docker
import docker.errors
import pytest

from slamhive.executors.base import EngineUnavailable, LiveKeys
from slamhive.executors.docker.engine import INSTALLATION_LABEL, KEY_LABEL, OWNER_LABEL, labels_of_helper
from slamhive.executors.host import worker_identity
from slamhive.executors.registry import installation_id
from slamhive.services.worker.leftovers import EngineSweep
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.test_worker import finish, hive

pytestmark = pytest.mark.integration

__all__ = ["hive"]

DEAD = f"{worker_identity()}1"
"""The owner was a process of this machine that had the pid of this one, started at another time."""


@dataclass
class Swept(FakeExecutor):
    """Counts its sweeps."""

    found: list[set[str]] = field(default_factory=list)
    away: bool = False

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        if self.away:
            raise EngineUnavailable("no engine")
        self.found.append(set(live_keys()))
        return []


def test_the_worker_sweeps_when_it_starts_and_when_nothing_is_left_to_do(hive):
    executor = Swept(on_start=write_trajectory())
    live_meanwhile: list[set[str]] = []

    def look(spec) -> None:
        write_trajectory()(spec)
        EngineSweep("process", hive.store, hive.executors.get).sweep()
        live_meanwhile.extend(executor.found[1:])

    executor.on_start = look
    run = finish(hive, executor)
    assert live_meanwhile == [{run.uid}]
    assert executor.found == [set(), {run.uid}, set()]


def test_sweeps_have_an_interval(hive):
    hive.executors.opened["process"] = executor = Swept()
    often = EngineSweep("process", hive.store, hive.executors.get, interval_s=0)
    seldom = EngineSweep("process", hive.store, hive.executors.get, interval_s=1000)
    for sweep, times in ((often, 3), (seldom, 1)):
        executor.found.clear()
        for _ in range(3):
            sweep.sweep_if_due()
        assert len(executor.found) == times


def test_on_a_cluster_the_engines_of_the_cluster_are_swept(hive):
    class Cluster(Swept):
        name = "slurm"
        capabilities = replace(Swept.capabilities, elsewhere=True)

    cluster, here = Cluster(), Swept()
    made = {cluster.name: cluster}
    EngineSweep("auto", hive.store, lambda name: made.get(name, here), elsewhere=True).sweep()
    assert (len(cluster.found), len(here.found)) == (1, 0)


def test_an_engine_that_is_away_is_named_once_and_swept_later(hive, caplog):
    caplog.set_level("INFO")
    hive.executors.opened["process"] = executor = Swept(away=True)
    sweep = EngineSweep("process", hive.store, hive.executors.get, interval_s=0)
    sweep.sweep_if_due()
    sweep.sweep_if_due()
    assert [record.message.partition(":")[0] for record in caplog.records] == [
        "what runs have left in process is not removed now"
    ]
    executor.away = False
    sweep.sweep_if_due()
    assert executor.found == [set()]


@pytest.fixture
def engine() -> Iterator[docker.DockerClient]:
    """The engine of this machine."""
    client = docker.from_env()
    yield client
    client.close()


@pytest.mark.docker
@pytest.mark.parametrize("of", ["a run that is over", "an evaluation"])
def test_a_container_that_appears_after_the_start_of_the_next_worker_is_removed(
    hive, engine, base_image, monkeypatch, of
):
    """A worker was killed while the engine made a container for it: the engine finishes it all the same."""
    installation = installation_id(hive.settings.data)
    labels = {KEY_LABEL: "0" * 32, INSTALLATION_LABEL: installation}
    if of == "an evaluation":
        labels = labels_of_helper("evaluation", installation) | {OWNER_LABEL: DEAD}
    late = []

    def one_appears(spec) -> None:
        write_trajectory()(spec)
        late.append(engine.containers.create(base_image, ["true"], labels=labels, network_mode="none"))

    assert hive.runs  # made with the settings of before: runs have the other executor
    monkeypatch.setattr(hive, "settings", hive.settings.with_values({"executor": "docker"}))
    finish(hive, FakeExecutor(on_start=one_appears))
    try:
        with pytest.raises(docker.errors.NotFound):
            late[0].reload()
    finally:
        with contextlib.suppress(docker.errors.NotFound):
            late[0].remove(force=True)
