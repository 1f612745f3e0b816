"""Imports uploads when a program asks for it."""

from __future__ import annotations

from collections.abc import Callable

from slamhive.schema.uploads import AlgorithmUpload, DatasetUpload, Imported, ImportProgress, RunsUpload, Upload
from slamhive.services.hive import Hive
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
        act = acts.acting(self._hive.store, caller()) if owner else None

        def work(progress: Progress) -> None:
            if act is None:
                task(progress)
                return
            with act:
                task(progress)
                self._hive.store.note_act()

        self.begin(Work(asked.upload), work)
        self._failed.pop(asked.upload, None)

    def _run(self, work: Work, task: Callable[[Progress], object]) -> None:
        super()._run(work, task)
        ended = super().latest(work.dataset)
        if ended is not None:
            self._failed[work.dataset] = ended
            if len(self._failed) > _MOST_FAILED:
                del self._failed[next(iter(self._failed))]


def owner() -> str:
    """Whose uploads this request is about: those of its account."""
    return caller().account or ""


def shown(token: str) -> Upload:
    """An upload with its import; raises NotFound."""
    upload = hive().uploads.get(token, owner())
    work = upload_work().latest(token)
    return Upload.of(upload, work=None if work is None or upload.imported else ImportProgress.of(work))
