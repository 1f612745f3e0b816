"""Compute stored analyses one at a time, each in a separate process with limited resources."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

import slamhive
from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.base.settings import SETTINGS, Settings
from slamhive.executors.host import owner_is_dead, worker_identity
from slamhive.services.stored_analyses.stored import PREVIEWS, SOURCE, AnalysisFolder
from slamhive.store import Store
from slamhive.store.records import AnalysisRecord, AnalysisState, LeaseLost

logger = logging.getLogger(__name__)

CHILD = "slamhive.services.analysis_process"
MOST_SAID_BYTES = 100_000
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Computing:
    """The process that is computing, and what it writes."""

    def __init__(self, child: subprocess.Popen[bytes], output: IO[bytes], errors: IO[bytes]) -> None:
        self._child = child
        self._output = output
        self._errors = errors

    @property
    def goes_on(self) -> bool:
        """True until it has ended."""
        return self._child.poll() is None

    def said(self) -> dict[str, Any]:
        """Return its final report, or ``error`` with the reason why there is none."""
        return _said(self._child.returncode, _tail(self._output), _tail(self._errors))


@contextmanager
def computing(settings: Settings, project_root: Path, folder: Path, **asked: Any) -> Iterator[Computing]:
    """Start the process on a folder with an analysis file, and end it at the end of the block.

    It ends with this process, too. ``asked`` goes to it beside the settings and limits, or in place of them.
    """
    package = Path(slamhive.__file__).parent.parent
    paths = os.pathsep.join(filter(None, (str(package), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1"), "PYTHONPATH": paths, "MPLBACKEND": "agg"}
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", CHILD, str(folder)],
            stdin=subprocess.PIPE, stdout=output, stderr=errors, env=environment, start_new_session=True,
        )  # fmt: skip
        assert child.stdin is not None
        try:
            child.stdin.write(json.dumps(_asked(settings, project_root) | asked, default=str).encode() + b"\n")
            child.stdin.flush()
            yield Computing(child, output, errors)
        except BrokenPipeError:
            raise Conflict("the process that computes analyses ends at once", "see the log of the worker") from None
        finally:
            child.kill()
            child.wait()
            child.stdin.close()


def _asked(settings: Settings, project_root: Path) -> dict[str, Any]:
    return {
        "settings": {name: getattr(settings, name) for name in SETTINGS},
        "project_root": str(project_root),
        "version": slamhive.__version__,
        "memory_bytes": settings.analysis_memory_mb * 1_000_000,
        "time_limit_s": settings.analysis_time_limit_s,
    }


def _said(code: int, output: str, errors: str) -> dict[str, Any]:
    try:
        said = json.loads(output.strip().rpartition("\n")[2])
        if code in (0, 1) and isinstance(said, dict):
            return said
    except ValueError:
        pass
    if "MemoryError" in errors or "cannot allocate" in errors.lower():
        return {"error": "the analysis needs more memory than ANALYSIS_MEMORY_MB; select fewer runs"}
    logger.error("the process that computes an analysis ended with %d: %s", code, errors[-5000:])
    ended = f"by signal {-code}" if code < 0 else f"with {code}"
    return {"error": f"the process that computed it ended {ended}; see the log of the worker"}


def _tail(stream: IO[bytes]) -> str:
    stream.seek(0, os.SEEK_END)
    stream.seek(max(0, stream.tell() - MOST_SAID_BYTES))
    return stream.read().decode(errors="replace")


LOOK_S = 0.1
BEAT_S = 1.0
MOST_ATTEMPTS = 3


class AnalysisJobs:
    """Works through the queue of analyses.

    Args:
        settings: For this process and the computing one.
        store: The queue.
        project_root: The folder with ``algorithms/``.
    """

    def __init__(self, settings: Settings, store: Store, project_root: Path) -> None:
        self._settings = settings
        self._store = store
        self._project_root = project_root

    def work_once(self, owner: str, stopping: threading.Event) -> bool:
        """Compute one queued analysis; returns whether there was one. It is queued again if ``stopping`` is set."""
        if not self._store.read(
            lambda t: t.analyses.waiting()
        ):  # An idle worker asks often and should not need a write transaction.
            return False
        record = self._store.write(lambda t: t.analyses.claim(t.lease(owner, self._settings.lease_s)))
        if record is None:
            return False
        folder = AnalysisFolder(self._settings.analyses_folder / record.token)
        if not folder.root.is_dir():
            self._store.write(lambda t: t.analyses.delete(record.token))
            return True
        try:
            if record.attempt > MOST_ATTEMPTS:
                said = {"error": f"{MOST_ATTEMPTS} workers ended while they computed it"}
            else:
                said = self._computed(record, folder, owner, stopping)
        except (LeaseLost, _Stopping) as error:
            logger.info("%s", error)
            self._store.write(lambda t: t.analyses.release([record.token], owner))
            return True
        self._end(record, folder, owner, said)
        return True

    def _end(self, record: AnalysisRecord, folder: AnalysisFolder, owner: str, said: dict[str, Any]) -> None:
        problem = said.get("error")
        done = problem is None and folder.whole
        ended = replace(
            record,
            state=AnalysisState.DONE if done else AnalysisState.FAILED,
            content_hash=said.get("content_hash"),
            reason=None if done else str(problem),
            size_bytes=folder.size_bytes,
            ended_at=utc_now(),
        )
        try:
            # Who finds it may have changed since it was claimed; the folder has the current value.
            now = folder.read_state()
            folder.write_state(replace(ended, listed=now.listed, owner=now.owner, visibility=now.visibility))
            self._store.write(lambda t: t.analyses.finish(ended, owner))
        except (LeaseLost, SlamHiveError) as error:
            logger.info("analysis %s: %s", record.token, error)
            self._store.write(lambda t: t.analyses.release([record.token], owner))
            return
        logger.info("analysis %s: %s%s", record.token, ended.state, f" ({ended.reason})" if ended.reason else "")

    def _computed(
        self, record: AnalysisRecord, folder: AnalysisFolder, owner: str, stopping: threading.Event
    ) -> dict[str, Any]:
        """The result that the process reported, or an error; ends the process and raises LeaseLost or _Stopping."""
        folder.clear_results()
        limit_s = self._settings.analysis_time_limit_s
        deadline_s = monotonic_s() + limit_s
        next_beat_s = 0.0
        shared = self._store.read(lambda t: t.accounts.in_use())
        seen = {"audience": record.sharing.audience() if shared else None, "owner": record.owner or ""}
        with computing(self._settings, self._project_root, folder.root, **seen) as process:
            while process.goes_on:
                if stopping.wait(LOOK_S):
                    raise _Stopping(f"analysis {record.token} waits for the next worker")
                if monotonic_s() > deadline_s:
                    return {"error": f"the analysis takes longer than {limit_s:g} s; select fewer runs"}
                if monotonic_s() >= next_beat_s:
                    next_beat_s = monotonic_s() + BEAT_S
                    self._beat(record, owner)
            return process.said()

    def _beat(self, record: AnalysisRecord, owner: str) -> None:
        lease_s = self._settings.lease_s
        if not self._store.write(lambda t: t.analyses.heartbeat([record.token], t.lease(owner, lease_s))):
            raise LeaseLost(f"analysis {record.token} was deleted or queued again")


class _Stopping(Exception):
    """The worker is stopping."""


# Computing where no worker runs, as on a view-only server: one thread, one process at a time.

IDLE_S = 30.0
TROUBLE_S = 5.0


class AnalysisComputer:
    """Takes analyses from the queue as a worker does. The thread starts with the first :meth:`wake`.

    Args:
        store: The queue.
        jobs: What computes an analysis of the queue.
    """

    def __init__(self, store: Store, jobs: AnalysisJobs) -> None:
        self._store = store
        self._jobs = jobs
        self._owner = worker_identity()
        self._asked = threading.Event()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def wake(self) -> None:
        """Look for work now."""
        self._asked.set()
        with self._lock:
            if self._thread is None and not self._stopping.is_set():
                self._thread = threading.Thread(target=self._work, name="slamhive-analyses", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Stop. The analysis in progress returns to the queue."""
        self._stopping.set()
        self._asked.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _work(self) -> None:
        try:
            for owner in self._store.read(lambda t: t.analyses.owners()):
                if owner != self._owner and owner_is_dead(owner):
                    self._store.write(lambda t, owner=owner: t.analyses.release_all(owner))  # type: ignore[misc]
        except SlamHiveError as error:
            logger.warning("analyses: %s", error)
        while not self._stopping.is_set():
            self._asked.clear()
            try:
                while not self._stopping.is_set() and self._jobs.work_once(self._owner, self._stopping):
                    pass
            except SlamHiveError as error:
                logger.warning("analyses: %s; retrying in %.0f s", error, TROUBLE_S)
                self._stopping.wait(TROUBLE_S)
                continue
            except Exception:
                logger.exception("unexpected error while computing analyses; retrying in %.0f s", TROUBLE_S)
                self._stopping.wait(TROUBLE_S)
                continue
            self._asked.wait(IDLE_S)


# Previews of an analysis that is being written, over a part of its runs.

MOST_PREVIEWED_RUNS = 200
MOST_PLOTS = 12
TIME_LIMIT_S = 60.0
MOST_WAIT_S = 20.0
"""A page waits so long while previews of another text are being computed."""
KEPT_S = 60.0
"""Runs may have been added since."""
MOST_KEPT = 20
PREVIEW_LOOK_S = 0.05


@dataclass(frozen=True, slots=True)
class Preview:
    """One plot of the text: a PNG image in base64, or why there is none."""

    form: str
    title: str
    image: str | None
    note: str


class AnalysisPreviews:
    """Computes previews one text at a time, in a process with limited memory and time, and keeps the latest.

    ``busy`` is held meanwhile.

    Args:
        settings: For the computing process.
        store: Says who asks: previews hold what that person may see.
        project_root: The folder with ``algorithms/``.
        check: Raises InvalidInput for a text that is not valid.
    """

    def __init__(self, settings: Settings, store: Store, project_root: Path, check: Callable[[str], str]) -> None:
        self._settings = settings
        self._store = store
        self._project_root = project_root
        self._check = check
        self.busy = threading.Lock()
        self._kept: OrderedDict[str, tuple[float, tuple[Preview, ...]]] = OrderedDict()

    def of(self, text: str) -> tuple[Preview, ...]:
        """The first plots of the text, in order.

        Raises:
            InvalidInput: the text is not valid, or its plots cannot be computed within the limits.
            Unavailable: previews of another text are being computed.
        """
        self._check(text)
        viewer = self._store.viewer
        seen = {"viewer": None if viewer is None else asdict(viewer), "owner": self._store.account}
        key = hashlib.sha256(f"{json.dumps(seen)}\n{text}".encode()).hexdigest()
        if not self.busy.acquire(timeout=MOST_WAIT_S):
            raise Unavailable("previews of another analysis are being computed", "try again in a few seconds")
        try:
            known = self._kept.get(key)
            if known is not None and monotonic_s() - known[0] <= KEPT_S:
                return known[1]
            found = self._computed(text, seen)
            self._kept[key] = (monotonic_s(), found)
            self._kept.move_to_end(key)
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        finally:
            self.busy.release()
        return found

    def _computed(self, text: str, seen: Mapping[str, Any]) -> tuple[Preview, ...]:
        limits = {"time_limit_s": TIME_LIMIT_S, "preview_runs": MOST_PREVIEWED_RUNS, "preview_plots": MOST_PLOTS}
        deadline_s = monotonic_s() + TIME_LIMIT_S
        with tempfile.TemporaryDirectory(prefix="slamhive-preview-") as name:
            folder = Path(name)
            write_aside(folder / SOURCE, text)
            with computing(self._settings, self._project_root, folder, **limits, **seen) as process:
                while process.goes_on:
                    if monotonic_s() > deadline_s:
                        raise InvalidInput(f"the previews take longer than {TIME_LIMIT_S:g} s", "compute the analysis")
                    time.sleep(PREVIEW_LOOK_S)
                said: dict[str, Any] = process.said()
            if "error" in said:
                raise InvalidInput(str(said["error"]))
            return tuple(Preview(**entry) for entry in json.loads((folder / PREVIEWS).read_text(encoding="utf-8")))
