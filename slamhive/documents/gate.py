"""A gate: the baseline that a file holds, and the answer of a check."""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated, Literal

from pydantic import Field

from slamhive.documents.limits import Limits
from slamhive.documents.model import Document, Moment, described
from slamhive.documents.protocol import StatedProtocol
from slamhive.documents.record import ConfigurationContent
from slamhive.documents.run import ProtocolName
from slamhive.domain.configuration import Variant
from slamhive.domain.gate import Agreement, Answer, BisectOutcome, TrialStanding
from slamhive.domain.metrics import Direction
from slamhive.domain.verdict import VerdictKind

LARGEST_VALUE = 1e15
"""Of a metric in a baseline, in its unit: sums and ratios of values stay finite."""
Value = Annotated[float, Field(ge=-LARGEST_VALUE, le=LARGEST_VALUE, allow_inf_nan=False)]


class MeasuredRun(Document):
    """One run with its values."""

    uid: Annotated[str, described("Identifies the run in every installation.")]
    version: Annotated[str | None, described("The version of its package that ran, such as aloam@2.")]
    seed: int
    executor: str
    cpu_model: Annotated[str | None, described("Processor of its machine; null if unknown.")]
    limits: Limits
    disturbed: Annotated[bool | None, described("Whether the machine was disturbed; null if unknown.")]
    failed: Annotated[VerdictKind | None, described("Why the run counts as failed; null for a good run.")]
    metrics: Annotated[dict[str, Value], described("Values by metric, in the units of the catalogue.")]


class BaselineConfiguration(ConfigurationContent):
    """One configuration and its runs, all evaluated under one protocol."""

    dataset_checksum: Annotated[str | None, described("Of the dataset that the runs used; null if unknown.")]
    protocol: Annotated[StatedProtocol, described("The protocol of the errors.")]
    runs: Annotated[tuple[MeasuredRun, ...], described("Its runs, failed ones included.", min_length=1)]

    @property
    def words(self) -> str:
        """``eye-slam-mono on room``, with the steps."""
        return "; ".join([f"{self.algorithm} on {self.dataset}", *map(str, self.variant)])

    @property
    def settings(self) -> dict[str, str]:
        """All else that distinguishes it from other configurations of an algorithm on a dataset, in words."""
        values = {
            key: f"{value:.6g}" if isinstance(value, float) else str(value) for key, value in self.parameters.items()
        }
        started = {} if self.map is None else {"map": self.map.content}
        return {**values, **self.sensors, **started, "playback": f"{self.playback.mode} × {self.playback.rate:g}"}


class Baseline(Document):
    """A frozen set of runs that later runs are compared with. The file needs no other."""

    format: Literal[1] = 1
    name: str
    made_at: Moment
    software: Annotated[str, described("The version of SLAM Hive that wrote the file.")]
    where: Annotated[str, described("The filter that selected the runs.")]
    configurations: Annotated[tuple[BaselineConfiguration, ...], described("What its runs executed.", min_length=1)]

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each configuration, with the settings in which those of the same words differ."""
        used: dict[tuple[str, str], set[str]] = defaultdict(set)
        for entry in self.configurations:
            for key, text in entry.settings.items():
                used[entry.words, key].add(text)
        return tuple(
            ", ".join(
                [
                    entry.words,
                    *(f"{key}={text}" for key, text in entry.settings.items() if len(used[entry.words, key]) > 1),
                ]
            )
            for entry in self.configurations
        )

    @property
    def runs(self) -> int:
        """The number of its runs."""
        return sum(len(entry.runs) for entry in self.configurations)

    @property
    def failed(self) -> int:
        """The number of its failed runs."""
        return sum(run.failed is not None for entry in self.configurations for run in entry.runs)

    @property
    def measured(self) -> frozenset[str]:
        """The metrics that a good run of it has a value of."""
        runs = (run for entry in self.configurations for run in entry.runs)
        return frozenset(key for run in runs if run.failed is None for key in run.metrics)


class BaselineBrief(Document):
    """Entry in a list of baselines."""

    name: str
    made_at: Moment
    algorithms: tuple[str, ...]
    datasets: tuple[str, ...]
    configurations: int
    runs: int
    failed: int


class GateConfiguration(Document):
    """One configuration of a check."""

    algorithm: str
    dataset: str
    words: Annotated[str, described("The configuration in words.")]
    protocol: ProtocolName
    baseline_runs: int
    baseline_failed: int
    runs: Annotated[tuple[int, ...], described("Numbers of the runs that were checked.")]
    failed: Annotated[tuple[int, ...], described("Those of them that failed.")]
    versions: Annotated[tuple[str, ...], described("The versions that ran.")]


class GateValues(Document):
    """One metric in one configuration."""

    configuration: Annotated[int, described("Its place in the list of configurations, from 0.")]
    baseline: Annotated[float | None, described("Median of the good runs; for failures the share of failed runs.")]
    candidate: Annotated[float | None, described("The same of the runs that were checked.")]
    p_worse: Annotated[float, described("p value of it being worse than the margin here, uncorrected.")]
    p_within: Annotated[float | None, described("p value of it being within the margin here; null for failures.")]


class MetricChange(Document):
    """Change of a metric, beside its margin."""

    key: str
    label: str
    unit: str
    better: Direction
    margin: Annotated[str, described("How far it may change.")]
    change: Annotated[float | None, described("Typical change of the median: a share, or in the unit of the metric.")]
    change_low: Annotated[float | None, described("Lower end of its 95 % interval.")]
    change_high: Annotated[float | None, described("Upper end of its 95 % interval.")]
    change_relative: Annotated[bool, described("Whether the change is a share of what it was.")]


class GateMetric(MetricChange):
    """The answer for one metric."""

    answer: Answer
    p_worse: Annotated[float, described("p value of it being worse than the margin, corrected for all metrics.")]
    p_within: Annotated[
        float | None,
        described("p value of it being within the margin; null for failures, whose shares are compared as they are."),
    ]
    configurations: tuple[GateValues, ...]


class GateAnswer(Document):
    """The answer of a check."""

    baseline: str
    answer: Answer
    words: Annotated[str, described("The answer in one sentence.")]
    significance: Annotated[float, described("The largest chance of a false alarm.")]
    looks: Annotated[int, described("How often the runs were compared until this answer.")]
    metrics: tuple[GateMetric, ...]
    configurations: tuple[GateConfiguration, ...]
    missing: Annotated[tuple[str, ...], described("Configurations of the baseline without a run to check.")]
    notes: Annotated[tuple[str, ...], described("What limits the answer.")]


# The answer of a search for the commit that made runs worse.


class CommitDocument(Document):
    """A commit of a Git repository."""

    commit: Annotated[str, described("Its full hash.")]
    subject: str
    author: str
    date: Annotated[str, described("When it was written, as the author's clock said it (ISO 8601).")]


class TriedRuns(Document):
    """The runs of a commit or of a clip."""

    runs: Annotated[tuple[int, ...], described("Their numbers, in order.")]
    failed: Annotated[int, described("How many of them failed.")]
    mean: Annotated[float | None, described("Mean of the good ones, over the datasets; null without one.")]
    std: Annotated[float | None, described("Standard deviation of a good one; null for fewer than two.")]


class BisectStep(CommitDocument, TriedRuns):
    """A commit that was tried."""

    standing: Annotated[TrialStanding, described("Good, bad, or skipped because nothing can be said of it.")]
    reason: Annotated[str, described("Why it was skipped; empty if it was not.")]
    version: Annotated[str | None, described("The version of the package that it was built as; null if it was not.")]
    e_value: Annotated[
        float | None,
        described("Evidence for the answer; without a difference it exceeds 1 / p with a chance of at most p."),
    ]


class BisectAnswer(Document):
    """The answer of a search for the first bad commit."""

    answer: BisectOutcome
    words: Annotated[str, described("The answer in one sentence.")]
    repository: str
    good: CommitDocument
    bad: CommitDocument
    algorithm: str
    datasets: tuple[str, ...]
    metric: str
    label: str
    unit: str
    difference: Annotated[str, described("How much worse is allowed.")]
    error: Annotated[float, described("The largest chance that the answer is false.")]
    commits: Annotated[int, described("Commits after the good one, up to the bad one.")]
    decisions: Annotated[int, described("Commits that runs decided, the bad end included.")]
    runs: Annotated[int, described("All runs that were made.")]
    left: Annotated[tuple[CommitDocument, ...], described("What may be the first bad commit, the oldest first.")]
    before: Annotated[BisectStep | None, described("The last good commit; null while it is not known.")]
    after: Annotated[BisectStep | None, described("The first bad commit; null while it is not known.")]
    steps: Annotated[tuple[BisectStep, ...], described("What was tried: both ends, then in order.")]
    notes: Annotated[tuple[str, ...], described("What limits the answer.")]


# The answer of a search for the shortest clip that shows what is wrong with a run.


class ShrinkStep(TriedRuns):
    """A clip that was tried."""

    begin_s: Annotated[float, described("From the beginning of what the run saw.")]
    end_s: float
    standing: Annotated[
        TrialStanding, described("Bad if it shows the fault; what is skipped counts as not showing it.")
    ]
    words: Annotated[str, described("What was found, in words.")]
    e_value: Annotated[
        float | None,
        described("Evidence for the answer; without a difference it exceeds 1 / p with a chance of at most p."),
    ]


class ShrinkAnswer(Document):
    """The answer of a search for the shortest clip."""

    answer: BisectOutcome
    words: Annotated[str, described("The answer in one sentence.")]
    run: int
    dataset: str
    fault: Annotated[str, described("What is wrong with the run, in words.")]
    begin_s: Annotated[float, described("From the beginning of what the run saw.")]
    end_s: float
    recording_s: Annotated[float, described("How long that was.")]
    variant: Annotated[Variant, described("The steps that make the clip, with times since 1970.")]
    sensors: Annotated[tuple[str, ...], described("The sensors that it holds.")]
    left_out: Annotated[tuple[str, ...], described("The sensors that nothing needs.")]
    folder: Annotated[str | None, described("Where it was written; null if the budget was spent before.")]
    size_bytes: int | None
    error: Annotated[float, described("The largest chance that an answer about a clip is false.")]
    decisions: Annotated[int, described("Clips that were decided, the whole included.")]
    runs: Annotated[int, described("All runs that were made.")]
    steps: Annotated[tuple[ShrinkStep, ...], described("What was tried, in order.")]
    notes: tuple[str, ...]


# The answer of a replay: whether what ran again agrees with what a bundle recorded.


class ReplayVersion(Document):
    """The version of a package that ran."""

    label: Annotated[str, described("Its number in this installation, such as aloam@2.")]
    identity: Annotated[str, described("Digest of the image, or hash of the environment.")]


class ReplayConfiguration(Document):
    """One configuration: its recorded runs, and its repeats."""

    algorithm: str
    dataset: str
    words: Annotated[str, described("The configuration in words.")]
    protocol: ProtocolName
    recorded_version: ReplayVersion
    version: Annotated[ReplayVersion, described("The version that ran again.")]
    rebuilt: Annotated[bool, described("Whether it was built again, so that it is another image or environment.")]
    recorded_runs: Annotated[tuple[int, ...], described("Numbers of the recorded runs in this installation.")]
    recorded_failed: int
    runs: Annotated[tuple[int, ...], described("Numbers of the repeats.")]
    failed: Annotated[tuple[int, ...], described("Those of them that failed.")]
    identical: Annotated[
        int, described("Repeats whose trajectory is the same, byte for byte, as that of a recorded run.")
    ]


class ReplayValues(Document):
    """One metric in one configuration."""

    configuration: Annotated[int, described("Its place in the list of configurations, from 0.")]
    recorded: Annotated[float | None, described("Median of the good recorded runs; for failures the share of them.")]
    repeats: Annotated[float | None, described("The same of the repeats.")]
    repeats_low: Annotated[float | None, described("Lower end of the 95 % interval of their median.")]
    repeats_high: Annotated[float | None, described("Upper end; null for fewer than 6 good repeats.")]
    p_differs: Annotated[float, described("p value of the two differing by more than the margin here, uncorrected.")]
    p_within: Annotated[float | None, described("p value of them being within the margin here; null for failures.")]


class ReplayMetric(MetricChange):
    """The answer for one metric."""

    answer: Agreement
    p_differs: Annotated[float, described("p value of a difference larger than the margin, corrected for all metrics.")]
    p_within: Annotated[float | None, described("p value of both one-sided tests (TOST); null for failures.")]
    configurations: tuple[ReplayValues, ...]


class ReplayAnswer(Document):
    """The answer of a replay."""

    bundle: Annotated[str, described("Name of the file.")]
    answer: Agreement
    words: Annotated[str, described("The answer in one sentence.")]
    significance: Annotated[float, described("The largest chance that a difference, or an agreement, is false.")]
    metrics: tuple[ReplayMetric, ...]
    configurations: tuple[ReplayConfiguration, ...]
    notes: Annotated[tuple[str, ...], described("What limits the answer.")]
