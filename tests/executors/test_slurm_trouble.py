"""Runs on a real Slurm whose parts are killed, and jobs that it cannot run."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from slamhive.executors.base import EngineUnavailable, StartFailed
from slamhive.executors.registry import open_executor
from slamhive.executors.slurm import command
from slamhive.executors.slurm.command import Queue
from slamhive.executors.slurm.executor import SlurmExecutor
from slamhive.executors.slurm.jobs import ArraySubmission
from slamhive.executors.spec import ResourceLimits
from slamhive.executors.status import Gone, Running
from tests.executors.conftest import wait_for_end
from tests.executors.processes import processes_of
from tests.executors.slurm_cluster import NODES
from tests.executors.test_contract import RESULT, SAVES_ITS_MAP
from tests.waiting import eventually

pytestmark = [pytest.mark.cluster, pytest.mark.parametrize("maker", ["slurm"], indirect=True)]


UNTIL_TOLD = RESULT + (
    "open(result / 'starts', 'a').write('x')\nwhile not (result / 'end').exists():\n    time.sleep(0.02)\n"
)


def test_runs_go_on_and_are_adopted_while_the_controller_and_the_node_daemon_are_away(bench, slurm_cluster):
    spec, handle = bench.start(UNTIL_TOLD)
    bench.wait_for(spec, handle, "starts")
    slurm_cluster.wait_until_saved()
    slurm_cluster.kill("slurmctld")
    node = handle.data["node"]
    slurm_cluster.kill(f"slurmd-{node}")
    other = bench.again()
    with pytest.raises(EngineUnavailable):
        other.poll(handle)
    assert "controller" in str(other.unavailable_because())
    assert other.start(spec) == handle
    slurm_cluster.start_controller()
    slurm_cluster.start_node(node)
    assert isinstance(bench.again().poll(handle), Running)
    (bench.result(spec) / "end").touch()
    assert wait_for_end(other, handle).exit_code == 0
    assert (bench.result(spec) / "starts").read_text() == "x"


def test_a_run_that_ended_while_the_controller_was_away(bench, slurm_cluster):
    spec, handle = bench.start(UNTIL_TOLD)
    slurm_cluster.wait_until_saved()
    slurm_cluster.kill("slurmctld")
    (bench.result(spec) / "end").touch()
    eventually((spec.work / "exit.json").exists, "the end")
    assert bench.executor.poll(handle).exit_code == 0
    slurm_cluster.start_controller()


def test_a_killed_supervisor_is_lost_and_leaves_nothing(bench):
    spec, handle = bench.start(UNTIL_TOLD)
    bench.wait_for(spec, handle, "starts")
    os.kill(int(handle.data["pid"]), signal.SIGKILL)
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end of the job")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone)
    assert "is FAILED" in status.why
    eventually(lambda: not processes_of(handle), "the end of the run")


def test_a_slurm_without_accounting_remembers_no_job(bench):
    _, handle = bench.start(UNTIL_TOLD)
    assert command.accounted_jobs(handle.data["job"]) == []


def test_a_job_that_no_node_can_run(bench):
    with pytest.raises(StartFailed, match="Memory specification can not be satisfied"):
        bench.start(UNTIL_TOLD, ResourceLimits(memory_bytes=10**14))


def test_a_drained_node_takes_no_further_run(bench):
    def node(name):
        return next(node for node in bench.executor.nodes() if node.name == name)

    assert node("one").cpu_count >= 1
    assert node("one").memory_bytes > 0
    bench.executor.drain("one", True)
    try:
        eventually(lambda: node("one").drained, "the drained node")
        assert not node("one").takes_runs
        _, handle = bench.start(RESULT)
        assert handle.data["node"] == "two"
    finally:
        bench.executor.drain("one", False)
    eventually(lambda: node("one").takes_runs, "the node that is back")


def test_a_run_on_a_node_that_is_set_down_is_lost_with_it(bench, slurm_cluster):
    """Slurm ends its processes by SIGTERM first, of which the supervisor leaves a record."""
    spec, handle = bench.start(UNTIL_TOLD)
    node = handle.data["node"]
    slurm_cluster.run("scontrol", "update", f"nodename={node}", "state=down", "reason=test")
    try:
        eventually((spec.work / "exit.json").exists, "the record of the end")
        status = bench.executor.poll(handle)
        assert isinstance(status, Gone)
        assert f"its node failed: job {handle.data['job']} is NODE_FAIL" in status.why
    finally:
        slurm_cluster.bring_back(node)


def test_a_run_whose_job_somebody_cancels_is_lost_though_it_saved_its_map(bench, slurm_cluster):
    spec, handle = bench.start(SAVES_ITS_MAP)
    bench.wait_for(spec, handle)
    slurm_cluster.run("scancel", handle.data["job"])
    eventually((spec.work / "exit.json").exists, "the record of the end")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone)
    assert f"it was ended from outside: job {handle.data['job']} is CANCELLED" in status.why
    assert (bench.result(spec) / "map").exists()


def test_a_job_that_waits_forever(bench):
    spec = bench.spec(UNTIL_TOLD, ResourceLimits(cpu_cores=5000.0))
    with pytest.raises(StartFailed, match=r"no node meets what run 1 asks for: job .* is PENDING"):
        bench.executor.start(spec)
    bench.executor.discard(spec)
    assert not [job for job in jobs_of(spec) if not job.over]


def test_a_job_that_waits_for_its_turn_starts_later_and_once(bench, slurm_cluster, monkeypatch):
    monkeypatch.setattr("slamhive.executors.slurm.executor.START_WAIT_S", 0.5)
    slurm_cluster.set_nodes("state=drain", "reason=test")
    spec = bench.spec(UNTIL_TOLD)
    for _ in range(2):
        with pytest.raises(EngineUnavailable, match=r"run 1 waits in Slurm: job .* is PENDING"):
            bench.executor.start(spec)
    slurm_cluster.set_nodes("state=resume")
    eventually((spec.work / "shim.json").exists, "the start")
    bench.handles.append(bench.executor.start(spec))
    bench.wait_for(spec, bench.handles[0], "starts")
    assert len(jobs_of(spec)) == 1


def test_a_job_that_the_controller_has_forgotten_is_submitted_again(bench, slurm_cluster):
    """Killed before it has saved the job, it comes back without it while the executor waits for the start."""
    slurm_cluster.set_nodes("state=drain", "reason=test")
    slurm_cluster.wait_until_saved()
    spec = bench.spec(UNTIL_TOLD)
    with ThreadPoolExecutor(1) as other:
        with slurm_cluster.forgetful():
            starting = other.submit(bench.executor.start, spec)
            eventually(lambda: jobs_of(spec), "the job")
        assert jobs_of(spec) == []
        with pytest.raises(EngineUnavailable, match=r"is submitted again|controller|could not list"):
            starting.result()
    for node in NODES:
        slurm_cluster.bring_back(node)
    bench.handles.append(bench.executor.start(spec))
    bench.wait_for(spec, bench.handles[0], "starts")
    assert len(jobs_of(spec)) == 1


def test_a_job_that_its_node_could_not_launch_is_submitted_again(bench, slurm_cluster):
    """A node cancels such a job itself, which happens when its daemon is killed. Here it is stopped until then."""
    spec = bench.spec(UNTIL_TOLD)
    with ThreadPoolExecutor(1) as other:
        with slurm_cluster.frozen_nodes():
            starting = other.submit(bench.executor.start, spec)
            eventually(lambda: [job for job in jobs_of(spec) if job.runs], "a node for the job")
            (job,) = jobs_of(spec)
            command.cancel(job)
        with pytest.raises(EngineUnavailable, match=r"run 1 did not start and is submitted again: job .* is CANCELLED"):
            starting.result()
    bench.handles.append(bench.executor.start(spec))
    bench.wait_for(spec, bench.handles[0], "starts")
    assert len(jobs_of(spec)) == 2


def jobs_of(spec):
    """The jobs of a run that Slurm knows."""
    return [job for job in command.list_jobs() if job.comment.endswith(f":{spec.key}")]


def start_together(bench, specs):
    """Start all runs in one array: the first one to come waits for the others."""

    def send(sent: ArraySubmission) -> None:
        eventually(everybody, "the others")
        command.submit(sent)

    queue = bench.executor._queue = Queue(send=send)

    def everybody() -> bool:
        return len(queue._waiting) >= len(specs) - 1 or any(jobs_of(spec) for spec in specs)

    with ThreadPoolExecutor(len(specs)) as pool:
        return list(pool.map(lambda spec: start_unless_it_waits(bench, spec), specs))


def start_unless_it_waits(bench, spec):
    try:
        handle = bench.executor.start(spec)
    except EngineUnavailable:
        return None
    bench.handles.append(handle)
    return handle


def test_runs_that_are_started_together_share_an_array(bench):
    specs = [bench.spec(RESULT + f"(result / 'number').write_text('{number}')\n") for number in range(6)]
    handles = start_together(bench, specs)
    assert len({job.task[0] for spec in specs for job in jobs_of(spec) if job.task}) == 1
    assert sum(job.task is not None for spec in specs for job in jobs_of(spec)) == 5
    for number, (spec, handle) in enumerate(zip(specs, handles, strict=True)):
        assert wait_for_end(bench.again(), handle).exit_code == 0
        assert (bench.result(spec) / "number").read_text() == str(number)
        assert len(jobs_of(spec)) == 1


def test_a_task_is_ended_alone(bench, slurm_cluster, monkeypatch):
    """One that runs, one that waits, and one that somebody else has cancelled while it waited."""
    monkeypatch.setattr("slamhive.executors.slurm.executor.START_WAIT_S", 3.0)
    specs = [bench.spec(UNTIL_TOLD, ResourceLimits(cpu_cores=1.0)) for _ in range(8)]
    start_together(bench, specs)
    begun = lambda: [spec for spec in specs if (spec.work / "shim.json").exists()]  # noqa: E731
    eventually(lambda: len(begun()) == 4, "a run on each core")
    started = [(spec, bench.executor.start(spec)) for spec in begun()]
    bench.handles += [handle for _, handle in started if handle not in bench.handles]
    waiting = [spec for spec in specs if spec not in begun()]
    bench.executor.stop(started[-1][1], 1.0)
    assert all(job.over for job in jobs_of(started[-1][0]))
    bench.executor.discard(waiting[-1])
    assert all(job.over for job in jobs_of(waiting[-1]))
    eventually(lambda: len(begun()) == 5, "a run on the core that is free again")
    cancelled, _ = (spec for spec in waiting[:-1] if spec not in begun())
    with ThreadPoolExecutor(1) as other:
        starting = other.submit(bench.executor.start, cancelled)
        (job,) = jobs_of(cancelled)
        slurm_cluster.run("scancel", job.name)
        with pytest.raises((StartFailed, EngineUnavailable)):
            starting.result()
    for spec, handle in started[:-1]:
        assert isinstance(bench.executor.poll(handle), Running)
        (bench.result(spec) / "end").touch()
        assert wait_for_end(bench.executor, handle).exit_code == 0
    for spec in waiting[:-1]:
        if spec is not cancelled:
            bench.handles.append(bench.executor.start(spec))
            assert len(jobs_of(spec)) == 1
    bench.executor.discard(cancelled)


def test_jobs_of_runs_that_are_over_are_swept(bench):
    spec, handle = bench.start(UNTIL_TOLD)
    assert bench.again().sweep(lambda: {spec.key}) == []
    (swept,) = bench.again().sweep(set)
    assert swept.startswith("job ")
    eventually(lambda: not isinstance(bench.again().poll(handle), Running), "the end of the job")


def test_doctor_findings(bench):
    assert isinstance(bench.executor, SlurmExecutor)
    assert open_executor("slurm", bench.context).unavailable_because() is None
    assert [finding.name for finding in bench.executor.examine()] == ["version", "SLURM_OPTIONS", "SLURM_CONTAINERS"]
