"""A run on a node: claimed, given its data, reported while it goes on, and delivered when it is over."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import subprocess
import threading
import time
from datetime import datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Sequence

from slamhive.base.tree import remove_tree
from slamhive.executors.node_store.on_node.cache import MADE, Cache, Fetch, Held, Item, hold_all
from slamhive.executors.node_store.on_node.connection import (
    Away,
    Connection,
    Fetcher,
    NodeRefused,
    Progress,
    clock_offset,
    patiently,
)
from slamhive.executors.node_store.on_node.results import (
    RESULT_FILE,
    Mirror,
    Output,
    Watched,
    pack_results,
    send_results,
)

ARCHITECTURE = "architecture"
_ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "arm", "i686": "386", "ppc64le": "ppc64le"}
_LOCK_FILE = "run.lock"
_KEPT_S = 7 * 86400.0
_LOOK_S = 0.05
_ASK_S = 1.0
_TIMES_S, _TIMES_ISO = ("started_s", "ended_s"), ("started_at", "ended_at")


class WrongNode(Exception):
    """This node cannot have the run."""


class Ticket(NamedTuple):
    """The orders with which a node begins. Whoever starts it hands it over as JSON, by a way that others cannot read.

    Attributes:
        url: The address of the controller.
        key: The run.
        token: Valid for this run only.
        cache: The folder of the cache on the node.
        cache_bytes: Its limit.
    """

    url: str
    key: str
    token: str
    cache: str
    cache_bytes: int

    @classmethod
    def loads(cls, text: str) -> Ticket:
        """From JSON. Raises ValueError, TypeError."""
        return cls(**json.loads(text))

    def connection(self) -> Connection:
        """To the controller."""
        return Connection(self.url, self.key, self.token)

    def open_cache(self) -> Cache:
        """The cache of this node."""
        return Cache(Path(self.cache), self.cache_bytes)

    @property
    def run_folder(self) -> Path:
        """Where the run lies on the node until its results were delivered."""
        return Path(self.cache) / "runs" / "".join(c if c.isalnum() or c in "-_" else "_" for c in self.key)


class Claimed(NamedTuple):
    """The answer of the controller to a node that claimed a run.

    Attributes:
        orders: What the engine wants on the node.
        items: What the run needs, by name.
        clock_offset_s: What to add to the clock of the node to have the controller's.
    """

    orders: Dict[str, Any]
    items: Dict[str, Item]
    clock_offset_s: float


def claim(
    connection: Connection,
    holder: str,
    node: str,
    patience_s: Optional[float] = None,
    clock: Callable[[], float] = time.time,
) -> Claimed:
    """Claim the run. Raises Refused, Away, and WrongNode if the image is made for another architecture.

    Args:
        connection: To the controller.
        holder: Identifies the job or pod: nobody else gets the run. The same one may ask again.
        node: The name of the node.
        patience_s: For how long the controller may be away.
        clock: Seconds since 1970 on this node.
    """
    answer = {}  # type: Dict[str, Any]

    def ask() -> Dict[str, Any]:
        said = {"holder": holder, "node": node, ARCHITECTURE: architecture(), "node_time_s": repr(clock())}
        answer.update(connection.ask("POST", "claim", json.dumps(said).encode()))
        return answer

    offset_s = patiently(lambda: clock_offset(ask, clock), patience_s)
    orders = answer["orders"]
    wanted = orders.get(ARCHITECTURE)
    if wanted and wanted != architecture():
        raise WrongNode(
            "the image is made for {}, but node {} is {}; choose nodes of one architecture, or build the image for "
            "both".format(wanted, node, architecture())
        )
    return Claimed(orders, {name: Item.of(content) for name, content in answer["items"].items()}, offset_s)


def architecture() -> str:
    """The architecture of this node, as images name it."""
    machine = platform.machine()
    return _ARCHITECTURES.get(machine, machine)


def hold_items(
    ticket: Ticket, connection: Connection, items: Dict[str, Item], held: List[Held], progress: Progress
) -> Dict[str, Path]:
    """The paths of the items in the cache, fetched unless they are there. ``held`` has to be released in the end.

    Raises Refused, WrongContent, CacheFull, OSError.
    """
    cache = ticket.open_cache()
    found = hold_all(cache, items, Fetcher(connection, progress=progress), held)
    said = {"used_bytes": cache.used_bytes(), "limit_bytes": ticket.cache_bytes}
    with contextlib.suppress(Away):
        connection.ask("PUT", "cache", json.dumps(said).encode())
    return found


class Reporter:
    """Reports what a run writes, from a thread of its own, until :meth:`end`.

    Args:
        connection: Used by the thread alone.
        watched: What the controller has copies of.

    Attributes:
        wanted: What the controller wants of the run: empty, or ``{"stop_s": grace}``.
        refused: The controller's words if it does not want the run any more.
    """

    def __init__(self, connection: Connection, watched: List[Watched]) -> None:
        self._mirror = Mirror(connection, watched)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._report, name="reporter", daemon=True)
        self.wanted = {}  # type: Dict[str, Any]
        self.refused = None  # type: Optional[str]

    def start(self) -> None:
        """Begin to report."""
        self._thread.start()

    def end(self) -> Mirror:
        """Stop reporting; the mirror, which knows what has been sent."""
        self._ending.set()
        self._thread.join()
        return self._mirror

    def _report(self) -> None:
        asked_s = time.monotonic()
        while not self._ending.wait(_LOOK_S):
            try:
                self._mirror.look()
                if time.monotonic() - asked_s >= _ASK_S:
                    asked_s = time.monotonic()
                    self._mirror.ask()
            except Away:
                continue
            except NodeRefused as refused:
                self.refused = str(refused)
                return
            self.wanted = self._mirror.wanted


def deliver(
    connection: Connection,
    mirror: Mirror,
    folder: Path,
    outputs: Sequence[Output],
    last: Sequence[Watched],
    given_up: Callable[[], bool] = lambda: False,
) -> None:
    """Bring all that a run has left to the controller: its files, its outputs, and how it ended as the last word.

    Waits for the controller for as long as it takes. Can be done again, by another process too. Raises Refused,
    OSError, and Away once ``given_up``.

    Args:
        connection: To the controller.
        mirror: Of the files that were reported meanwhile.
        folder: The run on this node; the archive of the outputs is kept there.
        outputs: What the run has written.
        last: What says how the run ended; the controller takes the run for over when it has these.
        given_up: Whether to end although not everything has arrived.
    """
    archive = folder / RESULT_FILE
    if not archive.exists():
        pack_results(list(outputs), archive)
    patiently(mirror.finish, given_up=given_up)
    send_results(connection, archive, given_up=given_up)
    patiently(Mirror(connection, list(last)).finish, given_up=given_up)


def with_offset(offset_s: float) -> Optional[Callable[[bytes], bytes]]:
    """Changes the times of a JSON record from the node's clock to the controller's; None if they agree."""
    if offset_s == 0:
        return None

    def change(content: bytes) -> bytes:
        try:
            record = json.loads(content.decode("utf-8"))
            for name in _TIMES_S:
                if name in record:
                    record[name] += offset_s
            for name in _TIMES_ISO:
                if name in record:
                    record[name] = (datetime.fromisoformat(record[name]) + timedelta(seconds=offset_s)).isoformat()
        except (ValueError, TypeError, AttributeError):
            return content
        return json.dumps(record).encode()

    return change


@contextlib.contextmanager
def holding(folder: Path) -> Iterator[None]:
    """One process at a time has the run in ``folder``; the kernel frees the lock of a killed one. Raises OSError."""
    descriptor = os.open(str(folder / _LOCK_FILE), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def remove_run(folder: Path) -> None:
    """Remove what a run has left on this node. Raises OSError."""
    remove_tree(folder)
    with contextlib.suppress(OSError):
        folder.parent.rmdir()  # unless another job of the run has left something


def sweep_runs(ticket: Ticket) -> None:
    """Remove what runs have left in ``<cache>/runs/<key>/<job>/`` that nobody has fetched for a week."""
    for folder in ticket.run_folder.parent.glob("*/*"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime < _KEPT_S:
                continue
            descriptor = os.open(str(folder / _LOCK_FILE), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_run(folder)
            finally:
                os.close(descriptor)


def make_folders(*folders: Path) -> None:
    """Make folders that only this user enters. Raises OSError."""
    for folder in folders:
        os.makedirs(str(folder), mode=0o700, exist_ok=True)


# -- the variant of a dataset, made on this node from the recording in its cache ---------------------------------------
#
# A process with an installation of SLAM Hive makes it (slamhive.executors.node_store.controller). So its libraries take
# no memory while the run goes on, and it can be ended at any time. What it says: a line for each step forwards, and at
# last why it has failed.


MADE_FILE = "made.json"
"""What has been made, beside the recording of the variant."""
VARIANT_FILE = "made-variant.json"
"""The same as a node reports it of a run."""
CHECKSUM, BAG = "checksum", "bag"
FRACTION, PROBLEM = "fraction", "problem"
_MODULE = "slamhive.executors.node_store.controller"

MadeProgress = Callable[[float], None]
"""Gets the fraction of the variant that is there."""


def item_of(order: Dict[str, Any]) -> Item:
    """The variant of an order, as JSON, as an item of the cache: equal orders have the same name."""
    name = sha256("variant {}".format(order["key"]).encode()).hexdigest()
    return Item(name, int(order["room_bytes"]), MADE, 0, words_of(order))


def words_of(order: Dict[str, Any]) -> str:
    """The name for messages."""
    return "the variant {} of {}".format(order["key"][:12], order["dataset"])


def hold_variant(
    cache: Cache, order: Dict[str, Any], source: Item, fetch: Fetch, python: str, progress: MadeProgress
) -> Held:
    """The variant in the cache, made unless it is there. Only who makes it needs the recording.

    Args:
        cache: The cache of this node.
        order: A ``VariantOrder`` as JSON.
        source: The recording of the dataset.
        fetch: Brings it.
        python: The program of a Python that has SLAM Hive.
        progress: Called while it is being made.

    Raises:
        WrongNode: The node cannot make it, or would make other bytes.
        CacheFull, OSError: There is no room.
    """

    def make(_item: Item, folder: Path) -> None:
        recording = cache.hold(source, fetch)
        try:
            make_apart([python, "-m", _MODULE], order, recording.path, folder, progress)
        finally:
            recording.release()

    return cache.hold(item_of(order), make)


def read_made(folder: Path) -> Dict[str, str]:
    """Of a variant in the cache: the checksum of its recording, and where that lies in the folder."""
    made = json.loads((folder / MADE_FILE).read_text(encoding="utf-8"))
    return {name: str(made[name]) for name in (CHECKSUM, BAG)}


def make_apart(
    program: List[str], order: Dict[str, Any], recording: Path, folder: Path, progress: MadeProgress
) -> None:
    """Make the variant in ``folder``, which is empty, by another process. Raises WrongNode, OSError.

    If ``progress`` raises, or a signal ends the wait, the process is ended.
    """
    command = [*program, str(recording), str(folder)]
    problem = ""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, universal_newlines=True) as process:
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps(order))
            process.stdin.close()
            for line in process.stdout:
                try:
                    said = json.loads(line)
                except ValueError:
                    continue  # one of its libraries has printed it
                if isinstance(said, dict):
                    problem = said.get(PROBLEM, problem)
                    if FRACTION in said:
                        progress(said[FRACTION])
        except BrokenPipeError:
            problem = "{} cannot make variants".format(" ".join(program))
        except BaseException:
            process.kill()
            raise
    if problem or process.returncode:
        why = problem or "the process that makes it ended with code {}".format(process.returncode)
        raise WrongNode("{} cannot be made on its node: {}".format(words_of(order), why))
