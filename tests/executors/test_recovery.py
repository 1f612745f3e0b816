"""What is left when something is killed at the worst moment."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import docker
import docker.errors
import psutil
import pytest

from slamhive.executors.docker import containers, engine
from slamhive.executors.docker.engine import OWNER_LABEL, labels_of_helper, traits_of
from slamhive.executors.docker.executor import DockerExecutor
from slamhive.executors.host import worker_identity
from slamhive.executors.process.environment import KEY_VARIABLE, shim_spec_of
from slamhive.executors.process.tree_limit import ProcessTreeSource
from slamhive.executors.spec import ResourceLimits
from slamhive.executors.status import Exited, Gone, Running
from tests.executors.conftest import wait_for_end
from tests.waiting import eventually

pytestmark = pytest.mark.integration

PROJECT_ROOT = Path(__file__).resolve().parents[2]
SLEEP = "import time\ntime.sleep(60)\n"
process_only = pytest.mark.parametrize("maker", ["process"], indirect=True)
counted_by_the_supervisor = pytest.mark.parametrize("maker", ["process-tree"], indirect=True)
docker_only = pytest.mark.parametrize("maker", [pytest.param("docker", marks=pytest.mark.docker)], indirect=True)


def with_key(key: str) -> list[psutil.Process]:
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(KEY_VARIABLE) == key and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            continue
    return found


@process_only
def test_killed_supervisor_is_gone_and_takes_the_algorithm_along(bench):
    spec, handle = bench.start("import subprocess, sys, time\nsubprocess.Popen([sys.executable, '-c', 'import time; time.sleep(100)'], start_new_session=True)\ntime.sleep(100)\n")  # fmt: skip  # noqa: E501
    eventually(lambda: len(with_key(spec.key)) == 2, "the start of both processes")
    os.kill(int(handle.data["pid"]), signal.SIGKILL)
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end of the supervisor")
    assert isinstance(bench.executor.poll(handle), Gone)
    assert bench.executor.usage_source(handle) is None
    bench.executor.remove(handle)
    eventually(lambda: not with_key(spec.key), "the end of what was left", patience_s=30)


@docker_only
def test_a_container_that_an_earlier_boot_has_started_is_lost(bench, monkeypatch):
    """A machine that shuts down asks it to end; after a loss of power its exit code means nothing, too."""
    monkeypatch.setattr(engine, "boot_id", lambda: "6fe5b37a")
    _, handle = bench.start("")
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end")
    assert isinstance(bench.executor.poll(handle), Exited)
    monkeypatch.undo()
    status = bench.again().poll(handle)
    assert isinstance(status, Gone)
    assert status.why == "the machine was restarted, and nobody saw how the run ended (exit code 0)"


@docker_only
def test_a_container_that_its_engine_has_forgotten_to_have_started_is_not_started_again(bench):
    """The engine was killed after the algorithm began, and before it saved that."""
    spec = bench.spec("")
    container = bench.executor._containers.create(spec, traits_of(bench.executor._engine()))
    (bench.result(spec) / "trace").touch()
    handle = bench.start_spec(spec)
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone)
    assert handle.data["container"] == container.id
    assert "its engine was killed as it started" in status.why


@docker_only
def test_a_container_that_an_earlier_boot_has_created_is_made_again(bench, monkeypatch):
    """What starts in this boot must not look as if it had started in the earlier one."""
    spec = bench.spec("")
    monkeypatch.setattr(engine, "boot_id", lambda: "6fe5b37a")
    created = bench.executor._containers.create(spec, traits_of(bench.executor._engine()))
    monkeypatch.undo()
    handle = bench.start_spec(spec)
    bench.handles.append(handle)
    assert handle.data["container"] != created.id
    assert wait_for_end(bench.executor, handle).exit_code == 0


@process_only
def test_start_that_was_killed_before_it_knew_the_supervisor(bench):
    script = "import os, time\nopen(os.environ['SLAMHIVE_RESULT'] + '/starts', 'a').write('x')\ntime.sleep(60)\n"
    spec = bench.spec(script)
    work = spec.work
    executor = bench.executor
    environment = executor._environments.find(spec.package, spec.identity)
    shim_spec_of(spec, environment, work, executor._context, executor._containment).save(work)
    orphan = [sys.executable, "-m", "slamhive.executors.process.shim", str(work)]
    with subprocess.Popen(orphan, cwd=PROJECT_ROOT), subprocess.Popen(orphan, cwd=PROJECT_ROOT):
        handle = bench.executor.start(spec)
    bench.handles.append(handle)
    assert bench.again().start(spec) == handle
    starts = bench.result(spec) / "starts"
    eventually(lambda: starts.exists() and starts.read_text(), "the start")
    time.sleep(0.3)  # a second one would have started by now
    assert isinstance(bench.again().poll(handle), Running)
    assert starts.read_text() == "x"


@counted_by_the_supervisor
def test_cpu_of_short_lived_children_is_counted(bench):
    script = (
        "import subprocess, sys, time\n"
        "code = 'import time\\nend = time.process_time() + 0.25\\nwhile time.process_time() < end: pass'\n"
        "for _ in range(4):\n    subprocess.run([sys.executable, '-c', code])\n"
        "time.sleep(100)\n"
    )
    _, handle = bench.start(script)
    source = bench.executor.usage_source(handle)
    assert isinstance(source, ProcessTreeSource)
    seen_s = [0.0]

    def all_seen() -> bool:
        usage = source.read()
        assert usage is not None
        seen_s.append(usage[0])
        return usage[0] >= 1.0

    eventually(all_seen, "a second of CPU time")
    assert seen_s == sorted(seen_s)


@process_only
def test_prepared_files_are_there(bench):
    script = "import os, pathlib\nassert pathlib.Path(os.environ['SLAMHIVE_PREPARED'], 'made').exists()\n"
    _, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0


@docker_only
def test_created_container_is_started_by_the_next_start(bench):
    executor = bench.executor
    assert isinstance(executor, DockerExecutor)
    spec = bench.spec(SLEEP)
    container = executor._containers.create(spec, traits_of(executor._engine()))
    handle = bench.again().start(spec)
    bench.handles.append(handle)
    assert handle.data["container"] == container.id
    assert isinstance(executor.poll(handle), Running)


@docker_only
def test_sweep_removes_what_no_run_knows(bench):
    executor = bench.executor
    assert isinstance(executor, DockerExecutor)
    kept, _ = bench.start(SLEEP)
    _, stale = bench.start(SLEEP)
    assert len(executor.sweep(lambda: {kept.key})) == 1
    assert isinstance(executor.poll(stale), Gone)
    assert isinstance(executor.poll(bench.handles[0]), Running)


@docker_only
def test_sweep_removes_the_containers_of_dead_processes_alone(bench, monkeypatch):
    executor = bench.executor
    assert isinstance(executor, DockerExecutor)
    engine = docker.from_env()
    host, namespace, pid, boot_and_birth = worker_identity().split(":", 3)

    def evaluation(command: str, *, owner: str):
        labels = labels_of_helper("evaluation", bench.context.installation) | {OWNER_LABEL: owner}
        return engine.containers.create(bench.image, ["sh", "-c", command], labels=labels, network_mode="none")

    dead = f"{host}:{namespace}:{pid}:{boot_and_birth}1"
    of_the_dead = [evaluation("true", owner=dead), evaluation("sleep 100", owner=dead)]
    kept = [evaluation(command, owner=worker_identity()) for command in ("true", "true", "sleep 100")]
    made, over, working = kept
    try:
        for container in (of_the_dead[1], over, working):
            container.start()
        over.wait()
        assert sorted(executor.sweep(list)) == sorted(container.name for container in of_the_dead)
        monkeypatch.setattr(containers, "OWNER_PATIENCE", timedelta(0))
        assert sorted(executor.sweep(list)) == sorted((made.name, over.name))
    finally:
        for container in (*of_the_dead, *kept):
            with contextlib.suppress(docker.errors.NotFound):
                container.remove(force=True)
        engine.close()


@docker_only
def test_a_start_waits_for_the_container_that_the_engine_still_makes(bench):
    """The engine takes the name of a container first: a second request is refused before the container can be found."""
    spec = bench.spec(SLEEP)
    starters = [bench.again() for _ in range(6)]
    with ThreadPoolExecutor(len(starters)) as pool:
        handles = list(pool.map(lambda starter: starter.start(spec), starters))
    bench.handles.append(handles[0])
    assert {handle.data["container"] for handle in handles} == {handles[0].data["container"]}
    assert isinstance(bench.executor.poll(handles[0]), Running)
    for starter in starters:
        starter.close()


@docker_only
def test_child_killed_by_the_memory_limit_counts(bench):
    script = (
        "import subprocess, sys, time\n"
        "subprocess.run([sys.executable, '-c', 'x = b\"1\" * 300_000_000'])\ntime.sleep(0.5)\n"
    )
    _, handle = bench.start(script, ResourceLimits(memory_bytes=60_000_000))
    assert wait_for_end(bench.executor, handle).out_of_memory
