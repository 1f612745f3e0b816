"""Imports uploads when a program asks for it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

from slamhive.schema.uploads import AlgorithmUpload, DatasetUpload, Imported, ImportProgress, RunsUpload, Upload
from slamhive.services.hive import Hive
from slamhive.services.uploads import StoredUpload
from slamhive.web import acts
from slamhive.web.background import Background, Progress, Work
from slamhive.web.context import caller, hive, upload_work

_MOST_FAILED = 1000

Asked = DatasetUpload | RunsUpload | AlgorithmUpload


class UploadWork(Background):
    """Imports one upload at a time."""

    def __init__(self, hive: Hive) -> None:
        super().__init__("import", "upload {} is being imported")
        self._hive = hive
        self._failed: dict[str, Work] = {}

    def latest(self, dataset: str) -> Work | None:
        """The import of an upload that is in progress, or that failed even if others came after it."""
        return super().latest(dataset) or self._failed.get(dataset)

    def start(self, asked: Asked, owner: str, task: Callable[[Progress], Imported]) -> None:
        """Start an import whose uploads are complete; raises Conflict while another one is in progress."""
        self._hive.check_writable()
        self._hive.upload_imports.check(asked, owner)
        act = acts.acting(self._hive.store, caller(), self._hive.settings.new_runs) if owner else nullcontext()

        def work(progress: Progress) -> None:
            with act:
                task(progress)
                self._hive.store.note_act()

        self.begin(Work(asked.upload), work)

    def _end(self, work: Work) -> None:
        self._failed.pop(work.dataset, None)
        if work.problem is not None:
            self._failed[work.dataset] = work
            if len(self._failed) > _MOST_FAILED:
                del self._failed[next(iter(self._failed))]
        super()._end(work)


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
