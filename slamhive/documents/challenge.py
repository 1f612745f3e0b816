"""A challenge: the file that defines it, what is kept of a submission, and what is shown of both."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from slamhive.base.errors import InvalidInput
from slamhive.documents.api import ApiRequest
from slamhive.documents.imports import Token
from slamhive.documents.model import Document, Moment, Timestamp, described
from slamhive.documents.protocol import StatedProtocol
from slamhive.domain.challenge import Counted, Format, PhaseState, Reveal, Rule, SubmissionState, Taken
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.metrics import Direction
from slamhive.domain.names import NAME_PATTERN

MOST_SEQUENCES = 500
MOST_PER_DAY = 1000
LONGEST_TEXT = 20_000
_LARGEST = 1e9

Name = Annotated[str, Field(pattern=rf"\A{NAME_PATTERN}\z")]
Stamp = Annotated[float, Field(ge=-1e10, le=1e10, allow_inf_nan=False)]
PerDay = Annotated[int, Field(ge=1, le=MOST_PER_DAY)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class SequenceEntry(_Part):
    """A sequence. All but its ground truth is public."""

    name: Name
    data: str = Field("", max_length=1000, description="Where its recording is, in words or as an address.")
    groundtruth: str | None = Field(
        None, max_length=1000, description="The secret trajectory; relative to the file. Kept apart by `create`."
    )
    time_range_s: tuple[Stamp, Stamp] | None = Field(
        None, description="First and last timestamp of the recording (s). Needed for TUM trajectories."
    )
    poses: int | None = Field(None, ge=2, le=10**8, description="Number of frames. Needed for KITTI trajectories.")
    recording: str | None = Field(
        None, max_length=1000, description="Folder of a dataset that images run on; relative to the file. Kept apart."
    )
    secret: bool = Field(False, description="Teams do not have the recording: nothing of its runs is shown to them.")


class ImageRules(_Part):
    """Conditions under which images run. All of it is public, and the same for each sequence."""

    time_limit_s: float = Field(ge=1, le=7 * 86_400, description="Wall-clock limit of a run (s).")
    cpu_cores: float = Field(ge=0.1, le=1024, description="Cores of a run.")
    memory_mb: int = Field(ge=16, le=10_000_000, description="Memory of a run (MB).")
    repeats: int = Field(1, ge=1, le=20, description="Runs on each sequence. Their median counts.")
    seed: int = Field(0, ge=0, le=2**30, description="Seed of the first run; repeats get the next ones.")
    playback: PlaybackMode = Field(PlaybackMode.REALTIME, description="How recordings are played.")
    rate: float = Field(1.0, ge=0.01, le=100, description="Playback speed.")
    largest_mb: int = Field(10_000, ge=1, le=1_000_000, description="Most that an image may have, unpacked (MB).")
    answers_every_h: Literal[1, 2, 3, 4, 6, 8, 12, 24] = Field(
        6, description="Results are shown at multiples of so many hours (UTC), whenever runs end."
    )
    constant_time: bool = Field(
        True, description="Each run takes its slot for the whole time limit, so that nobody learns how long it took."
    )


class PhaseEntry(_Part):
    """A phase."""

    name: Name
    sequences: tuple[Name, ...] | None = Field(None, min_length=1, description="Left out: all.")
    begins: Moment | None = Field(None, description="With UTC offset; left out: it is open from the start.")
    ends: Moment | None = Field(None, description="With UTC offset; left out: it stays open.")
    scores: Reveal = Field(Reveal.AT_ONCE, description="When scores and ranking are shown.")
    submissions_per_day: PerDay | None = Field(None, description="Instead of that of the challenge.")


class ChallengeFile(_Part):
    """A challenge, as `slamhive challenge create` reads it."""

    model_config = ConfigDict(title="SLAM Hive challenge")

    format: Literal[1]
    name: Name
    title: str = Field(min_length=1, max_length=200)
    description: str = Field("", max_length=LONGEST_TEXT, description="Markdown.")
    preset: Literal["mean", "eth3d", "kitti", "hilti-2026"] = Field(description="How values become a score.")
    protocol: str | dict[str, Any] | None = Field(
        None, description="For mean: name of a protocol, or the fields of one, alignment among them."
    )
    metric: str | None = Field(None, max_length=64, description="For mean: key of the metric.")
    worst: float | None = Field(
        None, gt=-_LARGEST, lt=_LARGEST, description="For mean and eth3d: the value of a failed sequence."
    )
    least_coverage: float = Field(
        0.0, ge=0.0, le=1.0, description="A trajectory that covers less of the time range counts as failed."
    )
    submissions_per_day: PerDay = Field(3, description="Of one account and of one team, per phase and day (UTC).")
    digits: int = Field(3, ge=1, le=6, description="Significant digits of all values that are given out.")
    significance: float = Field(0.05, gt=0.0, lt=0.5, description="Level of the test that separates two ranks.")
    counted: Counted = Field(Counted.BEST, description="Which submission of a team is ranked.")
    images: ImageRules | None = Field(None, description="Teams may submit images; how these run.")
    sequences: tuple[SequenceEntry, ...] = Field(min_length=1, max_length=MOST_SEQUENCES)
    phases: tuple[PhaseEntry, ...] = Field(min_length=1, max_length=50)


class ChallengeChanges(Document):
    """``state.json``: what was changed after a challenge was created."""

    format: Literal[1] = 1
    ends: Annotated[dict[str, Moment], described("New ends of phases.")] = Field(default_factory=dict)


class SecretTimes(Document):
    """``secret/times.json``: what is not published of the recordings."""

    format: Literal[1] = 1
    time_ranges_s: Annotated[dict[str, tuple[float, float]], described("First and last timestamp, by sequence.")]


class StoredFile(Document):
    """A trajectory of a submission, judged by public facts alone."""

    poses: int
    coverage: Annotated[float | None, described("Share of the public time range; null for KITTI trajectories.")]
    enough: Annotated[bool, described("Whether it covers as much as the challenge asks for.")]


class StoredImage(Document):
    """The image of a submission."""

    package: Annotated[str | None, described("Null: the archive has no package, and one is drafted for it.")]
    algorithm: Annotated[str | None, described("Which algorithm of the package; null: its only one.")]
    version: Annotated[int | None, described("Of a package of the server; null: the image came as an archive.")] = None
    identity: Annotated[str | None, described("Digest of the image of that version.")] = None


class StoredSubmission(Document):
    """``submission.json``: what was sent."""

    format: Literal[1] = 1
    id: str
    phase: str
    team: str
    account: str
    at: Moment
    digest: Annotated[str, described("SHA-256 of names and contents of its files.")]
    files: dict[str, StoredFile]
    image: Annotated[StoredImage | None, described("Null: it consists of trajectories.")] = None


class StoredRun(Document):
    """A run of an image that has ended."""

    sequence: str
    run: Annotated[int | None, described("Its number in the installation of the submission; null: none was made.")]
    failure: Annotated[str | None, described("Why there is no trajectory, in the words of submitters.")]


class StoredRunsDocument(Document):
    """``runs.json``: all runs of an image. It is as secret as the recordings."""

    format: Literal[1] = 1
    runs: tuple[StoredRun, ...]


class StoredResult(Document):
    """``result.json``: what came of it. It holds rounded values only."""

    format: Literal[1] = 1
    shown_at: Moment
    values: dict[str, float | None]
    weights: Annotated[dict[str, float], described("Segments of each sequence, for a pooled score.")]
    failure: str | None
    reasons: Annotated[dict[str, str], described("Why sequences have no value; of images only.")] = Field(
        default_factory=dict
    )


class ChallengeSequence(Document):
    """Public facts about a sequence."""

    name: str
    data: str
    time_range_s: tuple[float, float] | None
    poses: int | None
    secret: Annotated[bool, described("Whether teams do not have the recording.")]


class ChallengePhase(Document):
    """A phase as it is now."""

    name: str
    state: PhaseState
    begins: Timestamp | None
    ends: Timestamp | None
    sequences: tuple[str, ...]
    takes: Annotated[tuple[Taken, ...], described("What may be submitted.")]
    submissions_per_day: int
    scores: Reveal
    scores_shown: Annotated[bool, described("Whether scores and ranking are shown now.")]


class ChallengeBrief(Document):
    """A challenge as lists show it."""

    name: str
    title: str
    preset: str
    sequences: int
    open_phases: tuple[str, ...]


class ChallengesDocument(Document):
    """All challenges."""

    challenges: tuple[ChallengeBrief, ...]


class Challenge(Document):
    """Everything about a challenge that is public."""

    name: str
    title: str
    description: Annotated[str, described("Markdown.")]
    preset: str
    counts: Annotated[str, described("How it counts, in words.")]
    trajectories: Annotated[Format, described("Their format.")]
    protocol: StatedProtocol
    metric: str
    unit: Annotated[str, described("Of the values of sequences; empty for a pure number.")]
    direction: Annotated[Direction, described("Which way is better, of the values of sequences.")]
    rule: Rule
    score_unit: str
    worst: Annotated[float | None, described("The value of a failed sequence; null if each one is needed.")]
    least_coverage: float
    digits: int
    significance: float
    counted: Counted
    images: Annotated[ImageRules | None, described("How images run; null: none may be submitted.")]
    sequences: tuple[ChallengeSequence, ...]
    phases: tuple[ChallengePhase, ...]


class ChallengeSubmission(Document):
    """A submission as its team sees it."""

    id: str
    phase: str
    team: str
    at: Timestamp
    state: SubmissionState
    reason: Annotated[str | None, described("Why it failed.")]
    image: Annotated[str | None, described("Its package; null for trajectories.")]
    log: tuple[str, ...]
    run_logs: Annotated[dict[str, str], described("What an image printed, by run on a public recording.")]
    values: Annotated[dict[str, float | None] | None, described("By sequence; null while they are not shown.")]
    score: Annotated[float | None, described("Null while it is not shown.")]


class ChallengeSubmissions(Document):
    """Submissions of the caller, the newest first."""

    submissions: tuple[ChallengeSubmission, ...]


class RankedTeam(Document):
    """A team in a ranking."""

    rank: int
    team: str
    score: float
    low: Annotated[float | None, described("Of the 95 % interval; null for a single sequence.")]
    high: float | None
    tied: Annotated[bool, described("Whether others share the rank, because no test separates them.")]
    at: Annotated[datetime, described("When the counted submission was sent.")]
    values: dict[str, float | None]


class ChallengeRanking(Document):
    """The ranking of a phase."""

    challenge: str
    phase: str
    shown: Annotated[bool, described("False while the scores of the phase are hidden.")]
    shown_from: Annotated[Timestamp | None, described("When hidden scores will be shown; null if nobody knows.")]
    test: Annotated[str, described("The test that separates ranks, in words.")]
    teams: tuple[RankedTeam, ...]


# What a request to a challenge may say.


class ImageEntry(ApiRequest):
    """An image for a challenge: an upload, or a version of a package of the server."""

    upload: Annotated[
        Token | None, described("What `slamhive algorithm export` or `docker save` wrote; removed afterwards.")
    ] = None
    package: Annotated[str | None, described("NAME@NUMBER, or NAME for its newest version.", max_length=200)] = None
    algorithm: Annotated[
        str | None, described("Which algorithm of the package; null: its only one.", max_length=200)
    ] = None
    team: Annotated[str, described("The team; empty: the account.", max_length=64)] = ""
    phase: Annotated[str, described("The phase; empty: the only one that is open.", max_length=64)] = ""

    def check(self) -> None:
        """Raise InvalidInput unless it names either an upload or a package."""
        if (self.upload is None) == (self.package is None):
            raise InvalidInput("an image is either a file or a package", "name one of them")
