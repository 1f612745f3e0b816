"""Duration of ``slamhive dataset check`` against a plain pass over the same recording, and its peak memory.

The plain pass reads and deserialises every message and does nothing with it. Both run in pairs, in alternating order,
each in a process of its own that has imported everything, as a command does. The medians of wall and CPU times are
printed, with their ratios. The goal is a ratio of 2.0 of the wall times. A check examines images in a second thread, so
it needs two idle cores.

    python benchmarks/check.py [--dataset FOLDER] [--seconds 15] [--pairs 7] [--json]

Without ``--dataset`` the room is rendered, which takes about three times its duration. Memory is what a check adds to
the peak of the resident set of a process that has imported everything.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401 - a check needs it
import scipy.spatial  # noqa: F401 - a check needs it

from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.checks.registry import check_dataset
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.room import RoomOptions, render_room

GOAL = 2.0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, help="folder of a dataset; the room without it")
    parser.add_argument("--seconds", type=float, default=15.0, help="duration of the room")
    parser.add_argument("--pairs", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamhive-check-") as scratch:
        folder = arguments.dataset or rendered(Path(scratch) / "room", arguments.seconds)
        result = measure(load_dataset(folder), max(1, arguments.pairs))
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    print(f"recording {result['megabytes']:.0f} MB, {result['findings']} findings")
    print(f"plain pass {result['plain_s']:.3f} s, check {result['check_s']:.3f} s")
    verdict = "held" if result["ratio"] <= GOAL else "NOT held"
    print(f"ratio {result['ratio']:.2f}, goal {GOAL} {verdict}; of CPU time {result['cpu_ratio']:.2f}")
    print(f"memory of a check {result['peak_mb']:.0f} MB")


def rendered(folder: Path, seconds: float) -> Path:
    """The room in ``folder``."""
    render_room(folder, RoomOptions("room", seconds), lambda _fraction, _text: None)
    return folder


def measure(dataset: Dataset, pairs: int) -> dict[str, Any]:
    """Medians of both over ``pairs``, after one round that reads the recording into the page cache."""
    both: tuple[Callable[[Dataset], int], ...] = (plain_pass, check)
    for work in both:
        measured(work, dataset)
    found: dict[str, list[Measured]] = {work.__name__: [] for work in both}
    for pair in range(pairs):
        for work in both if pair % 2 else reversed(both):
            found[work.__name__].append(measured(work, dataset))
    walls = {name: [entry.wall_s for entry in entries] for name, entries in found.items()}
    plain_s, check_s = (statistics.median(walls[work.__name__]) for work in both)
    return {
        "megabytes": size_bytes(dataset.bag_path) / 1e6,
        "findings": found[check.__name__][0].count,
        "plain_s": plain_s,
        "check_s": check_s,
        "ratio": ratio(walls),
        "cpu_ratio": ratio({name: [entry.cpu_s for entry in entries] for name, entries in found.items()}),
        "peak_mb": max(entry.peak_mb for entry in found[check.__name__]),
    }


@dataclass(frozen=True, slots=True)
class Measured:
    """One pass. ``peak_mb`` is what it added to the resident set at its peak."""

    count: int
    wall_s: float
    cpu_s: float
    peak_mb: float


def measured(work: Callable[[Dataset], int], dataset: Dataset) -> Measured:
    """``work`` in a new process."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_measure, work, dataset).result()


def _measure(work: Callable[[Dataset], int], dataset: Dataset) -> Measured:
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    begun_s, cpu_begun_s = time.perf_counter(), time.process_time()
    count = work(dataset)
    wall_s, cpu_s = time.perf_counter() - begun_s, time.process_time() - cpu_begun_s
    return Measured(count, wall_s, cpu_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - before_mb)


def ratio(times: dict[str, list[float]]) -> float:
    """The median over all pairs of the check's time divided by that of the plain pass."""
    plain, ours = times.values()
    return statistics.median(mine / other for other, mine in zip(plain, ours, strict=True))


def plain_pass(dataset: Dataset) -> int:
    """Read and deserialise everything; the number of messages."""
    count = 0
    with open_bag(dataset.bag_path) as reader:
        for connection, _, raw in messages(reader, dataset.bag_path):
            decode(reader, dataset.bag_path, connection, raw)
            count += 1
    return count


def check(dataset: Dataset) -> int:
    """The number of findings."""
    return len(check_dataset(dataset, lambda _fraction, _text: None).findings)


def size_bytes(path: Path) -> int:
    """Of a file, or of all files in a folder."""
    return sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())


if __name__ == "__main__":
    main()
