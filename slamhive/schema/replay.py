"""The answer of a replay: whether what ran again agrees with what a bundle recorded."""

from __future__ import annotations

from typing import Annotated

from slamhive.domain.replay import Agreement
from slamhive.schema.fields import described
from slamhive.schema.gate import MetricChange
from slamhive.schema.model import Document
from slamhive.schema.run import ProtocolName


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
