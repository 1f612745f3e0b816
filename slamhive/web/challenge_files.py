"""Submissions to challenges as requests send them, and whose submissions a caller may see."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from pathlib import Path
from shutil import copyfileobj
from typing import IO

from werkzeug.datastructures import FileStorage

from slamhive.domain.accounts import Action
from slamhive.domain.names import check_name
from slamhive.errors import Conflict, InvalidInput
from slamhive.files import temporary_folder
from slamhive.schema.challenge import ChallengeSubmission
from slamhive.schema.challenge_requests import ImageEntry
from slamhive.services.challenges import Entrant, read_files
from slamhive.web.context import caller, hive

MOST_SENT_BYTES = 16_000_000
"""One request with a submission."""
_CHECKING = threading.Lock()
"""A check of an image reads all of it, so there is one at a time."""


def of_form(uploads: Iterable[FileStorage]) -> dict[str, bytes]:
    """The trajectories of a web form by file name; raises InvalidInput."""
    with temporary_folder() as folder:
        paths = []
        for upload in uploads:
            if upload.filename:
                path = folder / check_name("file", Path(upload.filename).name)
                if path.exists():
                    raise InvalidInput(f"two files are called {path.name}", "send one of them")
                upload.save(path)
                paths.append(path)
        return read_files(paths)


def of_body(body: IO[bytes]) -> dict[str, bytes]:
    """The trajectories in a zip archive; raises InvalidInput."""
    with temporary_folder() as folder:
        path = folder / "submission.zip"
        with path.open("wb") as stream:
            copyfileobj(body, stream)
        return read_files([path])


def send(name: str, team: str, phase: str, files: dict[str, bytes]) -> ChallengeSubmission:
    """Submit for the caller; raises what :meth:`Challenges.submit` raises."""
    made = hive().challenges.submit(name, Entrant(team or caller().account, caller().account), files, phase or None)
    hive().store.note_act()
    return made


def send_image(name: str, asked: ImageEntry) -> ChallengeSubmission:
    """Submit an uploaded image, or a version of a package, for the caller.

    Raises what :meth:`Challenges.submit` raises, and Conflict while another image is checked.
    """
    challenges, mine = hive().challenges, caller().account
    entrant = Entrant(asked.team or mine, mine, asked.algorithm or None)
    asked.check()
    if asked.package is not None:
        made = challenges.submit_version(name, entrant, hive().versions.find(asked.package), asked.phase or None)
    else:
        made = _send_upload(name, entrant, asked)
    hive().store.note_act()
    return made


def _send_upload(name: str, entrant: Entrant, asked: ImageEntry) -> ChallengeSubmission:
    token, owner = str(asked.upload), caller().account or ""
    if not _CHECKING.acquire(blocking=False):
        raise Conflict("another image is being checked now", "try again in a minute; the upload stays")
    try:
        hive().uploads.folder(token, owner).check_complete()
        with hive().upload_imports.opened(token, owner) as path:
            made = hive().challenges.submit_image(name, entrant, path, asked.phase or None)
        hive().uploads.remove(token, owner)
        return made
    finally:
        _CHECKING.release()


def cancel(name: str, submission: str) -> ChallengeSubmission:
    """Cancel a submission of the caller; raises NotFound for one of somebody else, and Conflict for a result shown."""
    made = hive().challenges.cancel(name, submission, caller().account)
    hive().store.note_act()
    return made


def may_submit() -> bool:
    """Whether the caller may submit."""
    return Action.SUBMIT in caller().may


def own_submissions(name: str) -> list[ChallengeSubmission]:
    """The submissions of the caller, the newest first; raises NotFound.

    Without accounts, all who reach the server are its owner. A visitor of a view-only server is nobody, and has none.
    """
    if not caller().account and not may_submit():
        hive().challenges.get(name)
        return []
    return hive().challenges.submissions(name, caller().account)
