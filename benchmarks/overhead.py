"""Cost of the queue: one run through SLAM Hive against a bare ``docker run`` of the same image and mounts.

Prints, for each pair and as medians:

- wall time of the run from ``submit`` to stored, over that of the bare container (create, start, wait, remove);
- time from queued to the container's start, and from the container's exit to the stored outcome.

    python benchmarks/overhead.py --seconds 20 --pairs 5 [--executor slurm] [--json]

Needs a Docker engine for the bare container; the settings of the executor come from the environment. Pairs alternate in
order, so that drift of a shared machine falls on both sides alike.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import docker

from slamhive.base.errors import NotFound
from slamhive.documents.submission import Submission
from slamhive.recordings.room import RoomOptions
from slamhive.services.hive import Hive, open_hive
from slamhive.services.runs.record import spec_from_json
from slamhive.store import RunRecord

RATIO_BOUND = 1.05
DELAY_BOUND_S = 1.0


@dataclass(frozen=True)
class Pair:
    """One run both ways; times in s."""

    queue_s: float
    bare_s: float
    queued_to_start_s: float
    exit_to_stored_s: float

    @property
    def ratio(self) -> float:
        """Through the queue over bare."""
        return self.queue_s / self.bare_s


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", default="kiss-icp")
    parser.add_argument("--executor", default="docker", help="through which SLAM Hive runs it")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the recording")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--data", type=Path, help="data root to use; default: a temporary one")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamhive-overhead-") as scratch:
        hive = open_hive({"data": (arguments.data or Path(scratch)).absolute(), "executor": arguments.executor})
        dataset = _dataset(hive, arguments.seconds)
        hive.executors.get(arguments.executor).build(hive.catalogue.package(arguments.algorithm), lambda _line: None)
        pairs = _measure(hive, arguments.algorithm, dataset, arguments.pairs)
        hive.close()
    if arguments.json:
        print(json.dumps([{**asdict(pair), "ratio": pair.ratio} for pair in pairs], indent=1))
    else:
        _print(pairs)


def _dataset(hive: Hive, seconds: float) -> str:
    name = f"room_{seconds:g}s"
    try:
        hive.catalogue.dataset(name)
    except NotFound:
        hive.catalogue.render_room(RoomOptions(name=name, duration_s=seconds, seed=1), lambda _fraction, _text: None)
    return name


def _measure(hive: Hive, algorithm: str, dataset: str, count: int) -> list[Pair]:
    worker = hive.worker()
    thread = threading.Thread(target=worker.run)
    thread.start()
    try:
        warm_up, _ = _through_the_queue(hive, algorithm, dataset)
        pairs = []
        for index in range(count):
            if index % 2:
                bare_s = _bare(hive, warm_up)
                run, queue_s = _through_the_queue(hive, algorithm, dataset)
            else:
                run, queue_s = _through_the_queue(hive, algorithm, dataset)
                bare_s = _bare(hive, warm_up)
            pairs.append(_pair(hive, run, queue_s, bare_s))
        return pairs
    finally:
        worker.stop()
        thread.join()


def _through_the_queue(hive: Hive, algorithm: str, dataset: str) -> tuple[RunRecord, float]:
    """Submit, wait until stored; the run and the wall time (s)."""
    began = time.perf_counter()
    (run,) = hive.runs.submit(Submission(algorithm, dataset, evaluate=False))
    while not hive.runs.get(run.id).state.ended:
        time.sleep(0.01)
    ended = hive.runs.get(run.id)
    if ended.poses is None:
        raise SystemExit(f"run {run.id} is {ended.state}: {ended.detail}")
    return ended, time.perf_counter() - began


def _bare(hive: Hive, model: RunRecord) -> float:
    """The same image, command and mounts, started without SLAM Hive; wall time (s)."""
    spec = spec_from_json(hive.runs.record(model.id)["spec"])
    client = docker.from_env()
    with tempfile.TemporaryDirectory(prefix="slamhive-bare-") as result:
        volumes = {
            **{str(entry.source): {"bind": entry.target, "mode": "ro"} for entry in spec.inputs},
            result: {"bind": spec.output("result").target, "mode": "rw"},
        }
        options: dict[str, Any] = {
            "entrypoint": list(spec.command[:1]),
            "command": list(spec.command[1:]),
            "volumes": volumes,
            "network_mode": "none",
            "environment": {"HOME": "/tmp", **spec.environment},
            "init": True,
        }
        began = time.perf_counter()
        container = client.containers.create(hive.catalogue.package(model.package).image, **options)
        try:
            container.start()
            status = container.wait()["StatusCode"]
        finally:
            container.remove(force=True)
        elapsed_s = time.perf_counter() - began
    if status != 0:
        raise SystemExit(f"the bare container ended with {status}")
    return elapsed_s


def _pair(hive: Hive, run: RunRecord, queue_s: float, bare_s: float) -> Pair:
    events = {event.to_state.value: event.at for event in hive.runs.events(run.id)}
    started, ended = run.started_at or datetime.now(UTC), run.ended_at or datetime.now(UTC)
    return Pair(
        queue_s=queue_s,
        bare_s=bare_s,
        queued_to_start_s=(started - events["queued"]).total_seconds(),
        exit_to_stored_s=(events["succeeded"] - ended).total_seconds(),
    )


def _print(pairs: list[Pair]) -> None:
    print("pair  queue s  bare s  ratio  queued→start s  exit→stored s")
    for number, pair in enumerate(pairs, start=1):
        print(
            f"{number:4d}  {pair.queue_s:7.2f}  {pair.bare_s:6.2f}  {pair.ratio:5.3f}"
            f"  {pair.queued_to_start_s:14.2f}  {pair.exit_to_stored_s:13.2f}"
        )
    ratio = statistics.median(pair.ratio for pair in pairs)
    start_s = statistics.median(pair.queued_to_start_s for pair in pairs)
    stored_s = statistics.median(pair.exit_to_stored_s for pair in pairs)
    print(f"median ratio {ratio:.3f} (bound {RATIO_BOUND}), {_verdict(ratio <= RATIO_BOUND)}")
    print(f"median queued→start {start_s:.2f} s (bound {DELAY_BOUND_S:g} s), {_verdict(start_s <= DELAY_BOUND_S)}")
    print(f"median exit→stored {stored_s:.2f} s (bound {DELAY_BOUND_S:g} s), {_verdict(stored_s <= DELAY_BOUND_S)}")


def _verdict(held: bool) -> str:
    return "held" if held else "NOT held"


if __name__ == "__main__":
    main()
