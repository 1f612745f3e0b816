"""Definition of a challenge: its file, checked, with protocol, metric and scoring; and its folder.

``<data>/challenges/NAME`` holds ``challenge.yaml``, ``state.json``, ``secret/`` (for its owner only) and
``submissions/ID/``. The folder is the truth; the database knows nothing of challenges.

``secret/`` holds ground truths, ``times.json``, ``recordings/`` and ``runs/ID/``. The last is an installation of its
own for the image of one submission.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pydantic import ValidationError

from slamhive.base import strict_yaml
from slamhive.base.bounds import read_record
from slamhive.base.errors import InvalidInput, NotFound, Unavailable, unknown
from slamhive.base.files import remedy_of, sweep_folder
from slamhive.documents.challenge import (
    ChallengeChanges,
    ChallengeFile,
    PhaseEntry,
    SecretTimes,
    SequenceEntry,
    StoredResult,
    StoredRunsDocument,
    StoredSubmission,
)
from slamhive.documents.model import first_problem_at
from slamhive.domain.challenge import Format, Rule, Scoring, Taken
from slamhive.domain.metrics import Direction, Metric, metric
from slamhive.domain.names import check_name
from slamhive.domain.protocol import Association, Protocol, protocol_from_content
from slamhive.evaluation.presets import PRESETS as PROTOCOLS

# Presets: protocol, metric, and the rule that makes one score of many sequences.

MEAN, ETH3D, KITTI, HILTI_2026 = "mean", "eth3d", "kitti", "hilti-2026"
WEIGHT = "kitti.segments"
"""The metric that says how much a sequence weighs in a pooled score."""


@dataclass(frozen=True, slots=True)
class ChallengePreset:
    """One way to count.

    Attributes:
        protocol: Name of the protocol; None if the challenge names it.
        metric: Key of the metric of a sequence; None if the challenge names it.
        worst: The value of a failed sequence, unless the challenge says another; None if there is none by default.
        words: How it counts, for pages.
    """

    protocol: str | None
    metric: str | None
    rule: Rule
    worst: float | None
    format: Format
    words: str


PRESETS: Mapping[str, ChallengePreset] = {
    MEAN: ChallengePreset(None, None, Rule.MEAN, None, Format.TUM, "The mean over all sequences."),
    ETH3D: ChallengePreset(
        "eth3d",
        "ate.rmse",
        Rule.AREA,
        0.10,
        Format.TUM,
        "The area under the curve of how many sequences are better than x, as a percentage of the largest area.",
    ),
    KITTI: ChallengePreset(
        "kitti",
        "kitti.translation",
        Rule.POOLED,
        None,
        Format.KITTI,
        "The mean translation error over the segments of all sequences. Every frame of every sequence is needed.",
    ),
    HILTI_2026: ChallengePreset(
        "hilti-2026",
        "hilti.score",
        Rule.MEAN,
        0.0,
        Format.TUM,
        "The mean score over all sequences: 100 for each pose without an error, 1 for one that is off by 10 m.",
    ),
}


@dataclass(frozen=True)
class Definition:
    """A challenge as its file says it."""

    file: ChallengeFile

    @property
    def preset(self) -> ChallengePreset:
        """Way of counting."""
        return PRESETS[self.file.preset]

    @cached_property
    def protocol(self) -> Protocol:
        """Protocol of each sequence; raises InvalidInput or NotFound."""
        asked = self.preset.protocol or self.file.protocol
        if isinstance(asked, dict):
            return protocol_from_content(asked)
        return PROTOCOLS.get(str(asked)).protocol

    @cached_property
    def metric(self) -> Metric:
        """Metric that counts of a sequence; raises NotFound."""
        return metric(self.preset.metric or str(self.file.metric))

    @property
    def scoring(self) -> Scoring:
        """Points that values are worth."""
        worst = self.preset.worst if self.file.worst is None else self.file.worst
        return Scoring(self.preset.rule, worst, self.metric.direction is Direction.HIGHER)

    @cached_property
    def sequences(self) -> dict[str, SequenceEntry]:
        """The sequences by name."""
        return {entry.name: entry for entry in self.file.sequences}

    def phase(self, name: str) -> PhaseEntry:
        """The phase of a name; raises NotFound."""
        for entry in self.file.phases:
            if entry.name == name:
                return entry
        raise unknown("phase", name[:80], [entry.name for entry in self.file.phases])

    def sequences_of(self, phase: PhaseEntry) -> list[SequenceEntry]:
        """The sequences of a phase, in the order of the challenge."""
        return [entry for entry in self.file.sequences if phase.sequences is None or entry.name in phase.sequences]

    def takes(self, phase: PhaseEntry) -> tuple[Taken, ...]:
        """List what a phase takes: trajectories unless a recording is secret, and images if all recordings are here."""
        entries = self.sequences_of(phase)
        found = () if any(entry.secret for entry in entries) else (Taken.TRAJECTORIES,)
        images = self.file.images is not None and all(entry.recording is not None for entry in entries)
        return (*found, Taken.IMAGES) if images else found


def load_definition(path: Path) -> Definition:
    """Read the file of a challenge; raises InvalidInput that names file, line and what is wrong."""
    content, lines = strict_yaml.parse_with_lines(strict_yaml.read_text(path), str(path))
    try:
        found = ChallengeFile.model_validate(content)
    except ValidationError as error:
        place, problem = first_problem_at(error, ChallengeFile)
        raise InvalidInput(f"{strict_yaml.Places(str(path), lines).of(*place)}: {problem}") from None
    definition = Definition(found)
    try:
        check_name("challenge", found.name)
        for mistake in _problems(definition):
            raise mistake
    except (InvalidInput, NotFound) as error:
        raise InvalidInput(f"{path}: {error.message}", error.remedy) from None
    return definition


def _problems(definition: Definition) -> Iterator[InvalidInput]:
    yield from _problems_of_scoring(definition)
    yield from _problems_of_names(definition)
    for entry in definition.file.sequences:
        times = entry.time_range_s
        if definition.preset.format is Format.KITTI:
            if entry.poses is None or times is not None:
                problem = f"sequence {entry.name} needs poses, and no time_range_s"
                yield InvalidInput(problem, "give its number of frames")
        elif entry.secret and times is None and entry.poses is None:
            pass  # the published file of a challenge does not say when its secret recordings were made
        elif times is None or entry.poses is not None:
            problem = f"sequence {entry.name} needs time_range_s, and no poses"
            yield InvalidInput(problem, "give first and last timestamp of the recording")
        elif times[1] <= times[0]:
            yield InvalidInput(f"time_range_s of sequence {entry.name} does not grow", "write [first, last]")
    yield from _problems_of_images(definition)
    for phase in definition.file.phases:
        if phase.begins is not None and phase.ends is not None and phase.ends <= phase.begins:
            yield InvalidInput(f"phase {phase.name} ends before it begins", "correct begins or ends")


def _problems_of_scoring(definition: Definition) -> Iterator[InvalidInput]:
    file = definition.file
    given = [name for name in ("protocol", "metric") if getattr(file, name) is not None]
    if file.preset == MEAN and len(given) < 2:
        yield InvalidInput("the preset mean needs protocol and metric", "for example protocol: evo, metric: ate.rmse")
    if file.preset != MEAN and given:
        yield InvalidInput(f"the preset {file.preset} says what {given[0]} is", f"leave out {given[0]}")
    if file.preset == MEAN and file.worst is None:
        yield InvalidInput("the preset mean needs worst", "give the value that a failed sequence has")
    if file.preset == ETH3D and definition.scoring.worst is not None and definition.scoring.worst <= 0:
        yield InvalidInput(f"worst {file.worst:g} is not above 0", "give the largest error that counts")
    if file.preset == HILTI_2026 and file.worst is not None:
        yield InvalidInput("the preset hilti-2026 counts a failed sequence as 0", "leave out worst")
    if file.preset == KITTI and (file.worst is not None or file.least_coverage > 0):
        yield InvalidInput("the preset kitti needs every frame", "leave out worst and least_coverage")
    if definition.metric.direction is Direction.NEUTRAL or not definition.metric.needs_protocol:
        yield InvalidInput(f"{definition.metric.key} ranks nobody", "use a metric of an evaluation that can be better")
    if file.preset == MEAN and definition.protocol.association is Association.INDEX:
        yield InvalidInput("the preset mean matches by time", "use a protocol whose association is not index")
    if definition.protocol.reference is not None:
        yield InvalidInput("the protocol names a reference of a dataset", "leave out reference")


def _problems_of_images(definition: Definition) -> Iterator[InvalidInput]:
    file = definition.file
    for entry in file.sequences:
        if entry.secret and entry.recording is None:
            yield InvalidInput(f"sequence {entry.name} is secret, and names no recording", "name the folder of one")
        if entry.recording is not None and file.images is None:
            yield InvalidInput(f"sequence {entry.name} has a recording for images", "say with images how these run")
    if file.images is None:
        return
    if definition.preset.format is Format.KITTI:
        yield InvalidInput("images leave trajectories with timestamps, kitti compares frames", "use the preset mean")
    for phase in file.phases:
        if not definition.takes(phase):
            yield InvalidInput(
                f"phase {phase.name} has a secret recording, and a sequence without a recording",
                "give each of its sequences a recording, or split the phase",
            )
    if not any(Taken.IMAGES in definition.takes(phase) for phase in file.phases):
        yield InvalidInput("no phase can take images", "give each sequence of a phase a recording")


def _problems_of_names(definition: Definition) -> Iterator[InvalidInput]:
    file = definition.file
    for kind, names in (
        ("sequence", [entry.name.casefold() for entry in file.sequences]),
        ("phase", [entry.name.casefold() for entry in file.phases]),
    ):
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            yield InvalidInput(f"two entries name the {kind} {twice}", "give each a name of its own")
    for phase in file.phases:
        for name in phase.sequences or ():
            if name not in definition.sequences:
                found = unknown("sequence", name, list(definition.sequences))
                yield InvalidInput(f"phase {phase.name}: {found.message}")
    for entry in file.sequences:
        check_name("sequence", entry.name)


# -- the folders of challenges: the definition that everybody may know, the secret, and the submissions ----------------


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
        """The names of all submissions, the oldest day first.

        A link is none of them: a web server that was broken into may write here, and the worker stores results there.
        """
        try:
            with os.scandir(self.submissions_root) as entries:
                folders = [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
        except FileNotFoundError:
            return []
        return sorted(name for name in folders if not name.startswith("."))

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
    folders = (entry for entry in root.iterdir() if entry.is_dir() and not entry.is_symlink())
    return sorted(entry.name for entry in folders if not entry.name.startswith("."))


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
