"""Slurm on three machines that share files by NFS, faults of power, network, disks and clocks, and an archive."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from slamhive.domain.accounts import Role, Visibility
from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.sharing import SharingChange
from tests.machines.archive_host import ArchiveHost, Visitor
from tests.machines.cluster import KERNEL, SHARED, SLURMD_TIMEOUT_S, SlurmMachines
from tests.machines.lab import Machine, built_lab
from tests.services.installation import installation

pytestmark = [pytest.mark.machines, pytest.mark.timeout(3600)]
LONG_S = 3 * SLURMD_TIMEOUT_S
"""A run of this length outlives what takes Slurm to notice that its node is away."""


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmMachines]:
    """Three machines, of which each executes jobs, with a worker on the first."""
    lab = built_lab()
    with ExitStack() as stack:
        machines = [stack.enter_context(lab.machine(number, KERNEL, 2000, one_session=True)) for number in (1, 2, 3)]
        made = SlurmMachines(machines, machines)
        made.start()
        made.install(tmp_path_factory.mktemp("project"))
        made.start_worker()
        yield made


@pytest.fixture
def running(slurm: SlurmMachines) -> tuple[int, Machine]:
    """A run that works for long, and its machine. That has neither the controller nor the worker."""
    with drained(slurm, slurm.controller):
        (run,) = slurm.submit(LONG_S)
        return run, slurm.node_of(run)


@contextmanager
def drained(slurm: SlurmMachines, *nodes: Machine) -> Iterator[None]:
    """Nodes get no job until the end of the block."""
    for node in nodes:
        slurm.controller.run(f"scontrol update nodename={node.name} state=drain reason=test", "root")
    yield
    for node in nodes:
        slurm.controller.run(f"scontrol update nodename={node.name} state=resume", "root")


def assert_succeeded(slurm: SlurmMachines, *runs: int) -> None:
    """Each run has ended well, has all its poses, and was executed once."""
    for run in runs:
        ended = slurm.wait_for(run)
        assert (ended["state"], ended["poses"], slurm.executions(run)) == ("succeeded", 30, 1), ended["detail"]


def nodes_of(slurm: SlurmMachines, runs: list[int]) -> set[str]:
    """The nodes on which runs that have ended were executed."""
    return {slurm.record(run)["handle"]["data"]["node"] for run in runs}


def assert_lost(slurm: SlurmMachines, run: int, node: Machine) -> None:
    """The run is lost with its node, which is named, and was executed once."""
    ended = slurm.wait_for(run)
    assert ended["reason"] == "lost"
    assert "NODE_FAIL" in ended["detail"]
    assert node.name in ended["detail"]
    slurm.wait_for_node(node)
    assert slurm.executions(run) == 1


def test_runs_of_the_queue_work_on_all_hosts_and_are_evaluated(slurm):
    runs = slurm.submit(120, repeat=6, evaluate=True)
    assert_succeeded(slurm, *runs)
    assert nodes_of(slurm, runs) == {"vm1", "vm2", "vm3"}
    slurm.eventually(lambda: all(slurm.evaluated(run) for run in runs), "evaluations")
    assert slurm.machines[1].run(f"findmnt -no FSTYPE {SHARED}").strip() == "nfs4"


def test_a_node_without_power_loses_its_run_and_no_other(slurm, running):
    run, node = running
    node.power_off()
    others = slurm.submit(2, repeat=3)
    assert slurm.wait_for(run)["reason"] == "lost"
    assert_succeeded(slurm, *others)
    node.power_on()
    slurm.start_node(node)
    assert_lost(slurm, run, node)


def test_a_node_that_is_soon_back_on_the_network_keeps_its_run(slurm, running):
    run, node = running
    with node.cut():
        time.sleep(SLURMD_TIMEOUT_S / 3)
    assert_succeeded(slurm, run)


def test_a_node_that_is_cut_for_long_loses_its_run_and_takes_others_when_it_is_back(slurm, running):
    run, node = running
    with node.cut():
        (other,) = slurm.submit(2)
        assert_succeeded(slurm, other)
        assert slurm.wait_for(run)["reason"] == "lost"
    assert_lost(slurm, run, node)


def test_a_node_with_a_full_disk_keeps_its_run_because_results_are_elsewhere(slurm, running):
    run, node = running
    with node.full_disk():
        assert_succeeded(slurm, run)
    slurm.wait_for_node(node)


def test_times_of_a_node_whose_clock_is_four_minutes_behind_are_corrected(slurm):
    node = slurm.machines[2]
    with node.clock_off_by(-240), drained(slurm, *slurm.machines[:2]):
        began = datetime.now(UTC)
        (run,) = slurm.submit(5)
        assert_succeeded(slurm, run)
    record = slurm.record(run)
    assert began < datetime.fromisoformat(record["started_at"]) < datetime.fromisoformat(record["ended_at"])
    assert re.search(rf"the clock of node {node.name} is 2[2-6]\d s behind", record["handle"]["data"]["clock"])


def test_a_node_whose_clock_is_an_hour_ahead_loses_its_run(slurm, running):
    run, node = running
    with node.clock_off_by(3600):
        assert slurm.wait_for(run)["reason"] == "lost"
    assert_lost(slurm, run, node)


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, str]:
    """The archive of an installation on this machine, which has published one of its two runs, and the run's uid."""
    with installation(tmp_path / "made", monkeypatch) as made:
        hive = made.hive
        hive.accounts.add("anna", Role.ADMIN, "pass-word-4-anna")
        made.build()
        made.submit(2, (0.1,))
        made.machine.work_to_the_end()
        (_of_the_team, shown) = hive.runs.page(limit=2).records
        hive.sharings.runs([shown.id], SharingChange(Visibility.PUBLIC))
        export_archive(hive.settings, hive.store, ExportRequest(tmp_path / "room.zip"), lambda _done, _total: None)
        return tmp_path / "room.zip", hive.runs.record(shown.id)["uid"]


def test_visitors_of_a_view_only_archive_on_a_second_host_see_what_was_published(slurm, published):
    visitor, second, _third = slurm.machines
    archive, uid = published
    host = ArchiveHost(second)
    host.install()
    host.take_over(archive)
    asked = Visitor(visitor, second)
    asked.wait()
    (listed,) = json.loads(asked.body("/api/v1/runs"))["runs"]
    assert listed["uid"] == uid
    page = f"/runs/{listed['id']}"
    assert [asked.status(address) for address in ("/", "/runs", page, f"/api/v1{page}")] == [200] * 4
    assert [asked.status(address) for address in ("/login", "/accounts", "/doctor")] == [404] * 3
    assert asked.status(f"/api/v1{page}", "-X DELETE") == 403
    assert asked.status("/api/v1/runs", "-d {}") == 403
    assert asked.status("/", "-H 'Host: elsewhere.example.org'") == 400
    assert int(second.run("mariadb -N slamhive -e 'select count(*) from runs'", "root")) == 1
