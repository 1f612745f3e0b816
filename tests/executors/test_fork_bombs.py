"""Fork bombs, in every containment: the machine stays usable, the run ends with the reason, and nothing survives."""

from __future__ import annotations

import logging
import os
import subprocess
import time

import pytest

from slamhive.executors.spec import ResourceLimits
from slamhive.executors.status import Exited, Running
from tests.executors.conftest import EVERYWHERE, wait_for_end
from tests.executors.fork_bombs import BOMBS, FORKS, MOST_PROCESSES, started_by
from tests.executors.processes import processes_of
from tests.waiting import eventually

logger = logging.getLogger(__name__)

pytestmark = pytest.mark.integration

ENDS_WITHIN_S = 10


def end_of(executor, handle) -> tuple[Exited, bool, float]:
    """How the run ended, watched as a worker does; whether at its limit; the longest that a program took to start."""
    slowest_s, at_limit = 0.0, False
    while isinstance(status := executor.poll(handle), Running):
        if status.process_limit:
            at_limit = True
            executor.stop(handle, 0.0)
        begun_s = time.monotonic()
        subprocess.run(["true"], check=True)
        slowest_s = max(slowest_s, time.monotonic() - begun_s)
        time.sleep(0.1)
    assert isinstance(status, Exited)
    return status, at_limit or status.process_limit, slowest_s


@pytest.mark.parametrize("maker", EVERYWHERE, indirect=True)
@pytest.mark.parametrize(("bomb", "limit"), [*((bomb, 64) for bomb in BOMBS), ("forks", 200)])
def test_fork_bomb(bench, bomb, limit):
    spec, handle = bench.start(BOMBS[bomb], ResourceLimits(pids=limit))
    forks = bench.result(spec) / "forks"
    eventually(lambda: forks.exists() and forks.stat().st_size >= limit - 2, "the limit")
    reached_s = time.monotonic()
    status, at_limit, slowest_s = end_of(bench.executor, handle)
    took_s = time.monotonic() - reached_s
    measured = {"took_s": took_s, "processes": started_by(bench.result(spec)), "slowest_s": slowest_s}
    logger.info("%s: %s of at most %d: %s", bench.handles[0].protections.held_by, bomb, limit, measured)
    assert took_s < ENDS_WITHIN_S, measured
    assert at_limit
    assert status.exit_code in (137, 143)
    assert not status.out_of_memory
    assert processes_of(handle) == []
    assert slowest_s < 5, "the machine was hardly usable"
    if not (os.geteuid() == 0 and bench.containment == "tree"):
        # The kernel's ceiling is not for root, so a supervisor alone has nothing but its speed. Root is never left with
        # it where a user of its own can be had.
        assert started_by(bench.result(spec)) < MOST_PROCESSES, "it was its own bound that held it"


@pytest.mark.parametrize("maker", EVERYWHERE, indirect=True)
def test_a_fork_bomb_beside_another_run_ends_alone(bench):
    busy = (
        "import os, pathlib, threading, time\n"
        "result = pathlib.Path(os.environ.get('SLAMHIVE_RESULT', '/slamhive/result'))\n"
        "(result / 'ready').touch()\n"
        "while not (result / 'go').exists(): time.sleep(0.05)\n"
        "threads = [threading.Thread(target=time.sleep, args=(0.5,)) for _ in range(40)]\n"
        "for thread in threads: thread.start()\n"
        "for thread in threads: thread.join()\n"
    )
    other, other_handle = bench.start(busy, ResourceLimits(pids=64))
    eventually((bench.result(other) / "ready").exists, "the start of the other run")
    _, bomb = bench.start(FORKS, ResourceLimits(pids=64))
    _, at_limit, _ = end_of(bench.executor, bomb)
    assert at_limit
    (bench.result(other) / "go").touch()
    status = wait_for_end(bench.executor, other_handle)
    assert (status.exit_code, status.refused_processes) == (0, False)
