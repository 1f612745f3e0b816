"""A batch in a container: its lines, how it ended, and the cores it keeps to."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable
from pathlib import Path

import docker
import pytest

from slamhive.base.errors import Unavailable
from slamhive.evaluation.process import BatchMount, EvaluationBatch
from slamhive.executors.base import ExecutorContext
from slamhive.executors.docker.batch import DockerStarter
from slamhive.executors.docker.engine import INSTALLATION_LABEL
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.docker

ROOT = Path(__file__).resolve().parents[2]

Run = Callable[..., tuple[str | None, list[str]]]


@pytest.fixture
def run(base_image, tmp_path: Path) -> Run:
    """Run a script as the batch; how it ended and what it said."""
    context = ExecutorContext(tmp_path, tmp_path, f"test-{os.getpid()}-{tmp_path.name}")
    starter = DockerStarter(context, base_image)

    def run_script(
        script: str,
        timeout_s: float = PATIENCE_S,
        cores: tuple[int, ...] | None = None,
        job: str = "/slamhive/job.py",
    ):
        path = tmp_path / "script.py"
        path.write_text(f"#!/usr/bin/python3\n{script}")
        path.chmod(0o755)
        mounts = (BatchMount(path, job, read_only=True),)
        said: list[str] = []
        batch = EvaluationBatch(job, mounts, tmp_path, timeout_s, cores)
        ended = starter.run_batch(batch, said.append, threading.Event())
        client = docker.from_env()
        label = f"{INSTALLATION_LABEL}={context.installation}"
        assert client.containers.list(all=True, filters={"label": label}) == []
        client.close()
        return ended, said

    return run_script


@pytest.mark.parametrize("attempt", range(6))
def test_lines_and_good_end(run: Run, attempt: int):
    # Several times: an engine's log loses the last words of a short container now and then.
    assert run("print('one')\nprint('two', end='')\n") == (None, ["one", "two"])


def test_last_words_of_a_bad_end(run: Run):
    ended, _ = run("raise SystemExit('no evo here')\n")
    assert ended == "exit code 1: no evo here"


def test_time_limit(run: Run):
    assert run("import time\ntime.sleep(60)\n", timeout_s=0.5)[0] == "it was still running after 0 s"


def test_a_container_that_cannot_start_leaves_no_connection_open(run: Run):
    with pytest.raises(Unavailable, match=r"starting the evaluation: .*/proc"):
        run("print('never')\n", job="/proc/job.py")  # nothing may be mounted there
    gc.collect()  # a connection that is left open warns here


def test_it_keeps_to_its_cores(run: Run):
    core = max(os.sched_getaffinity(0))
    _, said = run("import os\nprint(sorted(os.sched_getaffinity(0)))\n", cores=(core,))
    assert said == [f"[{core}]"]


def test_the_evaluation_image_is_built_once_and_says_so(tmp_path: Path):
    starter = DockerStarter(ExecutorContext(tmp_path, ROOT, f"test-{os.getpid()}-{tmp_path.name}"))
    starter.prepare(lambda line: None)
    said: list[str] = []
    starter.prepare(said.append)
    assert said == []
