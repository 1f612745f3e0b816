"""Forks workers that have everything loaded already, so that one begins in milliseconds instead of seconds.

Run as ``python worker_nursery.py LOG``. Each line on standard input asks for one worker, whose pid is the answer: the
settings that it has besides those of the environment, as JSON. It ends when its input does.
"""

from __future__ import annotations

import atexit
import importlib
import json
import logging
import os
import pkgutil
import platform
import signal
import sys
import traceback
from typing import Any

import slamhive.executors
import slamhive.services
from slamhive.services.hive import open_hive
from tests import durability


def main(log: str) -> None:
    """Fork a worker for each line."""
    _load_what_workers_use()
    durability.leave_out(True)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            _become_worker(json.loads(line), log)
        sys.stdout.write(f"{pid}\n")
        sys.stdout.flush()


def _load_what_workers_use() -> None:
    """Use cases load on first use, and Matplotlib for the first plot; each worker would otherwise do that by itself."""
    importlib.import_module("matplotlib.backends.backend_agg")
    for package in (slamhive.services, slamhive.executors):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)


def _become_worker(options: dict[str, Any], log: str) -> None:
    """In the child: work. Never returns."""
    atexit._clear()  # what the parent registered is the parent's
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    code = 1
    try:
        host = options.pop("host", None)
        if host is not None:
            # Workers of two machines: neither can see whether the other lives.
            platform.node = lambda: host
        until_idle = options.pop("until_idle", False)
        logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {os.getpid()} %(name)s %(message)s", force=True)
        hive = open_hive(options)
        hive.worker().run(until_idle=until_idle)
        hive.close()
        atexit._run_exitfuncs()  # as at the end of a worker that was not forked: os._exit leaves it out
        code = 0
    finally:
        if code:
            traceback.print_exc()
        os._exit(code)


if __name__ == "__main__":
    main(sys.argv[1])
