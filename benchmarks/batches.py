"""Time to import many trajectories, and to queue the evaluation of all of them at once.

    python benchmarks/batches.py [--runs 10000] [--evaluate]

Everything lies in a temporary folder and is removed. Trajectories are short, because what is measured is what each run
costs beside its poses. CPU time is that of this process and of those it has started. ``--evaluate`` also works the
queue off.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamhive.cli.waiting import evaluate_to_end
from slamhive.domain.sensors import SensorSetup
from slamhive.services.hive import Hive, open_hive
from slamhive.services.imports.request import ImportRequest

T = TypeVar("T")
GROUPS = 10
"""Algorithms, and as many datasets."""
POSES = 100


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--evaluate", action="store_true", help="also evaluate them all")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamhive-batches-") as scratch:
        source, data = Path(scratch) / "source", Path(scratch) / "data"
        data.mkdir()
        write_source(source, arguments.runs)
        hive = open_hive({"data": data, "executor": "process"})
        try:
            measure(hive, source, evaluate=arguments.evaluate)
        finally:
            hive.close()


def measure(hive: Hive, source: Path, *, evaluate: bool) -> None:
    """Each step with its times."""
    request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
    service = hive.evaluations
    report = timed("import", lambda: hive.imports.carry_out(request, lambda _done, _total: None))
    timed("import again, all known", lambda: hive.imports.carry_out(request, lambda _done, _total: None))
    wanted = timed("find the runs without evaluation", service.unevaluated)
    assert wanted == report.run_ids, report.problems[:3]
    queued = timed("queue their evaluation", lambda: service.queue(wanted))
    again = timed("queue it again, all waiting", lambda: service.queue(wanted))
    assert queued == again
    timed("see which have ended", lambda: service.still_open(queued))
    if evaluate:
        began_s, cpu_s = time.perf_counter(), _cpu_s()
        ended = timed("evaluate", lambda: evaluate_to_end(service, queued))
        wall_ms, cpu_ms = (1e3 * used / len(ended) for used in (time.perf_counter() - began_s, _cpu_s() - cpu_s))
        done = sum(entry.reason is None for entry in ended)
        print(f"{done} of {len(ended)} evaluated: {wall_ms:.1f} ms a run, CPU {cpu_ms:.1f} ms a run")


def timed(what: str, work: Callable[[], T]) -> T:
    """Do it; print wall and CPU time, and how busy the machine was."""
    began_s, cpu_s = time.perf_counter(), _cpu_s()
    result = work()
    used = f"{time.perf_counter() - began_s:8.2f} s   CPU {_cpu_s() - cpu_s:8.2f} s"
    print(f"{what:36s} {used}   load {os.getloadavg()[0]:.1f}", flush=True)
    return result


def _cpu_s() -> float:
    """Of this process and of those it has started and waited for."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def write_source(root: Path, runs: int) -> None:
    """Trajectories in ``<algorithm>/<dataset>/<trial>.txt``, and ground truths."""
    for name, text in _files(runs):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def _files(runs: int) -> Iterator[tuple[str, str]]:
    for dataset in range(GROUPS):
        yield f"seq{dataset}/groundtruth.txt", _trajectory(0)
    for number in range(runs):
        group = number % (GROUPS * GROUPS)
        yield f"system{group // GROUPS}/seq{group % GROUPS}/{number // (GROUPS * GROUPS)}.txt", _trajectory(number + 1)


def _trajectory(seed: int) -> str:
    noise = np.random.default_rng(seed).normal(0, 0.02 if seed else 0.0, (POSES, 3))
    return "".join(
        f"{100 + i / 10:.6f} {np.cos(i / 5) + x:.6f} {np.sin(i / 5) + y:.6f} {i / 40 + z:.6f} 0 0 0 1\n"
        for i, (x, y, z) in enumerate(noise.tolist())
    )


if __name__ == "__main__":
    main()
