"""Files that programs send in parts, and imports from them."""

from __future__ import annotations

from contextlib import nullcontext
from typing import IO

from flask import request

from slamhive.base.bounds import whole_number
from slamhive.documents.api import Removal
from slamhive.documents.imports import (
    LARGEST_UPLOAD_BYTES,
    AlgorithmUpload,
    DatasetUpload,
    ImportProgress,
    RunsUpload,
    Upload,
    UploadRequest,
    UploadsDocument,
)
from slamhive.services.uploads import PART_BYTES
from slamhive.web import access
from slamhive.web.api.operation import PART_ARGUMENTS, TABLE, Bytes, Section
from slamhive.web.context import caller, hive, import_jobs


@TABLE.get(Section.UPLOADS, "/uploads", UploadsDocument)
def uploads() -> UploadsDocument:
    """The uploads of the caller, the newest first."""
    return UploadsDocument(uploads=tuple(map(_document, hive().uploads.listed(_owner()))))


@TABLE.get(Section.UPLOADS, "/uploads/{upload}", Upload)
def upload(upload: str) -> Upload:
    """One upload: how much has arrived, how far its import is, and what it has become."""
    return _shown(upload)


@TABLE.post(Section.UPLOADS, "/uploads", Upload, body=UploadRequest, status=201)
def create_upload(body: UploadRequest) -> Upload:
    """Begin an upload. Then send its bytes in parts."""
    made = hive().uploads.create(body, _owner())
    hive().store.note_act()
    return _shown(made.token)


@TABLE.post(
    Section.UPLOADS, "/uploads/{upload}/parts", Upload, arguments=PART_ARGUMENTS, body=Bytes(PART_BYTES), status=201
)
def send_part(upload: str, body: IO[bytes]) -> Upload:
    """Add bytes to the end of one upload.

    If a connection breaks, ask for the upload and continue at `received_bytes`. A part that begins elsewhere changes
    nothing (409).
    """
    offset = whole_number(request.args.get("offset", ""), "offset", 0, LARGEST_UPLOAD_BYTES)
    hive().check_writable()
    hive().uploads.folder(upload, _owner()).append(offset, body)
    return _shown(upload)


@TABLE.post(Section.UPLOADS, "/uploads/{upload}/delete", Removal)
def delete_upload(upload: str) -> Removal:
    """Remove one upload. What was imported from it stays."""
    hive().uploads.remove(upload, _owner())
    hive().store.note_act()
    return Removal(removed=upload)


@TABLE.post(Section.UPLOADS, "/datasets/import", Upload, body=DatasetUpload, status=202)
def import_dataset(body: DatasetUpload) -> Upload:
    """Start making a dataset of an upload: one file, or a zip or tar archive of a folder."""
    return _started(body)


@TABLE.post(Section.UPLOADS, "/runs/import", Upload, body=RunsUpload, status=202)
def import_runs(body: RunsUpload) -> Upload:
    """Start importing the trajectories in an uploaded archive as runs."""
    return _started(body)


@TABLE.post(Section.UPLOADS, "/algorithms/import", Upload, body=AlgorithmUpload, status=202)
def import_algorithm(body: AlgorithmUpload) -> Upload:
    """Start importing an algorithm from an upload; only for admins.

    A zip or tar archive of a folder is built where its Dockerfile or `algorithm.yaml` says so. A tar file may also be
    an image that `docker save` wrote, or what `slamhive algorithm export` wrote.
    """
    return _started(body)


def _owner() -> str:
    """The account whose uploads this request is about."""
    return caller().account or ""


def _shown(token: str) -> Upload:
    """An upload with its import; raises NotFound."""
    return _document(hive().uploads.get(token, _owner()))


def _document(upload: Upload) -> Upload:
    job = import_jobs().latest(upload.token)
    return upload if job is None or upload.imported else upload.model_copy(update={"work": ImportProgress.of(job)})


def _started(body: DatasetUpload | RunsUpload | AlgorithmUpload) -> Upload:
    """Start an import for the caller; the upload as it is then."""
    act = access.acting(hive().store, caller(), hive().settings.new_runs) if _owner() else nullcontext()
    import_jobs().start(body, _owner(), act)
    return _shown(body.upload)
