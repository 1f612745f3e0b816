"""``--workers N``: run files of tests in processes that are forked when everything is imported.

Importing takes longer than most tests. Processes that each collect for themselves, as those of pytest-xdist do, take
that time once more each. A worker asks for the next file when it is free; what it reports, pytest tells as usual.
"""

from __future__ import annotations

import contextlib
import gc
import os
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import pytest
from _pytest.junitxml import xml_key

Files = list[list[pytest.Item]]

POLL_S = 1.0
"""So often the first process looks whether others may begin."""


@dataclass
class Worker:
    """One process, ``connection`` to it, and ``left``: what it has still to report of its file, by identifier.

    ``begun``: it may ask for files.
    """

    pid: int
    connection: Connection
    begun: bool = False
    left: dict[str, pytest.Item] = field(default_factory=dict)


def pytest_addoption(parser: pytest.Parser) -> None:
    """The number of processes."""
    parser.addoption("--workers", type=int, default=1, metavar="N", help="run files of tests in N processes")
    help_text = "a file with the number of processes that may work; it may grow meanwhile"
    parser.addoption("--workers-now", type=Path, metavar="FILE", help=help_text)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Take the place of pytest's own loop if more than one process is asked for and everything was imported."""
    count = session.config.getoption("workers")
    if count < 2 or session.testsfailed or session.config.option.collectonly:
        return None
    run(session, count)
    return True


def run(session: pytest.Session, count: int) -> None:
    """Run the tests of a session in ``count`` processes, file by file in their order."""
    by_file: dict[Path, list[pytest.Item]] = {}
    for item in session.items:
        by_file.setdefault(item.path, []).append(item)
    files = list(by_file.values())
    workers = start(session, files, min(count, len(files)))
    remaining = iter(range(len(files)))
    allowed: Path | None = session.config.getoption("workers_now")
    try:
        while heard := may_work(workers, allowed):
            patience_s = POLL_S if any(not worker.begun for worker in workers) else None
            connections = {worker.connection: worker for worker in heard}
            for connection in wait(list(connections), patience_s):
                listen(session, connections[connection], files, remaining)  # type: ignore[index]
    finally:
        for worker in workers:
            worker.connection.close()
            with contextlib.suppress(ChildProcessError):
                os.waitpid(worker.pid, 0)
    if session.shouldfail:
        raise session.Failed(session.shouldfail)


def may_work(workers: list[Worker], allowed: Path | None) -> list[Worker]:
    """The processes that may ask for files now: those that have begun, and more if the file ``allowed`` has room."""
    there = sorted((worker for worker in workers if not worker.connection.closed), key=lambda worker: not worker.begun)
    begun = sum(worker.begun for worker in there)
    heard = there if allowed is None else there[: max(1, begun, int(allowed.read_text()))]
    for worker in heard:
        worker.begun = True
    return heard


def start(session: pytest.Session, files: Files, count: int) -> list[Worker]:
    """Fork the workers. Each captures output for itself: forked ones would write over what others have captured."""
    capturing: Any = session.config.pluginmanager.getplugin("capturemanager")
    temporary: Any = session.config._tmp_path_factory  # type: ignore[attr-defined]
    folders = [temporary.mktemp(f"worker{number}", numbered=False) for number in range(count)]
    capturing.stop_global_capturing()
    gc.freeze()  # or the first collection of garbage would touch, and so copy, all that was imported
    workers: list[Worker] = []
    for folder in folders:
        here, there = Pipe()
        pid = os.fork()
        if pid == 0:
            here.close()
            for other in workers:
                other.connection.close()
            temporary._basetemp = folder
            capturing.start_global_capturing()
            capturing.suspend_global_capture()
            work(session, files, there)
        there.close()
        workers.append(Worker(pid, here))
    capturing.start_global_capturing()
    capturing.suspend_global_capture()
    return workers


def listen(session: pytest.Session, worker: Worker, files: Files, remaining: Iterator[int]) -> None:
    """Answer a request for the next file, pass a report on, or note that a worker has ended."""
    hook = session.config.hook
    try:
        said = worker.connection.recv()
        if said is None:
            number = None if session.shouldfail or session.shouldstop else next(remaining, None)
            worker.connection.send(number)
            worker.left |= {} if number is None else {item.nodeid: item for item in files[number]}
            return
    except (EOFError, ConnectionError):
        worker.connection.close()
        _, status = os.waitpid(worker.pid, 0)
        for item in () if session.shouldfail or session.shouldstop else worker.left.values():
            words = f"its process ended with {os.waitstatus_to_exitcode(status)} before it had reported this test"
            hook.pytest_runtest_logreport(
                report=pytest.TestReport(item.nodeid, item.location, {}, "failed", words, "call")
            )
        return
    nodeid, location, reports = said
    hook.pytest_runtest_logstart(nodeid=nodeid, location=location)
    for report in reports:
        hook.pytest_runtest_logreport(report=report)
    hook.pytest_runtest_logfinish(nodeid=nodeid, location=location)
    worker.left.pop(nodeid, None)


def work(session: pytest.Session, files: Files, connection: Connection) -> None:
    """Run the files that are handed out. Ends the process."""
    code = 1
    try:
        plugins = session.config.pluginmanager
        for reporter in (plugins.getplugin("terminalreporter"), session.config.stash.get(xml_key, None)):
            if reporter is not None:
                plugins.unregister(reporter)
        plugins.register(Telling(connection))
        items = handed_out(files, connection)
        item = next(items, None)
        while item is not None:
            following = next(items, None)  # what no test needs any more is torn down
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            item = None if session.shouldfail else following
        code = 0
    except KeyboardInterrupt:
        pass  # the first process says so
    except Exception:  # noqa: BLE001 - nothing else would tell what happened
        traceback.print_exc()
    finally:
        os._exit(code)


def handed_out(files: Files, connection: Connection) -> Iterator[pytest.Item]:
    """The tests of one file after the other; the next file is asked for when its first test is wanted."""
    while True:
        connection.send(None)
        number = connection.recv()
        if number is None:
            return
        yield from files[number]


class Telling:
    """Sends what a worker reports of each test."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._reports: list[pytest.TestReport] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep a report of a step until its test has ended."""
        self._reports.append(report)

    def pytest_runtest_logfinish(self, nodeid: str, location: tuple[str, int | None, str]) -> None:
        """Send the reports of a test."""
        self._connection.send((nodeid, location, self._reports))
        self._reports = []
