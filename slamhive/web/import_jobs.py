"""Imports of datasets, algorithms and runs in the background; what pages import is looked at before."""

from __future__ import annotations

import re
import secrets
import threading
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from enum import StrEnum
from pathlib import PurePosixPath

from slamhive.base.budget import Budget, BudgetShare, Lent
from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Conflict, NotFound, SlamHiveError
from slamhive.documents.imports import AlgorithmOnServer, AlgorithmUpload, DatasetOnServer, ImportedDocument, RunsUpload
from slamhive.services.hive import Hive
from slamhive.services.uploads import AlgorithmAsked, DatasetAsked, Found, ImportAsked
from slamhive.web.long_work import problem_of

_MOST_KEPT = 200
_MOST_LINES = 2000
_DIGITS = re.compile(r"\d+")


class Stage(StrEnum):
    """Stage of an import."""

    LOOKING = "looking"
    FOUND = "found"
    REFUSED = "refused"
    IMPORTING = "importing"
    IMPORTED = "imported"
    FAILED = "failed"
    CANCELLED = "cancelled"


RUNNING = (Stage.LOOKING, Stage.IMPORTING)


class _Cancelled(SlamHiveError):
    """End of an import that somebody cancelled."""


class ImportJob:
    """An import, in whichever stage it is. Its thread alone changes it, until it is done.

    Args:
        token: Of its upload, or of its own.
        asked: What to import.
        owner: The account that asked, empty without accounts.
        area: The pages that show it; empty for programs.
    """

    def __init__(self, token: str, asked: ImportAsked, owner: str, area: str) -> None:
        self.token = token
        self.asked = asked
        self.owner = owner
        self.area = area
        self.stage = Stage.LOOKING
        self.fraction = 0.0
        self.activity = ""
        self.problem: str | None = None
        self.found: Found | None = None
        self.result: ImportedDocument | None = None
        self.log: tuple[str, ...] = ()
        self.name = ""
        """What is imported, in words: the name of the file or folder."""
        self.thread: threading.Thread | None = None
        self._since_s = monotonic_s()
        self._cancelled = threading.Event()

    @property
    def is_algorithm(self) -> bool:
        """Return whether it imports an algorithm."""
        return isinstance(self.asked, AlgorithmUpload | AlgorithmOnServer)

    @property
    def kind(self) -> str:
        """The kind of import in words: messages name neither whose it is nor the token of its upload."""
        if isinstance(self.asked, RunsUpload):
            return "the import of runs"
        return "the import of an algorithm" if self.is_algorithm else "the import of a dataset"

    @property
    def done(self) -> bool:
        """Return whether no thread works on it."""
        return self.stage not in RUNNING

    @property
    def is_cancelling(self) -> bool:
        """Return whether it is going to end because somebody cancelled it."""
        return not self.done and self._cancelled.is_set()

    def begin(self, stage: Stage) -> None:
        """Enter a stage in which a thread works."""
        self.stage, self.problem, self.fraction, self.activity, self.log = stage, None, 0.0, "", ()
        self._since_s = monotonic_s()
        self._cancelled.clear()

    def cancel(self) -> None:
        """Ask the thread to end. It does so when it next says how far it is."""
        self._cancelled.set()

    def tell(self, fraction: float, text: str) -> None:
        """Note how far it is. Raises to end the work once it is cancelled."""
        if self._cancelled.is_set():
            raise _Cancelled("cancelled")
        # A build says each line once. Counters of messages and bytes would fill the log with the same line.
        known = self.activity if self.is_algorithm else _DIGITS.sub("", self.activity)
        if text and (text if self.is_algorithm else _DIGITS.sub("", text)) != known:
            self.log = (*self.log[-_MOST_LINES:], f"{monotonic_s() - self._since_s:7.1f} s  {text}")
        self.fraction, self.activity = fraction, text

    def end(self, stage: Stage, problem: str | None) -> None:
        """Enter a stage in which nobody works."""
        self.problem = problem
        self.fraction = 1.0
        self.stage = Stage.CANCELLED if problem is not None and self._cancelled.is_set() else stage


Act = AbstractContextManager[None]
"""Entered around the work, to say who does it."""


class ImportJobs:
    """Imports, some at once: a large recording does not keep a small file waiting.

    Args:
        hive: The services.
        budget: How many at once, and how much they may unpack.
    """

    def __init__(self, hive: Hive, budget: Budget) -> None:
        self._hive = hive
        self._budget = budget
        self._lock = threading.Lock()
        self._jobs: dict[str, ImportJob] = {}

    def latest(self, token: str) -> ImportJob | None:
        """The import of an upload that is in progress, or that has failed."""
        job = self._jobs.get(token)
        return None if job is None or job.stage in (Stage.FOUND, Stage.IMPORTED) else job

    def get(self, token: str, owner: str, area: str) -> ImportJob:
        """One import of these pages; raises NotFound, also for one of somebody else."""
        job = self._jobs.get(token)
        if job is None or (job.owner, job.area) != (owner, area):
            raise NotFound(
                "this import is not here any more", "begin it again; files that were sent are kept for a day"
            )
        return job

    def listed(self, owner: str, areas: Iterable[str]) -> list[ImportJob]:
        """The imports of one account on these pages, the newest first."""
        wanted = set(areas)
        return [job for job in reversed(tuple(self._jobs.values())) if job.owner == owner and job.area in wanted]

    def look(self, asked: DatasetAsked | AlgorithmAsked, owner: str, area: str) -> ImportJob:
        """Start detecting what an import would make; raises as :meth:`start`."""
        imports = self._hive.upload_imports

        def work(job: ImportJob, share: BudgetShare) -> None:
            job.found = imports.look(asked, owner, job.tell, share)

        return self._started(self._new(asked, owner, area), Stage.LOOKING, work)

    def start(self, asked: ImportAsked, owner: str, act: Act, area: str = "") -> ImportJob:
        """Start an import.

        Raises NotFound and Conflict for uploads that are not complete or are being imported, InvalidInput for a path,
        and Unavailable while there are as many imports as there may be. The message says which these are, and for how
        long they have been working.
        """
        return self._import(self._new(asked, owner, area), act)

    def store(self, job: ImportJob, act: Act) -> ImportJob:
        """Start the import of what was looked at; raises as :meth:`start`, and Conflict unless it was."""
        if job.found is None:
            raise Conflict(f"{job.name} was not looked at", "look at it first")
        return self._import(job, act)

    def discard(self, job: ImportJob) -> None:
        """Forget an import and remove its upload; raises Conflict while it is working."""
        if not job.done:
            raise Conflict(f"{job.kind} is working", "cancel it first")
        with self._lock:
            self._jobs.pop(job.token, None)
        if job.result is None and not isinstance(job.asked, DatasetOnServer | AlgorithmOnServer):
            self._hive.upload_imports.discard(job.asked, job.owner)

    def _new(self, asked: ImportAsked, owner: str, area: str) -> ImportJob:
        imports = self._hive.upload_imports
        imports.check(asked, owner)
        if isinstance(asked, DatasetOnServer | AlgorithmOnServer):
            job = ImportJob(secrets.token_hex(16), asked, owner, area)
            job.name = PurePosixPath(asked.path).name or asked.path
        else:
            job = ImportJob(asked.upload, asked, owner, area)
            job.name = self._hive.uploads.get(asked.upload, owner).name
        return job

    def _import(self, job: ImportJob, act: Act) -> ImportJob:
        imports = self._hive.upload_imports
        imports.check(job.asked, job.owner)

        def work(job: ImportJob, share: BudgetShare) -> None:
            with act:
                job.result = imports.carry_out(job.asked, job.owner, job.tell, share)
                self._hive.store.note_act()

        return self._started(job, Stage.IMPORTING, work)

    def _started(self, job: ImportJob, stage: Stage, work: Callable[[ImportJob, BudgetShare], None]) -> ImportJob:
        share = self._budget.open_share(job.kind)
        try:
            share.take(Lent.IMPORTS, 1)
            self._enter(job, stage)
        except BaseException:  # no thread will give it back
            share.give_back()
            raise

        def run() -> None:
            try:
                problem = problem_of(self._hive, job.token, lambda: work(job, share))
            finally:
                share.give_back()
            good, bad = (Stage.FOUND, Stage.REFUSED) if stage is Stage.LOOKING else (Stage.IMPORTED, Stage.FAILED)
            job.end(good if problem is None else bad, problem)

        job.thread = threading.Thread(target=run, name="import", daemon=True)
        job.thread.start()
        return job

    def _enter(self, job: ImportJob, stage: Stage) -> None:
        """Keep a job, the newest last, and so many of those that are done."""
        with self._lock:
            known = self._jobs.get(job.token)
            if known is not None and not known.done:
                what = "this path" if isinstance(job.asked, DatasetOnServer | AlgorithmOnServer) else "this upload"
                raise Conflict(f"{what} is being imported", "wait until that has ended")
            job.begin(stage)
            self._jobs.pop(job.token, None)
            self._jobs[job.token] = job
            done = [token for token, entry in self._jobs.items() if entry.done]
            for token in done[:-_MOST_KEPT]:
                del self._jobs[token]
