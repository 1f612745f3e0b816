"""Time for a worker with many slots to submit its runs to Slurm: as job arrays, and job by job.

A Slurm of its own starts on this machine (root; ``slurm-wlm``, ``munge``, ``charliecloud``), with nodes that take no
jobs. Both ways use as many threads as there are runs, alternating::

    .venv/bin/python -m benchmarks.slurm_submission --runs 200
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from slamhive.executors.slurm import command
from slamhive.executors.slurm.command import Queue
from slamhive.executors.slurm.jobs import ArraySubmission, JobRequest, submission
from tests.executors.slurm_cluster import Cluster


def main() -> None:
    """Print a table and the ratio of the two ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="runs that are started at the same time")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, Cluster(Path(folder)) as cluster:
        os.environ.update(cluster.variables)
        cluster.set_nodes("state=drain", "reason=benchmark")
        measured: dict[str, list[tuple[float, int, float]]] = {"arrays": [], "job by job": []}
        for _ in range(arguments.rounds):
            for way, rounds in measured.items():
                rounds.append(_round(way, arguments.runs))
                cluster.run("scancel", "--user=root", "--state=PENDING")
    print(f"{'':<12}{'submitted (s)':>15}{'calls of sbatch':>17}{'squeue --json (s)':>19}")
    for way, rounds in measured.items():
        took_s, calls, look_s = (statistics.median(column) for column in zip(*rounds, strict=True))
        print(f"{way:<12}{took_s:>15.2f}{calls:>17.0f}{look_s:>19.3f}")
    ratio = statistics.median(
        first[0] / second[0] for first, second in zip(measured["arrays"], measured["job by job"], strict=True)
    )
    print(f"arrays over job by job: {ratio:.2f} of the time")


def _round(way: str, runs: int) -> tuple[float, int, float]:
    """Submit all; the time it took (s), the calls of ``sbatch``, and how long a look at all jobs took then (s)."""
    calls: list[ArraySubmission] = []

    def send(sent: ArraySubmission) -> None:
        calls.append(sent)
        command.submit(sent)

    queue = Queue(send=send)
    submit: Callable[[JobRequest], None] = queue.submit if way == "arrays" else lambda asked: send(submission([asked]))
    keys = [uuid.uuid4().hex for _ in range(runs)]  # as long as those of runs: they bound an array
    requests = [
        JobRequest(f"slamhive-{run}", uuid.NAMESPACE_URL.hex, key, Path("/dev/null"), ("--mem=1M",), "true\n")
        for run, key in enumerate(keys)
    ]
    began_s = time.monotonic()
    with ThreadPoolExecutor(runs) as pool:
        list(pool.map(submit, requests))
    took_s = time.monotonic() - began_s
    began_s = time.monotonic()
    jobs = queue.jobs(0.0)
    look_s = time.monotonic() - began_s
    assert {job.comment.rpartition(":")[2] for job in jobs if job.waits} >= set(keys)
    return took_s, len(calls), look_s


if __name__ == "__main__":
    main()
