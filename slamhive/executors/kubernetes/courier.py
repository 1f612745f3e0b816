"""Carries the data of a run to its pod, and what it writes back, where nodes share no storage with the worker.

It runs in containers of its own: ``fetch`` before the run, ``report`` beside it. The run is in another container and
has neither the ticket nor the cache. What the run has written is not trusted here: no link is followed, and files are
made in a folder that it does not see. As the supervisor, this module needs no more than Python 3.7 and its standard
library.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from http import HTTPStatus
from pathlib import Path
from typing import Any

from slamhive.base.tree import folder_bytes
from slamhive.executors.kubernetes.pod_files import (
    COURIER_FOLDER,
    DELIVERED_FILE,
    DISK_FILE,
    LOG_FOLDER,
    NODE_VARIABLE,
    OLD_TICKET_EXIT,
    ORDER_FILE,
    OVER_FILE,
    OWN_FOLDER,
    POD_VARIABLE,
    PRIVATE_FOLDER,
    READY_FILE,
    REFUSED_EXIT,
    STARTED_FILE,
    STOP_FILE,
    SUPERVISOR_FILE,
    TICKET_FILE,
    USAGE_FILE,
    WORK_FOLDER,
    write_json,
)
from slamhive.executors.node_store.on_node.cache import CacheFull, Held, Item
from slamhive.executors.node_store.on_node.connection import (
    Away,
    Connection,
    Fetcher,
    NodeRefused,
    WrongContent,
    patiently,
)
from slamhive.executors.node_store.on_node.results import Output, Watched
from slamhive.executors.node_store.on_node.run import (
    VARIANT_FILE,
    Reporter,
    Ticket,
    WrongNode,
    claim,
    deliver,
    hold_items,
    hold_variant,
    make_folders,
    read_made,
    with_offset,
)
from slamhive.executors.process.exit_file import EXIT_FILE

_CLAIMED_FILE = "claimed.json"
_TERMINATION_LOG = Path("/dev/termination-log")
"""What is written here becomes the message of the container's end in Kubernetes."""
_AWAY_EXIT = 74
_CLAIM_PATIENCE_S = 600.0
"""A pod that cannot reach the worker for so long fails, which the worker or the user sees in Kubernetes."""
_LOOK_S = 0.05
_OUTSIDE_GRACE_S = 25.0
"""Who deletes a pod gives it 30 s."""
_DISK_INTERVAL_S = 1.0
_SHARE = 10
"""After each look at the disk, wait this many times as long as it took."""


class PodFolders:
    """The folders of the pod that the courier sees. The run sees ``pod``, ``tmp``, and what is its own."""

    def __init__(self, work: Path) -> None:
        self.pod = work / "pod"
        self.tmp = work / "tmp"
        self.outputs = work / "outputs"
        self.own = work / OWN_FOLDER
        self.private = work / PRIVATE_FOLDER

    def put(self, path: Path, content: bytes) -> None:
        """Write a file where the run can write too, without following a link that it has made there. Raises OSError."""
        aside = self.private / ("." + path.name)
        aside.write_bytes(content)
        os.replace(str(aside), str(path))


def fetch(ticket: Ticket, programs: Path, folders: PodFolders) -> None:
    """Claim the run, and bring everything that it needs to the node. Raises Refused, WrongNode, CacheFull, OSError."""
    connection = ticket.connection()
    claimed = claim(connection, os.environ[POD_VARIABLE], os.environ[NODE_VARIABLE], _CLAIM_PATIENCE_S)
    orders = claimed.orders
    items = {name: claimed.items[name] for name in orders["items"]}
    held: list[Held] = []
    paths = hold_items(ticket, connection, items, held, note_nothing)
    variant = None
    if orders["variant"] is not None:
        variant = {"order": orders["variant"], "source": claimed.items[orders["source"]]._asdict()}
    outputs = [folders.outputs / name for name, _, _ in orders["outputs"]]
    make_folders(folders.pod, folders.tmp, folders.own, folders.private, *outputs)
    for name, copy in orders["own"].items():
        copy_own(paths[name], folders.own / copy)
    folders.put(folders.pod / SUPERVISOR_FILE, (programs / SUPERVISOR_FILE).read_bytes())
    folders.put(folders.pod / ORDER_FILE, json.dumps(orders["order"]).encode())
    if variant is not None:
        held.append(bring_variant(ticket, connection, variant))
        write_json(folders.private / VARIANT_FILE, read_made(held[-1].path))
    known = {name: orders[name] for name in ("outputs", "live")}
    known["variant"] = variant
    known["items"] = {name: item._asdict() for name, item in items.items()}
    known["clock_offset_s"] = claimed.clock_offset_s
    write_json(folders.private / _CLAIMED_FILE, known)


def bring_variant(ticket: Ticket, connection: Connection, variant: dict[str, Any]) -> Held:
    """The variant in the cache, made unless it is there: this image has SLAM Hive. Raises as :func:`fetch`."""
    order, source = variant["order"], Item.of(variant["source"])
    return hold_variant(ticket.open_cache(), order, source, Fetcher(connection), sys.executable, lambda _done: None)


def note_nothing(item: Item, arrived_bytes: int) -> None:
    """Nobody asks how much has arrived."""


def copy_own(source: Path, copy: Path) -> None:
    """Copy an input that the run may change; a copy that was cut off is made again. Raises OSError."""
    if copy.is_dir():
        shutil.rmtree(str(copy))
    if source.is_dir():
        shutil.copytree(str(source), str(copy), symlinks=True)
    else:
        shutil.copyfile(str(source), str(copy))


class CourierReport:
    """Reports a run from its start until its results are at the controller."""

    def __init__(self, ticket: Ticket, folders: PodFolders) -> None:
        self._ticket = ticket
        self._folders = folders
        self._connection = ticket.connection()
        self._claimed: dict[str, Any] = json.loads((folders.private / _CLAIMED_FILE).read_text(encoding="utf-8"))
        self._end_at_s: float | None = None
        self._stop_s: float | None = None
        self._disk_due_s = 0.0

    def run(self) -> None:
        """Until the results are delivered, or the pod is ended. Raises Refused, CacheFull, OSError."""
        signal.signal(signal.SIGTERM, self._end)
        items = {name: Item.of(content) for name, content in self._claimed["items"].items()}
        held: list[Held] = []
        # As long as this process lives.
        hold_items(self._ticket, self._connection, items, held, note_nothing)
        if self._claimed["variant"] is not None:
            held.append(bring_variant(self._ticket, self._connection, self._claimed["variant"]))
        (self._folders.private / READY_FILE).touch()
        reporter = Reporter(self._connection.copy(), self._watched())
        reporter.start()
        while self._goes_on(reporter):
            self._pass_on(reporter)
            if time.monotonic() >= self._disk_due_s:
                began_s = time.thread_time()
                written_bytes = sum(map(folder_bytes, (self._folders.outputs, self._folders.tmp, self._folders.own)))
                # However many files there are, counting them takes a tenth of a processor at most.
                pause_s = _SHARE * (time.thread_time() - began_s)
                self._disk_due_s = time.monotonic() + max(_DISK_INTERVAL_S, pause_s)
                write_json(self._folders.private / DISK_FILE, {"bytes": written_bytes})
            time.sleep(_LOOK_S)
        mirror = reporter.end()
        if reporter.refused is None:
            patiently(mirror.finish, given_up=self._given_up)  # that it has ended, before the results are packed
            last = [Watched(EXIT_FILE, self._folders.pod / EXIT_FILE, change=self._change())]
            try:
                outputs = [
                    Output(name, self._folders.outputs / name, max_bytes, max_files)
                    for name, max_bytes, max_files in self._claimed["outputs"]
                ]
                deliver(self._connection, mirror, self._folders.private, outputs, last, self._given_up)
            except NodeRefused as refused:
                print("the results are not wanted: " + str(refused), file=sys.stderr)
        else:
            print("the run is not wanted: " + reporter.refused, file=sys.stderr)
        self._folders.put(self._folders.pod / DELIVERED_FILE, b"")
        while self._end_at_s is None:
            time.sleep(_LOOK_S)

    def _goes_on(self, reporter: Reporter) -> bool:
        ended = (self._folders.pod / EXIT_FILE).exists()
        if reporter.refused is not None and not ended:
            self._stop(0.0)
        if self._end_at_s is None or ended:
            return not ended
        # Pod and algorithm are asked to end at the same moment. What it saves then belongs to its results.
        return (self._folders.pod / STARTED_FILE).exists() and not self._given_up()

    def _pass_on(self, reporter: Reporter) -> None:
        """Tell the supervisor what the controller wants."""
        grace_s = reporter.wanted.get("stop_s")
        if grace_s is not None:
            self._stop(float(grace_s))

    def _stop(self, grace_s: float) -> None:
        if grace_s != self._stop_s:
            self._folders.put(self._folders.pod / STOP_FILE, str(grace_s).encode())
            self._stop_s = grace_s

    def _watched(self) -> list[Watched]:
        pod, change = self._folders.pod, self._change()
        live = [
            Watched("live/" + output + "/" + name, self._folders.outputs / output / name)
            for output, names in self._claimed["live"].items()
            for name in names
        ]
        return [
            # First: what arrives after an absence of the worker must not look as if the run went on.
            Watched(OVER_FILE, pod / EXIT_FILE, change=change),
            Watched(VARIANT_FILE, self._folders.private / VARIANT_FILE),
            Watched(STARTED_FILE, pod / STARTED_FILE, change=change),
            Watched(USAGE_FILE, pod / USAGE_FILE),
            Watched(LOG_FOLDER, pod / LOG_FOLDER),
            Watched(DISK_FILE, self._folders.private / DISK_FILE),
            *live,
        ]

    def _change(self) -> Any:
        return with_offset(self._claimed["clock_offset_s"])

    def _end(self, *_: object) -> None:
        """The pod is ended from outside, or the run's container has ended."""
        self._end_at_s = time.monotonic() + _OUTSIDE_GRACE_S

    def _given_up(self) -> bool:
        return self._end_at_s is not None and time.monotonic() > self._end_at_s


def explain(words: str) -> None:
    """Leave the reason of a failure where Kubernetes shows it."""
    print(words, file=sys.stderr)
    try:
        _TERMINATION_LOG.write_text(words, encoding="utf-8")
    except OSError:
        return


def main(mode: str) -> int:
    """Do what a container of the courier is there for; its exit code."""
    programs, folders = Path(COURIER_FOLDER), PodFolders(Path(WORK_FOLDER))
    try:
        ticket = Ticket.loads((programs / TICKET_FILE).read_text(encoding="utf-8"))
        if mode == "fetch":
            fetch(ticket, programs, folders)
        else:
            CourierReport(ticket, folders).run()
    except PermissionError as error:
        owner = f"user {os.getuid()}"
        explain(f"{error.filename} of the node cannot be written by {owner}; give the folder to this user")
    except Away as error:
        explain("the worker does not answer at {}: {}; see NODE_URL".format(ticket.url, error))
        return _AWAY_EXIT
    except NodeRefused as error:
        explain(str(error))
        return OLD_TICKET_EXIT if error.status == HTTPStatus.UNAUTHORIZED else REFUSED_EXIT
    except (WrongNode, WrongContent, CacheFull, OSError) as error:
        explain(str(error))
    else:
        return 0
    return REFUSED_EXIT
