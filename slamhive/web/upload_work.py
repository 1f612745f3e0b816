"""Imports uploads when a program asks for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext

from slamhive.budget import Budget, Lent, Share
from slamhive.errors import Conflict
from slamhive.schema.uploads import AlgorithmUpload, DatasetUpload, Imported, ImportProgress, RunsUpload, Upload
from slamhive.services.hive import Hive
from slamhive.services.uploads import StoredUpload
from slamhive.web import acts
from slamhive.web.background import Progress, Work, carried_out
from slamhive.web.context import caller, hive, upload_work

_MOST_KEPT = 1000

Asked = DatasetUpload | RunsUpload | AlgorithmUpload
_WHAT: dict[type[Asked], str] = {
    DatasetUpload: "the import of a dataset",
    RunsUpload: "the import of runs",
    AlgorithmUpload: "the import of an algorithm",
}
"""The name of an import in messages: who waits for it learns neither whose it is nor the token of its upload."""


class UploadWork:
    """Imports uploads, some at once: a large recording does not keep a small file waiting.

    Args:
        hive: The services.
        budget: How many at once, and how much they may unpack.
    """

    def __init__(self, hive: Hive, budget: Budget) -> None:
        self._hive = hive
        self._budget = budget
        self._lock = threading.Lock()
        self._works: dict[str, Work] = {}

    def latest(self, token: str) -> Work | None:
        """The import of an upload that is in progress, or that failed."""
        return self._works.get(token)

    def start(self, asked: Asked, owner: str, task: Callable[[Progress, Share], Imported]) -> threading.Thread:
        """Start an import whose uploads are complete.

        Raises Conflict if this upload is being imported, and Unavailable while there are as many imports as there may
        be. The message says which these are, and for how long they have been working.
        """
        self._hive.check_writable()
        self._hive.upload_imports.check(asked, owner)
        act = acts.acting(self._hive.store, caller(), self._hive.settings.new_runs) if owner else nullcontext()
        share = self._budget.open_share(_WHAT[type(asked)])
        try:
            share.take(Lent.IMPORTS, 1)
            work = self._begun(asked.upload)
        except BaseException:
            share.give_back()
            raise

        def importing(progress: Progress) -> None:
            with act:
                task(progress, share)
                self._hive.store.note_act()

        def run() -> None:
            try:
                self._end(carried_out(self._hive, work, importing, self._note))
            finally:
                share.give_back()

        thread = threading.Thread(target=run, name="import", daemon=True)
        thread.start()
        return thread

    def _begun(self, token: str) -> Work:
        with self._lock:
            known = self._works.get(token)
            if known is not None and not known.done:
                raise Conflict("this upload is being imported", "wait until that has ended")
            self._works[token] = work = Work(token)
            return work

    def _note(self, work: Work) -> None:
        self._works[work.dataset] = work

    def _end(self, work: Work) -> None:
        """Forget what has succeeded, which its folder says; keep why others failed, of so many."""
        with self._lock:
            del self._works[work.dataset]
            if work.problem is not None:
                self._works[work.dataset] = work
            failed = [token for token, entry in self._works.items() if entry.done]
            for token in failed[:-_MOST_KEPT]:
                del self._works[token]


def owner() -> str:
    """Whose uploads this request is about: those of its account."""
    return caller().account or ""


def shown(token: str) -> Upload:
    """An upload with its import; raises NotFound."""
    return document(hive().uploads.get(token, owner()))


def document(upload: StoredUpload) -> Upload:
    """An upload with its import."""
    work = upload_work().latest(upload.token)
    return Upload.of(upload, work=None if work is None or upload.imported else ImportProgress.of(work))
