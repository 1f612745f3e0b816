"""Challenges of one installation: create, submit, look, rank, end phases."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path

import numpy as np

from slamhive.base import strict_yaml
from slamhive.base.budget import BudgetShare, unbounded
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError, Unavailable, unknown
from slamhive.base.files import held_folder, make_shared_folder, remedy_of, write_aside
from slamhive.base.settings import Settings
from slamhive.documents.challenge import (
    Challenge,
    ChallengeBrief,
    ChallengeFile,
    ChallengeRanking,
    ChallengeSubmission,
    PhaseEntry,
    SecretTimes,
    SequenceEntry,
    StoredImage,
)
from slamhive.domain.challenge import Format, PhaseState, Reveal, Taken, phase_state
from slamhive.packages.algorithm_file import load_algorithms, version_folder
from slamhive.services.challenges.checking import check_files, frame_trajectory
from slamhive.services.challenges.definition import (
    CANCELLED,
    CHANGES,
    DEFINITION,
    RECORDINGS,
    SECRET,
    SUBMISSIONS,
    TIMES,
    ChallengeFolder,
    Definition,
    SubmissionFolder,
    challenge_folder,
    challenge_names,
    load_definition,
)
from slamhive.services.challenges.images import check_image, choose_algorithm, keep_recording
from slamhive.services.challenges.submitting import Entrant, check_taken, enter, enter_image, open_phase
from slamhive.services.challenges.views import brief_of, challenge_of, ranking_of, submission_of
from slamhive.services.datasets import check_writable
from slamhive.store import VersionRecord
from slamhive.trajectory.kitti import parse_kitti_matrices
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.table import read_bounded

logger = logging.getLogger(__name__)

# Creating: ground truth is kept apart, the rest is published.

_PRIVATE_FOLDER, _PRIVATE_FILE = 0o700, 0o600


def create_challenge(root: Path, path: Path) -> ChallengeFolder:
    """Make the challenge of the file at ``path``, complete or not at all.

    Raises:
        InvalidInput: The file or a ground truth cannot be used.
        NotFound: A ground truth does not exist.
        Conflict: There is a challenge of that name.
        Unavailable: The disk refuses.
    """
    definition = load_definition(path)
    truths = _truths(definition, path.parent)
    final = root / definition.file.name
    aside = root / f".{definition.file.name}"
    if final.exists():
        raise Conflict(f"challenge {definition.file.name} exists already", "choose another name")
    try:
        make_shared_folder(root)
        with held_folder(aside):
            _fill(aside, definition.file, truths, path.parent)
            aside.rename(final)
    except OSError as error:
        shutil.rmtree(aside, ignore_errors=True)
        raise Unavailable(f"{final} cannot be made: {error.strerror}", remedy_of(error)) from None
    except SlamHiveError:
        shutil.rmtree(aside, ignore_errors=True)
        raise
    return ChallengeFolder(final)


def _fill(folder: Path, file: ChallengeFile, truths: dict[str, bytes], source: Path) -> None:
    secret = folder / SECRET
    secret.mkdir(mode=_PRIVATE_FOLDER)
    secret.chmod(_PRIVATE_FOLDER)  # whatever the umask says
    for name, data in truths.items():
        write_aside(secret / name, data, _PRIVATE_FILE)
    for entry in file.sequences:
        if entry.recording is not None:
            keep_recording(source / entry.recording, entry.name, secret / RECORDINGS / entry.name)
    make_shared_folder(folder / SUBMISSIONS)
    times = {entry.name: entry.time_range_s for entry in file.sequences if entry.secret and entry.time_range_s}
    if times:
        write_aside(secret / TIMES, json.dumps(SecretTimes(time_ranges_s=times).content), _PRIVATE_FILE)
    published = file.model_copy(update={"sequences": tuple(map(_published, file.sequences))})
    write_aside(folder / DEFINITION, strict_yaml.dump(published.model_dump(mode="json", exclude_none=True)))


def _published(entry: SequenceEntry) -> SequenceEntry:
    """Return the public part: the times of a secret recording would tell when it was made, and how long it is."""
    kept = {"groundtruth": None, "recording": None if entry.recording is None else entry.name}
    return entry.model_copy(update={**kept, "time_range_s": None} if entry.secret else kept)


def _truths(definition: Definition, folder: Path) -> dict[str, bytes]:
    """{file in the secret folder: its content}."""
    found: dict[str, bytes] = {}
    for entry in definition.file.sequences:
        if entry.groundtruth is None:
            raise InvalidInput(f"sequence {entry.name} names no groundtruth", "give the file of its secret trajectory")
        path = folder / entry.groundtruth
        if definition.preset.format is Format.KITTI:
            data = read_bounded(path)
            matrices = parse_kitti_matrices(data, str(path))
            if len(matrices) != entry.poses:
                raise InvalidInput(
                    f"{path} has {len(matrices)} poses, {entry.name} has {entry.poses}", "correct the one"
                )
            steps_m = np.linalg.norm(np.diff(matrices[:, :3, 3], axis=0), axis=1)
            if steps_m.sum() <= 100.0:
                raise InvalidInput(
                    f"the path in {path} is {steps_m.sum():.4g} m long, the shortest segment of KITTI 100 m",
                    "leave the sequence out, or use another preset",
                )
            found |= {f"{entry.name}.kitti": data, f"{entry.name}.tum": frame_trajectory(matrices)}
            continue
        stamps_s = read_tum(path).stamps_s
        if entry.time_range_s is None:
            raise InvalidInput(
                f"sequence {entry.name} needs time_range_s",
                "give it; the times of a secret recording are not published",
            )
        first_s, last_s = entry.time_range_s
        if len(stamps_s) < 3 or stamps_s[0] < first_s or stamps_s[-1] > last_s:
            raise InvalidInput(
                f"{path} has {len(stamps_s)} poses from {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s; the time range of "
                f"{entry.name} is {first_s:g} to {last_s:g} s",
                "the range is that of the recording, within which the ground truth lies",
            )
        longest_step_s = definition.protocol.hold_interval_s
        if longest_step_s is not None and np.median(np.diff(stamps_s)) > longest_step_s:
            raise InvalidInput(
                f"{path} has a pose every {np.median(np.diff(stamps_s)):.3g} s; this protocol counts steps of at most "
                f"{longest_step_s:.3g} s",
                "use a faster ground truth, or the preset mean with another protocol",
            )
        found[f"{entry.name}.tum"] = read_bounded(path)
    return found


class ChallengeService:
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
        """Return the public part of a challenge; raises NotFound."""
        return challenge_of(self._folder(name).definition, self._clock())

    def check(self, name: str, files: Mapping[str, Path], phase: str | None = None) -> list[str]:
        """Lines about files that could be submitted; raises what :meth:`submit` would raise for them."""
        definition = self._folder(name).definition
        wanted = open_phase(definition, phase, self._clock())
        check_taken(definition, wanted, Taken.TRAJECTORIES)
        checked = check_files(definition, wanted, files, unbounded("a submission"))
        return [f"{entry.sequence}: {entry.facts.poses:,} poses" for entry in checked]

    def submit(
        self,
        name: str,
        entrant: Entrant,
        files: Mapping[str, Path],
        phase: str | None = None,
        share: BudgetShare | None = None,
    ) -> ChallengeSubmission:
        """Keep trajectories by file name, and queue their evaluation; the memory for that is taken out of ``share``.

        Raises:
            NotFound: There is no such challenge or phase.
            Conflict: The phase is not open.
            InvalidInput: The files are not what the challenge asks for.
            Forbidden: The team is that of another account, or this installation is view-only.
            TooManyRequests: There were as many submissions today as there may be.
            Unavailable: The disk refuses, or others use the memory.
        """
        check_writable(self._settings)
        folder, now = self._folder(name), self._clock()
        share = share or unbounded("a submission")
        found = enter(folder, open_phase(folder.definition, phase, now), entrant, files, now, share)
        return submission_of(folder.definition, found, now)

    def submit_image(
        self, name: str, entrant: Entrant, image: Path | StoredImage, phase: str | None = None
    ) -> ChallengeSubmission:
        """Keep the archive of an image, or note a version of this server, and queue its runs; raises as submit."""
        check_writable(self._settings)
        folder, now = self._folder(name), self._clock()
        found = enter_image(folder, open_phase(folder.definition, phase, now), entrant, image, now)
        return submission_of(folder.definition, found, now)

    def submit_version(
        self, name: str, entrant: Entrant, version: VersionRecord, phase: str | None = None
    ) -> ChallengeSubmission:
        """Queue runs of a version of a package of this installation; raises as :meth:`submit`."""
        folder = version_folder(self._settings.versions_folder, version.package, version.number)
        if not folder.is_dir():
            raise InvalidInput(f"the folder of {version.label} was not kept", "name a newer version")
        chosen = choose_algorithm(load_algorithms(folder), entrant.algorithm)
        image = StoredImage(
            package=version.package, algorithm=chosen.name, version=version.number, identity=version.identity
        )
        return self.submit_image(name, entrant, image, phase)

    def check_image(self, name: str, image: Path, algorithm: str | None, phase: str | None = None) -> str:
        """A line about an archive that could be submitted; raises what :meth:`submit_image` would raise for it."""
        definition = self._folder(name).definition
        check_taken(definition, open_phase(definition, phase, self._clock()), Taken.IMAGES)
        assert definition.file.images is not None  # the phase takes images
        found = check_image(image, algorithm, definition.file.images.largest_mb)
        if found.package is None:
            return "an image; its package is drafted when it is loaded"
        return f"package {found.package}, algorithm {found.algorithm}"

    def cancel(self, name: str, submission_id: str, account: str | None = None) -> ChallengeSubmission:
        """Cancel a submission, which still counts for its day; with ``account``, only one of this account.

        Whether it has been evaluated makes no difference while its result is not shown: nobody shall learn that.

        Raises NotFound, and Conflict if its result is shown already.
        """
        check_writable(self._settings)
        folder, now = self._folder(name), self._clock()
        found = _found(folder, submission_id, account)
        result = found.result
        if not found.cancelled:
            if result is not None and result.shown_at <= now:
                raise Conflict(f"the result of submission {submission_id} is shown already", "submit another one")
            write_aside(found.root / CANCELLED, f"{now.isoformat()}\n", 0o640)
        return submission_of(folder.definition, found, now)

    def submission(self, name: str, submission_id: str, account: str | None = None) -> ChallengeSubmission:
        """One submission; with ``account``, only one of this account. Raises NotFound."""
        folder = self._folder(name)
        return submission_of(folder.definition, _found(folder, submission_id, account), self._clock())

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
        ended = phase_state(found.begins, found.ends, self._clock()) is PhaseState.ENDED
        if ended and found.scores is Reveal.AT_END:
            raise Conflict(
                f"phase {found.name} has ended, and its scores are shown", "add a phase by a challenge of its own"
            )
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

    def _folder(self, name: str) -> ChallengeFolder:
        return challenge_folder(self._settings.challenges_folder, name)


def _found(folder: ChallengeFolder, submission_id: str, account: str | None) -> SubmissionFolder:
    known = {
        entry.root.name: entry for entry in folder.submissions() if account is None or entry.sent.account == account
    }
    if submission_id not in known:
        raise unknown("submission", submission_id[:80], list(known))
    return known[submission_id]


def _latest(folder: ChallengeFolder, now: datetime) -> PhaseEntry:
    """The last phase that has started; the first one if none has."""
    phases = folder.definition.file.phases
    begun = [entry for entry in phases if phase_state(entry.begins, entry.ends, now) is not PhaseState.COMING]
    return begun[-1] if begun else phases[0]
