"""The folders of challenges: the definition that everybody may know, the secret, and the submissions.

``<data>/challenges/NAME`` holds ``challenge.yaml``, ``state.json``, ``secret/`` (for its owner only) and
``submissions/ID/``. The folder is the truth; the database knows nothing of challenges.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from slamhive.errors import Unavailable, unknown
from slamhive.files import remedy_of, sweep_folder
from slamhive.input_bounds import read_record
from slamhive.schema.challenge import ChallengeChanges, PhaseEntry, StoredResult, StoredSubmission
from slamhive.services.challenges.definition import Definition, load_definition

DEFINITION, CHANGES, SECRET, SUBMISSIONS = "challenge.yaml", "state.json", "secret", "submissions"
SENT, RESULT = "submission.json", "result.json"
_LOCK = ".lock"


@dataclass(frozen=True)
class SubmissionFolder:
    """``submissions/ID``."""

    root: Path

    @cached_property
    def sent(self) -> StoredSubmission:
        """What was sent."""
        return StoredSubmission.read(read_record(self.root / SENT))

    @property
    def result(self) -> StoredResult | None:
        """What came of it; None while it is queued."""
        path = self.root / RESULT
        return StoredResult.read(read_record(path)) if path.exists() else None


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
        """The challenge, with the ends of phases that were changed later."""
        definition = load_definition(self.root / DEFINITION)
        ends = self.changes.ends
        phases = [
            entry.model_copy(update={"ends": ends[entry.name]}) if entry.name in ends else entry
            for entry in definition.file.phases
        ]
        return Definition(definition.file.model_copy(update={"phases": tuple(phases)}))

    @property
    def changes(self) -> ChallengeChanges:
        """What was changed after the challenge was created."""
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
        """Whether no other process evaluates submissions of this challenge; none begins during the block."""
        descriptor = os.open(self.secret, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield True
        except BlockingIOError:
            yield False
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
