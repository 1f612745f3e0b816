"""An installation with the hostile algorithm: its server and worker as processes, and what is measured around a run."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from slamhive.base.tree import walk
from slamhive.documents.submission import Submission
from slamhive.services.hive import Hive, open_hive
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord
from tests.end_to_end.hostile.mapping import ACTS, TRAJECTORIES
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.waiting import eventually

CHECKOUT = Path(__file__).resolve().parents[3]
PACKAGE = "hostile"
DISK_MB = 150
FILES = 3_000
MEMORY_MB = 300
LOG_BYTES = 1_000_000
LOG_MB = int(os.environ.get("SLAMHIVE_HOSTILE_LOG_MB", "500"))
TASKS = 100
GRACE_S = 1.0
_SETTINGS = {
    "run_disk_mb": str(DISK_MB),
    "run_files": str(FILES),
    "run_memory_mb": str(MEMORY_MB),
    "run_pids": str(TASKS),
    "log_max_bytes": str(LOG_BYTES),
    "stop_grace_s": str(GRACE_S),
}
_LOOK_INTERVAL_S = 0.2
_ANSWER_LIMIT_S = 60.0
OK = 200
ENDED = (EvaluationState.SUCCEEDED, EvaluationState.FAILED)

_ALGORITHM = f"""
format: 1
package: {PACKAGE}
title: Hostile algorithm
version: "1"
upstream: https://example.invalid/hostile
licence: GPL-3.0-or-later
citation: none
resources: {{cpu_cores: 1, memory_mb: {MEMORY_MB}}}
modes:
  lidar:
    title: Hostile algorithm
    setup: lidar
    inputs: {{points: lidar}}
    trajectory_role: points
parameters:
  act: {{type: enum, default: endless, choices: [{", ".join([*ACTS, *TRAJECTORIES])}], help: What it does.}}
  log_mb: {{type: int, default: 1, minimum: 1, maximum: 5000, unit: MB, help: How much it prints.}}
  port: {{type: int, default: 1, minimum: 1, maximum: 65535, help: Where its host has a server.}}
"""
_DOCKERFILE = """
FROM slam-hive-test:base
COPY package/slamhive /slamhive
RUN mkdir -p /slamhive/dataset /slamhive/result && touch /slamhive/config.yaml
CMD ["python3", "/slamhive/mapping.py"]
"""


@dataclass
class Answers:
    """How long the host took to answer, a few times a second."""

    slowest_s: float = 0.0
    slowest: str = ""
    count: int = 0

    def note(self, what: str, took_s: float) -> None:
        self.count += 1
        if took_s > self.slowest_s:
            self.slowest_s, self.slowest = took_s, what


@dataclass(frozen=True)
class Row:
    """What came of one act on one executor."""

    act: str
    executor: str
    run: RunRecord
    seconds: float
    processes_left: list[str]
    containers_left: list[str]
    left_bytes: int
    left_files: int
    answers: Answers

    @property
    def ending(self) -> str:
        """State, and the reason of a failure."""
        return self.run.state.value if self.run.reason is None else f"{self.run.state.value}: {self.run.reason.value}"


@dataclass
class Bench:
    """One installation, served, with a worker."""

    root: Path
    hive: Hive
    port: int
    rows: list[Row] = field(default_factory=list)

    def perform(self, act: str, executor: str, timeout_s: float = 90.0, *, evaluate: bool = False) -> Row:
        """Run the act to its end and measure; what is left is looked at once the worker has let go of the run."""
        submission = Submission(
            PACKAGE,
            "track",
            {"act": act, "port": self.port, "log_mb": LOG_MB},
            executor=executor,
            evaluate=evaluate,
            timeout_s=timeout_s,
        )
        (asked,) = self.hive.runs.submit(submission)
        answers = Answers()
        with self._watched(asked.id, answers):
            eventually(lambda: self.hive.runs.get(asked.id).state.ended, f"the end of {act} on {executor}", 300)
            folder = self.hive.runs.folder(asked.id)
            # The outcome is stored before the rest is tidied up.
            eventually(lambda: not folder.work.exists() and not containers_of(asked.uid), "tidying up", 60)
        run = self.hive.runs.get(asked.id)
        sizes = [(entry.status.st_size, entry.status.st_blocks * 512) for entry in walk(folder.root)]
        row = Row(
            act=act,
            executor=executor,
            run=run,
            seconds=self._seconds(run),
            processes_left=processes_of(self.root, run),
            containers_left=containers_of(run.uid),
            left_bytes=sum(max(pair) for pair in sizes),
            left_files=len(sizes),
            answers=answers,
        )
        self.rows.append(row)
        return row

    def _seconds(self, run: RunRecord) -> float:
        """From the start of the algorithm until its outcome was stored."""
        assert run.started_at is not None
        return (self.hive.runs.events(run.id)[-1].at - run.started_at).total_seconds()

    def get(self, path: str) -> tuple[int, str]:
        """Status and text of a page."""
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=_ANSWER_LIMIT_S)) as connection:
            connection.request("GET", path)
            answer = connection.getresponse()
            return answer.status, answer.read().decode("utf-8", errors="replace")

    def look_at_pages(self, run_id: int) -> None:
        """Open all that is shown of a run; fails unless each answers, and without its markup."""
        address = f"/runs/{run_id}"
        status, page = self.get(address)
        assert status == OK, page[-2000:]
        removed = re.search(r"removed from its result: .*", self.hive.runs.get(run_id).detail or "")
        assert removed is None or removed[0][1:] in outcome_of(page)
        files = sorted(set(re.findall(rf'href="({address}/files/[^"]+)"', page)))
        for path in (f"{address}/figures.json", f"/api/v1{address}", "/runs", *files):
            status, text = self.get(path)
            assert status == OK, f"{path}: {text[-2000:]}"
        for text in (page, self.get("/runs")[1]):
            assert "<script>alert" not in text
            assert "<img src=x" not in text

    def evaluation(self, run_id: int) -> EvaluationRecord:
        """The evaluation of a run, once it has ended. It is requested a moment after the run has ended."""

        def ended() -> list[EvaluationRecord]:
            return [e for e in self.hive.evaluations.of_run(run_id) if e.state in ENDED]

        eventually(lambda: bool(ended()), "the evaluation")
        (found,) = ended()
        return found

    def dataset(self) -> dict[str, bytes]:
        """The dataset's files."""
        return {path.name: path.read_bytes() for path in (self.root / "data" / "datasets" / "track").iterdir()}

    @contextmanager
    def _watched(self, run_id: int, answers: Answers) -> Iterator[None]:
        """Ask the host small things while the block goes on, each timed by itself."""
        ends = threading.Event()
        questions: dict[str, Callable[[], object]] = {
            "overview": lambda: self.get("/"),
            "run page": lambda: self.get(f"/runs/{run_id}"),
            "store": self._count_runs,
            "stat": self.hive.runs.folder(run_id).root.parent.stat,
        }

        def ask() -> None:
            while not ends.wait(_LOOK_INTERVAL_S):
                for what, question in questions.items():
                    began_s = time.monotonic()
                    question()
                    answers.note(what, time.monotonic() - began_s)

        thread = threading.Thread(target=ask, name="host", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ends.set()
            thread.join()

    def _count_runs(self) -> int:
        with closing(sqlite3.connect(self.hive.settings.data / "slamhive.db", timeout=_ANSWER_LIMIT_S)) as database:
            return int(database.execute("select count(*) from runs").fetchone()[0])


@contextmanager
def open_bench(root: Path, database: Path) -> Iterator[Bench]:
    """Make the installation, start its server with a worker, and end both.

    Args:
        root: A folder for everything.
        database: A SQLite file with tables to copy.
    """
    make_project(root / "project")
    (root / "project" / "docker").symlink_to(CHECKOUT / "docker")
    (root / "project" / "static").symlink_to(CHECKOUT / "static")
    (root / "project" / "templates").rmdir()
    (root / "project" / "templates").symlink_to(CHECKOUT / "templates")
    package = root / "project" / "algorithms" / PACKAGE
    (package / "slamhive").mkdir(parents=True)
    shutil.copy(Path(__file__).with_name("mapping.py"), package / "slamhive")
    (package / "algorithm.yaml").write_text(_ALGORITHM)
    (package / "requirements.txt").write_text("")
    (package / "Dockerfile").write_text(_DOCKERFILE)
    make_dataset(root / "data")
    shutil.copy(database, root / "data" / "slamhive.db")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    variables = environment(root / "project", root / "data", **_SETTINGS)
    before = dict(os.environ)
    os.environ.update(variables)
    with (root / "server.txt").open("wb") as output:
        server = subprocess.Popen(
            [sys.executable, "-m", "slamhive", "serve", "--port", str(port)],
            env=variables,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    hive = open_hive()
    bench = Bench(root, hive, port)
    try:
        eventually(lambda: _answers(port) and hive.worker_alive(), "the server with its worker")
        yield bench
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(30)
        hive.close()
        os.environ.clear()
        os.environ.update(before)
        if shutil.which("docker") is not None:
            subprocess.run(["docker", "rmi", f"slam-hive-algorithm:{PACKAGE}"], capture_output=True, check=False)


def _answers(port: int) -> bool:
    with socket.socket() as there:
        return there.connect_ex(("127.0.0.1", port)) == 0


def containers_of(uid: str) -> list[str]:
    """Containers of the run with this uid, in whatever state; none where there is no Docker."""
    if shutil.which("docker") is None:
        return []
    found = subprocess.run(
        ["docker", "ps", "--all", "--quiet", "--filter", f"label=slamhive.key={uid}"],
        capture_output=True,
        text=True,
        check=False,
    )
    return found.stdout.split()


def processes_of(root: Path, run: RunRecord) -> list[str]:
    """Command lines of what lives of a run: in its container, or with a path of its folder or package."""
    marks = [str(root / "project" / "algorithms"), str(root / "data" / "runs" / str(run.id))]
    container = ((run.handle or {}).get("data") or {}).get("container")
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            line = " ".join(process.cmdline())
            groups = Path(f"/proc/{process.pid}/cgroup").read_text() if container else ""
            if any(mark in line for mark in marks) or (container and container in groups):
                found.append(line)
    return found


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table."""
    head = (
        "| act | executor | ended as | after | processes | containers | left | slowest answer |\n"
        "|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(
        f"| {row.act} | {row.executor} | {row.ending} | {row.seconds:.1f} s | {len(row.processes_left)} "
        f"| {len(row.containers_left)} | {row.left_bytes / 1e6:.2f} MB in {row.left_files} "
        f"| {row.answers.slowest_s:.2f} s ({row.answers.slowest}) |\n"
        for row in sorted(rows, key=lambda row: (row.act, row.executor))
    )


def outcome_of(page: str) -> str:
    """The sentence at the head of a run's page: a line of its own, or with the title for a run that succeeded."""
    found = re.search(r'<p class="outcome[^>]*>(.*?)</p>|<span>(Succeeded.*?)</span>', page, re.DOTALL)
    assert found is not None
    return found[1] or found[2]
