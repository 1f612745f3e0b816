"""Submissions to challenges as requests send them, and whose submissions a caller may see."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from shutil import copyfileobj
from typing import IO

from werkzeug.datastructures import FileStorage

from slamhive.domain.accounts import Action
from slamhive.domain.names import check_name
from slamhive.errors import InvalidInput
from slamhive.files import temporary_folder
from slamhive.schema.challenge import ChallengeSubmission
from slamhive.services.challenges import Entrant, read_files
from slamhive.web.context import caller, hive

MOST_SENT_BYTES = 16_000_000
"""One request with a submission."""


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
