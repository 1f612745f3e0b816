"""``slamhive worker``, ``slamhive serve``, ``slamhive demo``."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType

import click

from slamhive.base.settings import Mode
from slamhive.cli.context import CliContext, pass_cli
from slamhive.cli.demo import run_demo
from slamhive.cli.output import tell
from slamhive.services.accounts import LOOPBACK_HOSTS, accounts_needed
from slamhive.services.hive import Hive
from slamhive.services.worker import WorkerProcess

STAND_BY_S = 1.0


@click.command("worker")
@click.option("--slots", type=int, help="Runs at a time; each slot has its own cores.")
@click.option("--until-idle", is_flag=True, help="Stop when the queue is empty.")
@click.option("--patient", is_flag=True, help="If a worker is running, wait and take over when it stops.")
@pass_cli
def worker_command(cli: CliContext, slots: int | None, until_idle: bool, patient: bool) -> None:
    """Run queued runs and evaluate them. Ctrl-C stops the worker; active runs continue and are found again."""
    cli.options_with(worker_slots=slots)
    logging.getLogger("slamhive").setLevel(logging.INFO)
    hive = cli.hive()
    worker = hive.worker()

    stopped = threading.Event()

    def stop(_signal: int, _frame: FrameType | None) -> None:
        stopped.set()
        worker.stop()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    _, reason = hive.executors.default()
    tell(f"worker {worker.owner}: {hive.settings.worker_slots} slot(s), executor {reason}")
    while patient and not stopped.is_set() and hive.worker_alive():
        stopped.wait(STAND_BY_S)
    if not stopped.is_set():
        worker.run(until_idle=until_idle)


@click.command("serve")
@click.option("--host", help="Address to bind to; default 127.0.0.1.")
@click.option("--port", type=int, help="Port to bind to; default 5000.")
@click.option("--worker/--no-worker", "with_worker", default=True, show_default=True, help="Also start a worker.")
@pass_cli
def serve_command(cli: CliContext, host: str | None, port: int | None, with_worker: bool) -> None:
    """Serve the web pages, and start a worker unless one is running."""
    cli.options_with(host=host, port=port)
    logging.getLogger("slamhive").setLevel(logging.WARNING)
    hive = cli.hive()
    serve_until_stopped(cli, with_worker=with_worker and hive.settings.mode is not Mode.VIEW_ONLY)


def serve_until_stopped(cli: CliContext, *, with_worker: bool) -> None:
    """Serve the web pages in this process; a worker, if asked for and none runs, in a process of its own."""
    from slamhive.web.serve import WebServer  # noqa: PLC0415 - Flask and plotly take a second that others save

    hive = cli.hive()
    server = WebServer(hive, hive.settings.host, hive.settings.port)
    with WorkerProcess(hive.settings, wanted=with_worker):
        tell(f"serving {server.url} (Ctrl-C ends)")
        tell(who_may_use(hive))
        server.run()


def who_may_use(hive: Hive) -> str:
    """One line that says who may use the pages, and how the first account is made."""
    settings = hive.settings
    if settings.mode is Mode.VIEW_ONLY:
        return "view-only: everybody who reaches this server may look, and nobody may change anything"
    if accounts_needed(settings, settings.host):
        if hive.accounts.exist():
            return "callers sign in, see docs/accounts.md"
        return "callers sign in, and nobody has an account yet: slamhive account add NAME --role admin adds the first"
    if settings.host in LOOPBACK_HOSTS:
        return "users of this machine may do everything, without signing in"
    return "AUTH = none: everybody who reaches this server may start, change and delete runs"


@click.command("demo")
@click.option("--serve/--no-serve", "serving", default=True, show_default=True, help="Serve the web pages afterwards.")
@click.option("--seconds", type=float, default=15.0, show_default=True, help="Duration of the recording in s.")
@pass_cli
def demo_command(cli: CliContext, serving: bool, seconds: float) -> None:
    """Render the room, run three SLAM systems on it, evaluate, print a table, serve the pages."""
    run_demo(cli.hive(), seconds)
    if serving:
        serve_until_stopped(cli, with_worker=True)


COMMANDS = (worker_command, serve_command, demo_command)
