"""The folders of challenges: the definition that everybody may know, the secret, and the submissions.

``<data>/challenges/NAME`` holds ``challenge.yaml``, ``state.json``, ``secret/`` (for its owner only) and
``submissions/ID/``. The folder is the truth; the database knows nothing of challenges.

``secret/`` holds ground truths, ``times.json``, ``recordings/`` and ``runs/ID/``. The last is an installation of its
own for the image of one submission.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from slamhive.base.bounds import read_record
from slamhive.base.errors import Unavailable, unknown
from slamhive.base.files import remedy_of, sweep_folder
from slamhive.documents.challenge import (
    ChallengeChanges,
    PhaseEntry,
    SecretTimes,
    StoredResult,
    StoredRunsDocument,
    StoredSubmission,
)
from slamhive.services.challenges.definition import Definition, load_definition

DEFINITION, CHANGES, SECRET, SUBMISSIONS = "challenge.yaml", "state.json", "secret", "submissions"
SENT, RESULT, CANCELLED = "submission.json", "result.json", "cancelled"
IMAGE, LOGS = "image.tar", "logs"
TIMES, RECORDINGS, RUNS, ENDED_RUNS = "times.json", "recordings", "runs", "runs.json"
_LOCK = ".lock"
_RUNNING = ".running"


@dataclass(frozen=True)
class SubmissionFolder:
    """``submissions/ID``."""

    root: Path

    @cached_property
    def sent(self) -> StoredSubmission:
        """Document of the submission as it was sent."""
        return StoredSubmission.read(read_record(self.root / SENT))

    @property
    def result(self) -> StoredResult | None:
        """Result of the submission; None while it is queued."""
        path = self.root / RESULT
        return StoredResult.read(read_record(path)) if path.exists() else None

    @property
    def cancelled(self) -> bool:
        """True if its team, or the organiser, has cancelled it."""
        return (self.root / CANCELLED).exists()

    @property
    def image(self) -> Path:
        """The archive of its image."""
        return self.root / IMAGE

    @property
    def logs(self) -> dict[str, str]:
        """Output of its image, by run on a public recording."""
        return {
            path.stem: path.read_text(encoding="utf-8", errors="replace")
            for path in sorted((self.root / LOGS).glob("*.txt"))
        }


@dataclass(frozen=True)
class ChallengeFolder:
    """``<data>/challenges/NAME``."""

    root: Path

    @property
    def secret(self) -> Path:
        """Ground truths. Only the user who created the challenge can read the folder."""
        return self.root / SECRET

    @property
    def submissions_root(self) -> Path:
        """Where submissions lie."""
        return self.root / SUBMISSIONS

    @cached_property
    def definition(self) -> Definition:
        """The challenge as it is published, with the ends of phases that were changed later."""
        definition = load_definition(self.root / DEFINITION)
        ends = self.changes.ends
        phases = [
            entry.model_copy(update={"ends": ends[entry.name]}) if entry.name in ends else entry
            for entry in definition.file.phases
        ]
        return Definition(definition.file.model_copy(update={"phases": tuple(phases)}))

    @cached_property
    def full_definition(self) -> Definition:
        """Definition with the times of secret recordings. Raises PermissionError for other users."""
        path = self.secret / TIMES
        if not path.exists():
            return self.definition
        ranges = SecretTimes.read(read_record(path)).time_ranges_s
        file = self.definition.file
        entries = [
            entry.model_copy(update={"time_range_s": ranges[entry.name]}) if entry.name in ranges else entry
            for entry in file.sequences
        ]
        return Definition(file.model_copy(update={"sequences": tuple(entries)}))

    def recording(self, sequence: str) -> Path:
        """The folder of the recording of a sequence, a dataset."""
        return self.secret / RECORDINGS / sequence

    def installation(self, submission_id: str) -> Path:
        """The data root in which the image of a submission runs."""
        return self.secret / RUNS / submission_id

    def ended_runs(self, submission_id: str) -> StoredRunsDocument | None:
        """The runs of an image; None until all have ended."""
        path = self.installation(submission_id) / ENDED_RUNS
        return StoredRunsDocument.read(read_record(path)) if path.exists() else None

    @property
    def changes(self) -> ChallengeChanges:
        """Changes made after the challenge was created."""
        path = self.root / CHANGES
        return ChallengeChanges.read(read_record(path)) if path.exists() else ChallengeChanges()

    def submission_ids(self) -> list[str]:
        """The names of all submissions, the oldest day first."""
        try:
            return sorted(entry.name for entry in os.scandir(self.submissions_root) if not entry.name.startswith("."))
        except FileNotFoundError:
            return []

    def submission(self, submission_id: str) -> SubmissionFolder:
        """The folder of one submission."""
        return SubmissionFolder(self.submissions_root / submission_id)

    def submissions(self, prefix: str = "", phase: PhaseEntry | None = None) -> Iterator[SubmissionFolder]:
        """Submissions whose name begins so, to one phase or to all."""
        for name in self.submission_ids():
            if name.startswith(prefix):
                found = self.submission(name)
                if phase is None or found.sent.phase == phase.name:
                    yield found

    @contextmanager
    def entering(self) -> Iterator[None]:
        """Nobody else adds a submission during the block."""
        try:
            descriptor = os.open(self.submissions_root / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o660)
        except OSError as error:
            raise Unavailable(f"{self.submissions_root} cannot be used: {error.strerror}", remedy_of(error)) from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)

    @contextmanager
    def judging(self) -> Iterator[bool]:
        """Yield True if no other process evaluates submissions of this challenge; none begins during the block."""
        with _held(os.open(self.secret, os.O_RDONLY | os.O_CLOEXEC)) as free:
            yield free

    @contextmanager
    def running(self) -> Iterator[bool]:
        """Yield True if no other process runs an image of this challenge; none begins during the block."""
        path = self.secret / _RUNNING
        with _held(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)) as free:
            yield free


@contextmanager
def _held(descriptor: int) -> Iterator[bool]:
    """Yield True if the lock on an open file is free; it is held for the block, and the file is closed."""
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def challenge_names(root: Path) -> list[str]:
    """The names of all challenges."""
    if not root.is_dir():
        return []
    return sorted(entry.name for entry in root.iterdir() if not entry.name.startswith(".") and entry.is_dir())


def challenge_folder(root: Path, name: str) -> ChallengeFolder:
    """The folder of a challenge; raises NotFound."""
    names = challenge_names(root)
    if name not in names:
        raise unknown("challenge", name[:80], names, "slamhive challenge list shows them")
    return ChallengeFolder(root / name)


def sweep_challenges(root: Path) -> None:
    """Remove challenges and submissions that killed processes have left incomplete."""
    for aside in (*root.glob(".*"), *root.glob(f"*/{SUBMISSIONS}/.[0-9]*")):
        sweep_folder(aside)
