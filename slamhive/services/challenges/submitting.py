"""Takes submissions: limits per day, whose a team is, and a folder that is there completely or not at all.

The folders of submissions are what is counted, so a limit holds after a kill, too.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from slamhive.base.budget import BudgetShare
from slamhive.base.errors import Conflict, Forbidden, InvalidInput, SlamHiveError, TooManyRequests, Unavailable
from slamhive.base.files import held_folder, remedy_of, share_with_group, write_aside
from slamhive.documents.challenge import PhaseEntry, StoredImage, StoredSubmission
from slamhive.domain.challenge import Format, PhaseState, Taken, phase_state
from slamhive.domain.names import check_name, plural
from slamhive.services.challenges.checking import CheckedFile, check_files, frame_trajectory, in_memory
from slamhive.services.challenges.definition import IMAGE, SENT, ChallengeFolder, Definition, SubmissionFolder
from slamhive.services.challenges.images import check_image
from slamhive.trajectory.kitti import parse_kitti_matrices

DAY = "%Y%m%d"
_BLOCK_BYTES = 1 << 20
_FOLDER_MODE, _FILE_MODE = 0o750, 0o640
"""Teams do not see each other's trajectories, and other users of the machine do not see any."""


@dataclass(frozen=True, slots=True)
class Entrant:
    """Team that submits. ``account`` is empty on the command line, and on a server without accounts."""

    team: str
    account: str = ""
    algorithm: str | None = None
    """Of the package of an image; None for its only one."""


def open_phase(definition: Definition, asked: str | None, now: datetime) -> PhaseEntry:
    """The phase to submit to; raises NotFound, Conflict if it is not open, InvalidInput if several are."""
    file = definition.file
    if asked is not None:
        phase = definition.phase(asked)
        state = phase_state(phase.begins, phase.ends, now)
        if state is PhaseState.COMING:
            raise Conflict(f"phase {asked} is not open yet", f"it opens at {phase.begins:%Y-%m-%d %H:%M %Z}")
        if state is PhaseState.ENDED:
            raise Conflict(f"phase {asked} ended at {phase.ends:%Y-%m-%d %H:%M %Z}", "it takes no submissions")
        return phase
    found = [entry for entry in file.phases if phase_state(entry.begins, entry.ends, now) is PhaseState.OPEN]
    if not found:
        raise Conflict(f"no phase of challenge {file.name} is open", "its page says when one opens")
    if len(found) > 1:
        names = ", ".join(entry.name for entry in found)
        raise InvalidInput(f"several phases are open: {names}", "name one of them")
    return found[0]


@dataclass(frozen=True, slots=True)
class Submitted:
    """Kept part of a submission: an identity, facts, and a function that writes its files into a folder."""

    digest: str
    write: Callable[[Path], None]
    checked: Sequence[CheckedFile] = ()
    image: StoredImage | None = None


def enter(
    folder: ChallengeFolder,
    phase: PhaseEntry,
    entrant: Entrant,
    files: Mapping[str, Path],
    now: datetime,
    share: BudgetShare,
) -> SubmissionFolder:
    """Keep a submission, which then waits for its evaluation. What a team sends twice on one day is kept once.

    The memory for its check is taken out of ``share``.

    Raises:
        InvalidInput: The files are not what the challenge asks for; nothing counts.
        Forbidden: The team is that of another account.
        TooManyRequests: The account or the team has sent as many as it may today.
        Unavailable: The disk refuses, or others use the memory.
    """
    check_taken(folder.definition, phase, Taken.TRAJECTORIES)

    def check() -> Submitted:
        checked = check_files(folder.definition, phase, files, share)
        return Submitted(digest, lambda aside: _write_files(aside, checked, share), checked)

    digest = _digest(files)
    return _enter(folder, phase, entrant, digest, check, now)


def enter_image(
    folder: ChallengeFolder, phase: PhaseEntry, entrant: Entrant, image: Path | StoredImage, now: datetime
) -> SubmissionFolder:
    """Keep the archive of an image, or note a version that is here. It then waits for its runs.

    ``image`` is the archive, or the version. The algorithm of an archive is that of the entrant. Raises as
    :func:`enter`.
    """
    check_taken(folder.definition, phase, Taken.IMAGES)
    rules = folder.definition.file.images
    assert rules is not None  # a phase takes images only where the challenge says how these run

    def check() -> Submitted:
        if isinstance(image, StoredImage):
            return Submitted(digest, lambda _aside: None, image=image)
        found = check_image(image, entrant.algorithm, rules.largest_mb)
        return Submitted(digest, lambda aside: _copy(image, aside / IMAGE), image=found)

    hashed = hashlib.sha256(f"{entrant.algorithm}\0".encode())
    if isinstance(image, StoredImage):
        hashed.update(json.dumps(image.content).encode())
    else:
        try:
            with image.open("rb") as stream:
                while block := stream.read(_BLOCK_BYTES):
                    hashed.update(block)
        except OSError as error:
            raise InvalidInput(f"{image.name} cannot be read: {error.strerror}") from None
    digest = hashed.hexdigest()
    return _enter(folder, phase, entrant, digest, check, now)


def check_taken(definition: Definition, phase: PhaseEntry, what: Taken) -> None:
    """Raise Conflict unless the phase takes ``what``."""
    taken = definition.takes(phase)
    if what not in taken:
        raise Conflict(f"phase {phase.name} takes no {what.value}", f"submit {' or '.join(taken)}")


def _enter(
    folder: ChallengeFolder,
    phase: PhaseEntry,
    entrant: Entrant,
    digest: str,
    check: Callable[[], Submitted],
    now: datetime,
) -> SubmissionFolder:
    check_name("team", entrant.team)
    again = _admitted(folder, phase, entrant, digest, now)  # files of those who may not submit are not even parsed
    if again is not None:
        return again
    submitted = check()
    with folder.entering():
        again = _admitted(folder, phase, entrant, digest, now)
        return _store(folder, phase, entrant, submitted, now) if again is None else again


def _admitted(
    folder: ChallengeFolder, phase: PhaseEntry, entrant: Entrant, digest: str, now: datetime
) -> SubmissionFolder | None:
    """The same submission if it was sent today; None for a new one that may be sent. Raises as :func:`enter`."""
    if entrant.account:
        # The first account that submits for a team keeps it; on the command line, everybody is the organiser.
        for found in folder.submissions():
            if found.sent.team.casefold() == entrant.team.casefold() and found.sent.account != entrant.account:
                raise Forbidden(f"team {entrant.team} belongs to another account", "choose another name for your team")
    today = list(folder.submissions(f"{now:{DAY}}", phase))
    for found in today:
        if (found.sent.digest, found.sent.team) == (digest, entrant.team):
            return found
    _check_limit(folder.definition, phase, entrant, [found.sent for found in today])
    return None


def _check_limit(definition: Definition, phase: PhaseEntry, entrant: Entrant, sent: Sequence[StoredSubmission]) -> None:
    most = phase.submissions_per_day or definition.file.submissions_per_day
    of_team = sum(entry.team.casefold() == entrant.team.casefold() for entry in sent)
    of_account = sum(bool(entrant.account) and entry.account == entrant.account for entry in sent)
    if max(of_team, of_account) >= most:
        whose = f"team {entrant.team}" if of_team >= most else f"account {entrant.account}"
        raise TooManyRequests(
            f"{whose} has sent {plural(most, 'submission')} to phase {phase.name} today, as many as it may",
            "the next day begins at 00:00 UTC",
        )


def _store(
    folder: ChallengeFolder, phase: PhaseEntry, entrant: Entrant, submitted: Submitted, now: datetime
) -> SubmissionFolder:
    submission_id = f"{now:{DAY}}-{secrets.token_hex(6)}"
    sent = StoredSubmission(
        id=submission_id,
        phase=phase.name,
        team=entrant.team,
        account=entrant.account,
        at=now,
        digest=submitted.digest,
        files={entry.sequence: entry.facts for entry in submitted.checked},
        image=submitted.image,
    )
    final = folder.submission(submission_id)
    aside = folder.submissions_root / f".{submission_id}"
    try:
        with held_folder(aside):
            aside.chmod(_FOLDER_MODE)
            share_with_group(aside)
            submitted.write(aside)
            write_aside(aside / SENT, json.dumps(sent.content), _FILE_MODE)
            aside.rename(final.root)
    except (OSError, SlamHiveError) as error:
        shutil.rmtree(aside, ignore_errors=True)
        if isinstance(error, SlamHiveError):
            raise
        raise Unavailable(f"{final.root} cannot be made: {error.strerror}", remedy_of(error)) from None
    return final


def _write_files(aside: Path, checked: Sequence[CheckedFile], share: BudgetShare) -> None:
    for entry in checked:
        _copy(entry.path, aside / f"{entry.sequence}.{entry.format}")
        if entry.format is Format.KITTI:
            with in_memory(entry.path, entry.sequence, entry.format, share) as data:
                frames = frame_trajectory(parse_kitti_matrices(data, entry.sequence))
            write_aside(aside / f"{entry.sequence}.{Format.TUM}", frames, _FILE_MODE)


def _copy(source: Path, target: Path) -> None:
    with source.open("rb") as content, target.open("xb") as stream:
        shutil.copyfileobj(content, stream, _BLOCK_BYTES)
        stream.flush()
        os.fsync(stream.fileno())
    target.chmod(_FILE_MODE)


def _digest(files: Mapping[str, Path]) -> str:
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        try:
            with path.open("rb") as stream:
                digest.update(f"{name}\0{os.fstat(stream.fileno()).st_size}\0".encode())
                while block := stream.read(_BLOCK_BYTES):
                    digest.update(block)
        except OSError as error:
            raise InvalidInput(f"{name} cannot be read: {error.strerror}") from None
    return digest.hexdigest()
