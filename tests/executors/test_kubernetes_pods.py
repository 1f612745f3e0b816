"""Pods that are containers of Docker: what supervisor and courier do when their pod is ended or the worker is away.

The contract suite runs on them too.
"""

from __future__ import annotations

import pytest

from slamhive.executors.kubernetes.pod_files import NODE_VARIABLE, POD_VARIABLE
from slamhive.executors.status import Exited, Gone, Running
from tests.executors.test_contract import RESULT, SAVES_ITS_MAP
from tests.waiting import eventually

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.timeout(300),
    pytest.mark.parametrize("maker", ["kubernetes-docker", "kubernetes-docker-apart"], indirect=True),
]


def test_a_pod_that_is_deleted_politely_records_that_and_brings_what_was_saved(bench, docker_nodes):
    """An algorithm that saves its map and ends with 0 has not succeeded: it saw a part of the recording."""
    spec, handle = bench.start(SAVES_ITS_MAP.replace("(result / 'map')", "time.sleep(1)\n    (result / 'map')"))
    bench.wait_for(spec, handle)
    docker_nodes.server.remove_with_owner("pods", docker_nodes.server.one("pods")["metadata"]["name"])
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the loss")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone), status
    assert "the pod was ended from outside" in status.why
    bench.executor.collect(spec, handle)
    assert (bench.result(spec) / "map").exists()


def test_a_pod_that_is_deleted_by_force_is_lost_without_a_record(bench, docker_nodes):
    spec, handle = bench.start(SAVES_ITS_MAP)
    bench.wait_for(spec, handle)
    name = docker_nodes.server.one("pods")["metadata"]["name"]
    docker_nodes.server.remove_with_owner("pods", name, by_force=True)
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the loss")
    assert bench.executor.poll(handle) == Gone("the pod was deleted from outside")
    bench.executor.remove(handle)
    assert docker_nodes.server.all("jobs") == []


def test_the_algorithm_learns_nothing_of_node_pod_and_ticket(bench):
    script = RESULT + "(result / 'known').write_text(' '.join([*os.environ, *os.listdir('/run')]))\n"
    spec, handle = bench.start(script)
    assert bench.end(spec, handle).exit_code == 0
    known = (bench.result(spec) / "known").read_text().split()
    assert "HOME" in known
    assert "slamhive" in known, "its supervisor has to be reachable"
    assert {NODE_VARIABLE, POD_VARIABLE, "slamhive-courier", "slamhive-work"}.isdisjoint(known)


def test_a_worker_that_was_away_finds_the_end_of_a_run_and_its_results(bench):
    spec, handle = bench.start(
        RESULT + "(result / 'ready').touch()\ntime.sleep(1)\n(result / 'late').touch()\nsys.exit(6)\n"
    )
    bench.wait_for(spec, handle)
    bench.executor.close()
    other = bench.again()
    eventually(lambda: not isinstance(other.poll(handle), Running), "the end")
    status = other.poll(handle)
    assert isinstance(status, Exited)
    assert status.exit_code == 6
    other.collect(spec, handle)
    assert (bench.result(spec) / "late").exists()
