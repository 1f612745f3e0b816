"""Challenges: what they ask for, their rankings, and the way to submit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address
from werkzeug.datastructures import FileStorage

from slamhive.base.budget import BudgetShare, Lent
from slamhive.base.errors import InvalidInput
from slamhive.base.files import temporary_folder
from slamhive.documents.challenge import ChallengeSubmission, ImageEntry
from slamhive.documents.model import parse
from slamhive.domain.accounts import Action
from slamhive.domain.challenge import shown
from slamhive.domain.names import check_name
from slamhive.services.challenges import Entrant, opened_files
from slamhive.web.context import budget, caller, hive

blueprint = Blueprint("challenges", __name__, url_prefix="/challenges")


@blueprint.get("")
def index() -> str:
    """List challenges."""
    return render_template("challenges/index.html", found=hive().challenges.briefs())


@blueprint.get("/<name>")
def show(name: str) -> str:
    """Show a challenge, the ranking of one phase, and the caller's own submissions."""
    challenges = hive().challenges
    return render_template(
        "challenges/show.html",
        challenge=challenges.get(name),
        ranking=challenges.ranking(name, request.args.get("phase") or None),
        submissions=own_submissions(name),
        may_submit=may_submit(),
        versions=hive().versions.labels(),
        team=caller().account,
        shown=shown,
    )


@blueprint.post("/<name>/submit")
def submit(name: str) -> Response:
    """Take trajectories, and queue their evaluation."""
    team, phase = request.form.get("team", "").strip(), request.form.get("phase", "")
    made = send_form(name, team, phase, request.files.getlist("files"))
    flash(f"Submission {made.id} of team {made.team} waits for its evaluation.", "success")
    return make_response(redirect(address("challenges.show", name=name, phase=made.phase), 303))


@blueprint.post("/<name>/submit-package")
def submit_package(name: str) -> Response:
    """Take a version of a package, and queue its runs."""
    fields = ("package", "algorithm", "team", "phase")
    asked = parse(ImageEntry, {field: request.form.get(field, "").strip() for field in fields})
    made = send_image(name, asked)
    flash(f"Submission {made.id} of team {made.team} waits for its runs.", "success")
    return make_response(redirect(address("challenges.show", name=name, phase=made.phase), 303))


@blueprint.post("/<name>/submissions/<submission>/cancel")
def cancel(name: str, submission: str) -> Response:
    """Cancel a submission of the caller."""
    made = cancel_submission(name, submission)
    flash(f"Submission {made.id} of team {made.team} is cancelled.", "success")
    return make_response(redirect(address("challenges.show", name=name, phase=made.phase), 303))


# -- submissions to challenges as requests send them, and whose submissions a caller may see ---------------------------


MOST_SENT_BYTES = 16_000_000
"""One request with a submission."""
_WAIT_S = 5.0
"""Longest that a request waits for its turn: a thread that waits serves no pages."""
_PIECE_BYTES = 256 * 1024


def send_form(name: str, team: str, phase: str, uploads: Iterable[FileStorage]) -> ChallengeSubmission:
    """Submit the trajectories of a web form for the caller; raises as :func:`send_body`."""
    with _working(name, Lent.SUBMISSIONS) as share, temporary_folder() as folder:
        share.take(Lent.DISK, request.content_length or 0)  # its parts are temporary files, too
        paths = []
        for upload in uploads:
            if upload.filename:
                path = folder / check_name("file", Path(upload.filename).name)
                if path.exists():
                    raise InvalidInput(f"two files are called {path.name}", "send one of them")
                paths.append(_received(upload.stream, path, share))
        return _send(name, team, phase, paths, share)


def send_body(name: str, team: str, phase: str, body: IO[bytes]) -> ChallengeSubmission:
    """Submit the trajectories in a zip archive for the caller.

    Raises what :meth:`Challenges.submit` raises, and Unavailable while the server works on as much as it may.
    """
    with _working(name, Lent.SUBMISSIONS) as share, temporary_folder() as folder:
        return _send(name, team, phase, [_received(body, folder / "submission.zip", share)], share)


def _working(name: str, kind: Lent) -> AbstractContextManager[BudgetShare]:
    known = name if name in hive().challenges.names() else ""
    what = "an image" if kind is Lent.IMAGES else "a submission"
    return budget().share(f"{what} to challenge {known}", kind, _WAIT_S)


def _received(body: IO[bytes], path: Path, share: BudgetShare) -> Path:
    """Write what was sent to ``path``, a piece at a time."""
    with path.open("wb") as stream:
        while piece := body.read(_PIECE_BYTES):
            share.take(Lent.DISK, len(piece))
            stream.write(piece)
    return path


def _send(name: str, team: str, phase: str, paths: Sequence[Path], share: BudgetShare) -> ChallengeSubmission:
    entrant = Entrant(team or caller().account, caller().account)
    with opened_files(paths, share) as files:
        made = hive().challenges.submit(name, entrant, files, phase or None, share)
    hive().store.note_act()
    return made


def send_image(name: str, asked: ImageEntry) -> ChallengeSubmission:
    """Submit an uploaded image, or a version of a package, for the caller.

    Raises what :meth:`Challenges.submit` raises, and Unavailable while another image is checked.
    """
    challenges, mine = hive().challenges, caller().account
    entrant = Entrant(asked.team or mine, mine, asked.algorithm or None)
    asked.check()
    if asked.package is not None:
        made = challenges.submit_version(name, entrant, hive().versions.find(asked.package), asked.phase or None)
    else:
        token, owner = str(asked.upload), mine or ""
        with _working(name, Lent.IMAGES):
            hive().uploads.folder(token, owner).check_complete()
            with hive().upload_imports.opened(token, owner) as path:
                made = challenges.submit_image(name, entrant, path, asked.phase or None)
            hive().uploads.remove(token, owner)
    hive().store.note_act()
    return made


def cancel_submission(name: str, submission: str) -> ChallengeSubmission:
    """Cancel a submission of the caller; raises NotFound for one of somebody else, and Conflict for a result shown."""
    made = hive().challenges.cancel(name, submission, caller().account)
    hive().store.note_act()
    return made


def may_submit() -> bool:
    """True if the caller may submit."""
    return Action.SUBMIT in caller().may


def own_submissions(name: str) -> list[ChallengeSubmission]:
    """The submissions of the caller, the newest first; raises NotFound.

    Without accounts, all who reach the server are its owner. A visitor of a view-only server is nobody, and has none.
    """
    if not caller().account and not may_submit():
        hive().challenges.get(name)
        return []
    return hive().challenges.submissions(name, caller().account)
