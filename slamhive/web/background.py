"""Long work on datasets and uploads that a request starts, one piece at a time in the background."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from slamhive.errors import Conflict, SlamHiveError, changed_text
from slamhive.services.hive import Hive
from slamhive.shown_paths import relative_paths

logger = logging.getLogger(__name__)

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Work:
    """The latest request. ``fraction`` is from 0 to 1; ``problem`` says why it failed.

    ``dataset`` is what is worked on: the name of a dataset, or the token of an upload.
    """

    dataset: str
    details: tuple[str, ...] = ()
    fraction: float = 0.0
    activity: str = ""
    done: bool = False
    problem: str | None = None


class Background:
    """Does one piece of work at a time in a thread.

    Args:
        hive: The services.
        kind: The name of the threads.
        busy: What messages say of a dataset that is worked on: ``a variant of {} is being created``.
    """

    def __init__(self, hive: Hive, kind: str, busy: str) -> None:
        self._hive = hive
        self._kind = kind
        self._busy = busy
        self._lock = threading.Lock()
        self._latest: Work | None = None

    def begin(self, work: Work, task: Callable[[Progress], object]) -> threading.Thread:
        """Start ``task``, which takes a function for its progress; raises Conflict while another one runs."""
        with self._lock:
            if self._latest is not None and not self._latest.done:
                raise Conflict(self._busy.format(self._latest.dataset), "wait until it is finished")
            self._latest = work
        thread = threading.Thread(target=self._run, args=(work, task), name=self._kind, daemon=True)
        thread.start()
        return thread

    def latest(self, dataset: str) -> Work | None:
        """The latest work on ``dataset`` that is in progress or has failed."""
        work = self._latest
        if work is None or work.dataset != dataset or (work.done and work.problem is None):
            return None
        return work

    def _run(self, work: Work, task: Callable[[Progress], object]) -> None:
        self._note(carried_out(self._hive, work, task, self._note))

    def _note(self, work: Work) -> None:
        """Note how far a piece of work is. If it has ended, other work can begin from now on."""
        self._latest = work


def carried_out(hive: Hive, work: Work, task: Callable[[Progress], object], note: Callable[[Work], None]) -> Work:
    """Carry out ``task``; how it has ended. ``note`` is called with its progress."""

    def progress(fraction: float, text: str) -> None:
        note(replace(work, fraction=fraction, activity=text))

    problem = None
    try:
        with changed_text(relative_paths(hive.settings.data, hive.project_root)):
            task(progress)
    except SlamHiveError as error:
        problem = str(error)
    except Exception:
        logger.exception("work on %s failed", work.dataset)
        problem = "an unexpected error; see the server's log"
    return replace(work, fraction=1.0, done=True, problem=problem)
