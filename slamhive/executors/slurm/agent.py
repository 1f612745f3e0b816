"""The first process of a job on a node that shares no files with the worker: ``... slurm.agent (run|deliver)``.

It reads a ticket from its standard input, fetches what the run needs, starts the same two processes as other jobs
(:mod:`slamhive.executors.slurm.node`), reports what they write, and delivers the results. A run lies in
``<cache>/runs/<key>/<job>/`` until it was delivered. What a job has to leave there, a later job on the node delivers.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import slamhive
from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import SlamHiveError
from slamhive.base.files import write_aside
from slamhive.base.tree import folder_bytes, remove_tree
from slamhive.documents.model import adapter
from slamhive.executors.base import ExecutorContext
from slamhive.executors.node_store.controller import item_name, live_place
from slamhive.executors.node_store.on_node.cache import CacheFull, Held, Item
from slamhive.executors.node_store.on_node.connection import Away, Connection, Fetcher, NodeRefused, WrongContent
from slamhive.executors.node_store.on_node.results import Mirror, Output, Watched
from slamhive.executors.node_store.on_node.run import (
    BAG,
    VARIANT_FILE,
    Claimed,
    Reporter,
    Ticket,
    WrongNode,
    claim,
    deliver,
    hold_items,
    hold_variant,
    holding,
    make_folders,
    read_made,
    remove_run,
    sweep_runs,
    with_offset,
    words_of,
)
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.shim import IDENTITY_FILE
from slamhive.executors.process.supervisor import OUTPUT_FOLDER
from slamhive.executors.slurm.containers import give_container_orders
from slamhive.executors.slurm.image_folders import ImageFolder
from slamhive.executors.slurm.jobs import ERRORS_FILE
from slamhive.executors.slurm.node import PLACE_FILE, USAGE_FILE
from slamhive.executors.spec import RECORDING, RunSpec
from slamhive.packages.dataset_file import DATASET_FILE

PROGRESS_FILE = "progress.json"
GONE_FILE = "gone.json"
IMAGE = "image"
FETCHING, RUNNING, DELIVERING = "fetching", "running", "delivering"
_CLAIM_PATIENCE_S = 600.0
_STEP_S = 0.05
_COUNT_S = 1.0
_FAILED = 1
_PROBLEMS = (WrongNode, WrongContent, CacheFull, NodeRefused, Away, OSError, SlamHiveError)


class _Ended(Exception):
    """Somebody ended the job before the algorithm was started."""


class RunOnNode:
    """One run of this job."""

    def __init__(self, ticket: Ticket, connection: Connection, folder: Path, claimed: Claimed) -> None:
        self._ticket, self._connection, self._folder = ticket, connection, folder
        self._orders, self._items = claimed.orders, claimed.items
        self._spec = _relocated(adapter(RunSpec).validate_python(claimed.orders["spec"]), folder)
        self._reporter = Reporter(ticket.connection(), watched_files(self._spec, claimed.clock_offset_s))
        self._offset_s = claimed.clock_offset_s
        self._supervisor: subprocess.Popen[bytes] | None = None
        self._written_bytes = 0

    def go(self) -> int:
        """From the data to the delivery; the exit code of the job."""
        held: list[Held] = []
        for number in (signal.SIGTERM, signal.SIGUSR1):
            signal.signal(number, self._pass_on)
        self._reporter.start()
        try:
            self._progress(FETCHING)
            order = self._orders["spec"].get("variant")
            source = self._items.pop(item_name(RECORDING)) if order else None
            paths = hold_items(self._ticket, self._connection, self._items, held, self._arrived)
            if source is not None:
                fetch = Fetcher(self._connection, progress=self._arrived)

                def made(done: float) -> None:
                    self._progress(FETCHING, f"{words_of(order)}: {100 * done:.0f} % is made")

                held.append(hold_variant(self._ticket.open_cache(), order, source, fetch, sys.executable, made))
                folder, known = held[-1].path, read_made(held[-1].path)
                write_aside(self._spec.work / VARIANT_FILE, json.dumps(known))
                paths |= {item_name(RECORDING): folder / known[BAG], item_name(DATASET_FILE): folder / DATASET_FILE}
            self._give_orders(paths)
            work = self._spec.work
            program = [sys.executable, "-m", "slamhive.executors.slurm.node"]
            asked = ["gpu"] if self._spec.asks_gpu else []
            with (work / ERRORS_FILE).open("ab") as errors:
                measuring = subprocess.Popen([*program, "measure", str(work)], stdin=subprocess.DEVNULL, stderr=errors)
                self._supervisor = subprocess.Popen(
                    [*program, "supervise", str(work), *asked], stdin=subprocess.DEVNULL, stdout=errors, stderr=errors
                )
            count_at_s = 0.0
            while self._supervisor.poll() is None:
                if self._reporter.refused is not None:
                    self._supervisor.send_signal(signal.SIGUSR1)  # nobody wants the run any more
                if monotonic_s() >= count_at_s:
                    self._written_bytes = sum(map(folder_bytes, _written(self._spec)))
                    self._progress(RUNNING)
                    count_at_s = monotonic_s() + _COUNT_S
                time.sleep(_STEP_S)
            measuring.terminate()
            measuring.wait()
            return self._deliver()
        finally:
            self._reporter.end()
            for entry in held:
                entry.release()

    def _give_orders(self, paths: dict[str, Path]) -> None:
        inputs = tuple(replace(entry, source=paths[item_name(entry.name)]) for entry in self._spec.inputs)
        spec = replace(self._spec, inputs=inputs)
        environment, place = self._orders["image"]["environment"], paths[IMAGE]
        image = ImageFolder(place, environment, {}, sif=place if place.is_file() else None)
        context = ExecutorContext(
            self._folder,
            self._folder,
            self._orders["installation"],
            self._orders["log_max_bytes"],
            options=self._orders["options"],
        )
        give_container_orders(spec, image, spec.work, context)

    def _deliver(self) -> int:
        mirror = self._reporter.end()
        if self._reporter.refused is not None:
            remove_run(self._folder)
            return _FAILED
        if not (self._spec.work / EXIT_FILE).exists():
            if (self._spec.work / IDENTITY_FILE).exists():
                _say_gone(self._connection, self._spec.work, f"the supervisor was killed on node {_node()}")
            mirror.finish()  # else it says why it did not start
            remove_run(self._folder)
            return _FAILED
        self._progress(DELIVERING)
        deliver_run(self._connection, mirror, self._folder, self._spec, self._offset_s)
        return 0

    def _arrived(self, item: Item, size_bytes: int) -> None:
        self._progress(FETCHING, f"{item.words}: {size_bytes / 1e6:.0f} of {item.size_bytes / 1e6:.0f} MB")

    def _progress(self, phase: str, words: str = "") -> None:
        path = self._spec.work / PROGRESS_FILE
        aside = path.with_name(f".{path.name}")
        as_of_s = utc_now().timestamp() + self._offset_s
        content = {"phase": phase, "words": words, "as_of_s": as_of_s, "written_bytes": self._written_bytes}
        aside.write_text(json.dumps(content))
        aside.replace(path)

    def _pass_on(self, number: int, _frame: FrameType | None) -> None:
        if self._supervisor is None:
            raise _Ended
        self._supervisor.send_signal(number)


def run(ticket: Ticket) -> int:
    """Execute the run of the ticket; the exit code of the job."""
    connection, folder = ticket.connection(), ticket.run_folder / _job()
    work = folder / "work"
    try:
        make_folders(work)
        with holding(folder):
            sweep_runs(ticket)
            claimed = _claim(connection)
            return RunOnNode(ticket, connection, folder, claimed).go()
    except _Ended:
        remove_run(folder)
    except _PROBLEMS as error:
        print(error, file=sys.stderr)  # noqa: T201 - for who looks at the job itself
        _say(connection, work, str(error))
        if not (work / EXIT_FILE).exists() or (isinstance(error, NodeRefused) and error.over):
            remove_run(folder)
    return _FAILED


def bring(ticket: Ticket) -> int:
    """Deliver what an earlier job of the run has left on this node; the exit code of the job."""
    connection = ticket.connection()
    claimed = _claim(connection)
    left = sorted(ticket.run_folder.glob(f"*/work/{EXIT_FILE}"))
    if not left:
        make_folders(ticket.run_folder)
        _say_gone(connection, ticket.run_folder, f"node {_node()} does not have its results")
        remove_tree(ticket.run_folder)
        return _FAILED
    folder = left[-1].parent.parent
    with holding(folder):
        spec = _relocated(adapter(RunSpec).validate_python(claimed.orders["spec"]), folder)
        mirror = Mirror(connection, watched_files(spec, claimed.clock_offset_s))
        deliver_run(connection, mirror, folder, spec, claimed.clock_offset_s)
    return 0


def deliver_run(connection: Connection, mirror: Mirror, folder: Path, spec: RunSpec, offset_s: float) -> None:
    """Deliver the run that lies in ``folder``, and remove it from the node. Raises Refused, OSError."""
    outputs = [Output(output.name, output.destination, output.max_bytes, output.max_files) for output in spec.outputs]
    last = [Watched(EXIT_FILE, spec.work / EXIT_FILE, change=with_offset(offset_s))]
    deliver(connection, mirror, folder, outputs, last)
    remove_run(folder)


def watched_files(spec: RunSpec, offset_s: float) -> list[Watched]:
    """Return the files of this node that the controller has copies of."""
    work, change = spec.work, with_offset(offset_s)
    live = [
        Watched(live_place(output.name, name), output.destination / name, 0.2)
        for output in spec.outputs
        for name in output.live
    ]
    return [
        Watched(VARIANT_FILE, work / VARIANT_FILE),
        Watched(PLACE_FILE, work / PLACE_FILE),
        Watched(IDENTITY_FILE, work / IDENTITY_FILE, change=change),
        Watched(USAGE_FILE, work / USAGE_FILE),
        Watched(PROGRESS_FILE, work / PROGRESS_FILE, 0.2),
        Watched(ERRORS_FILE, work / ERRORS_FILE, 1.0),
        Watched(OUTPUT_FOLDER, work / OUTPUT_FOLDER, 0.2),
        *live,
    ]


def _claim(connection: Connection) -> Claimed:
    claimed = claim(connection, f"job {_job()}", _node(), _CLAIM_PATIENCE_S)
    version = claimed.orders["version"]
    if version != slamhive.__version__:
        raise WrongNode(
            f"node {_node()} has SLAM Hive {slamhive.__version__}, the worker has {version}; install the same version "
            f"on all nodes, and name its Python by SLURM_PYTHON"
        )
    return claimed


def _relocated(spec: RunSpec, folder: Path) -> RunSpec:
    """The specification with the places that its folders have on this node; those of the inputs follow."""
    outputs = tuple(replace(output, destination=folder / "outputs" / output.name) for output in spec.outputs)
    return replace(spec, outputs=outputs, work=folder / "work", package_folder=folder)


def _written(spec: RunSpec) -> Iterator[Path]:
    """Where the run writes."""
    yield from (output.destination for output in spec.outputs)
    yield spec.work / "tmp"


def _say(connection: Connection, work: Path, words: str) -> None:
    """Let the controller know in the last line why the job fails."""
    with contextlib.suppress(NodeRefused, Away, OSError):
        with (work / ERRORS_FILE).open("a") as stream:
            stream.write(f"{words}\n")
        Mirror(connection, [Watched(ERRORS_FILE, work / ERRORS_FILE)]).finish()


def _say_gone(connection: Connection, folder: Path, why: str) -> None:
    """Let the controller know that nobody knows how the run ended."""
    (folder / GONE_FILE).write_text(json.dumps({"why": why}))
    Mirror(connection, [Watched(GONE_FILE, folder / GONE_FILE)]).finish()


def _job() -> str:
    return os.environ.get("SLURM_JOB_ID", "0")


def _node() -> str:
    return os.environ.get("SLURMD_NODENAME") or platform.node()


def main(purpose: str, text: str) -> int:
    """Do what the job is for; its exit code."""
    actions: dict[str, Any] = {"run": run, "deliver": bring}
    code: int = actions[purpose](Ticket.loads(text))
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.stdin.read()))
