"""Challenges of one installation: create, submit, look, rank, end phases."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path

from slamhive.clock import utc_now
from slamhive.domain.challenge import PhaseState, Reveal, phase_state
from slamhive.errors import Conflict, InvalidInput
from slamhive.files import write_aside
from slamhive.schema.challenge import Challenge, ChallengeBrief, ChallengeRanking, ChallengeSubmission, PhaseEntry
from slamhive.services.challenges.checking import check_files
from slamhive.services.challenges.folder import CHANGES, ChallengeFolder, challenge_folder, challenge_names
from slamhive.services.challenges.making import create_challenge
from slamhive.services.challenges.ranking import ranking_of
from slamhive.services.challenges.submitting import Entrant, enter, open_phase
from slamhive.services.challenges.views import brief_of, challenge_of, submission_of
from slamhive.services.datasets import check_writable
from slamhive.settings import Settings

logger = logging.getLogger(__name__)


class Challenges:
    """Challenges.

    Args:
        settings: Mode, and where challenges are.
        clock: The time.
    """

    def __init__(self, settings: Settings, clock: Callable[[], datetime] = utc_now) -> None:
        self._settings = settings
        self._clock = clock

    def create(self, path: Path) -> Challenge:
        """Make a challenge of a file and its ground truths; raises InvalidInput, NotFound, Conflict or Unavailable."""
        check_writable(self._settings)
        folder = create_challenge(self._settings.challenges_folder, path)
        return challenge_of(folder.definition, self._clock())

    def names(self) -> list[str]:
        """The names of all challenges."""
        return challenge_names(self._settings.challenges_folder)

    def briefs(self) -> list[ChallengeBrief]:
        """All challenges, sorted by name; without those whose file somebody has broken, which :meth:`get` explains."""
        found = []
        for name in self.names():
            try:
                found.append(brief_of(self._folder(name).definition, self._clock()))
            except InvalidInput as error:
                logger.warning("%s", error)
        return found

    def get(self, name: str) -> Challenge:
        """What is public of a challenge; raises NotFound."""
        return challenge_of(self._folder(name).definition, self._clock())

    def check(self, name: str, files: Mapping[str, bytes], phase: str | None = None) -> list[str]:
        """Lines about files that could be submitted; raises what :meth:`submit` would raise for them."""
        definition = self._folder(name).definition
        checked = check_files(definition, open_phase(definition, phase, self._clock()), files)
        return [f"{entry.sequence}: {entry.facts.poses:,} poses" for entry in checked]

    def submit(
        self, name: str, entrant: Entrant, files: Mapping[str, bytes], phase: str | None = None
    ) -> ChallengeSubmission:
        """Keep trajectories by file name, and queue their evaluation.

        Raises:
            NotFound: There is no such challenge or phase.
            Conflict: The phase is not open.
            InvalidInput: The files are not what the challenge asks for.
            Forbidden: The team is that of another account, or this installation is view-only.
            TooManyRequests: There were as many submissions today as there may be.
            Unavailable: The disk refuses.
        """
        check_writable(self._settings)
        folder, now = self._folder(name), self._clock()
        found = enter(folder, open_phase(folder.definition, phase, now), entrant, files, now)
        return submission_of(folder.definition, found, now)

    def submissions(self, name: str, account: str | None = None) -> list[ChallengeSubmission]:
        """The submissions of an account, with None those of all, the newest first; raises NotFound."""
        folder, now = self._folder(name), self._clock()
        found = [entry for entry in folder.submissions() if account is None or entry.sent.account == account]
        found.sort(key=lambda entry: entry.sent.at, reverse=True)
        return [submission_of(folder.definition, entry, now) for entry in found]

    def ranking(self, name: str, phase: str | None = None) -> ChallengeRanking:
        """The ranking of a phase; None means the last one that has started. Raises NotFound."""
        folder, now = self._folder(name), self._clock()
        chosen = _latest(folder, now) if phase is None else folder.definition.phase(phase)
        return ranking_of(folder.definition, chosen, folder.submissions(phase=chosen), now)

    def end_phase(self, name: str, phase: str, ends: datetime) -> Challenge:
        """Let a phase end at another time; raises NotFound, InvalidInput, and Conflict for one that has ended."""
        folder = self._folder(name)
        found = folder.definition.phase(phase)
        self._check_movable(found)
        if found.begins is not None and ends <= found.begins:
            raise InvalidInput(f"phase {phase} begins at {found.begins:%Y-%m-%d %H:%M %Z}", "let it end after that")
        return self._end(folder, {phase: ends})

    def close(self, name: str) -> Challenge:
        """End all phases now: no submissions are taken any more, and hidden scores are shown. Raises NotFound."""
        folder, now = self._folder(name), self._clock()
        left = [
            entry.name
            for entry in folder.definition.file.phases
            if phase_state(entry.begins, entry.ends, now) is not PhaseState.ENDED
        ]
        return self._end(folder, dict.fromkeys(left, now))

    def _end(self, folder: ChallengeFolder, ends: Mapping[str, datetime]) -> Challenge:
        check_writable(self._settings)
        changes = folder.changes
        made = changes.model_copy(update={"ends": {**changes.ends, **ends}})
        write_aside(folder.root / CHANGES, json.dumps(made.content, indent=1))
        return self.get(folder.root.name)

    def _check_movable(self, phase: PhaseEntry) -> None:
        ended = phase_state(phase.begins, phase.ends, self._clock()) is PhaseState.ENDED
        if ended and phase.scores is Reveal.AT_END:
            raise Conflict(
                f"phase {phase.name} has ended, and its scores are shown", "add a phase by a challenge of its own"
            )

    def _folder(self, name: str) -> ChallengeFolder:
        return challenge_folder(self._settings.challenges_folder, name)


def _latest(folder: ChallengeFolder, now: datetime) -> PhaseEntry:
    """The last phase that has started; the first one if none has."""
    phases = folder.definition.file.phases
    begun = [entry for entry in phases if phase_state(entry.begins, entry.ends, now) is not PhaseState.COMING]
    return begun[-1] if begun else phases[0]
