"""Claims of papers and READMEs: the file that states them, and what a check found."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from slamhive.documents.model import Document, Timestamp, described
from slamhive.domain.claim import ClaimedStatistic, ClaimState
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.names import NAME_PATTERN

MOST_CLAIMS = 2000
MOST_REPEATS = 100
_Line = Annotated[str, Field(min_length=1, max_length=300)]
_Name = Annotated[str, Field(pattern=rf"\A{NAME_PATTERN}\z")]


class _Defaults(BaseModel):
    """Fields that stand at the top of the file for all claims, or with one of them."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    source: _Line | None = Field(None, description="Where the numbers are published: paper and table, or an address.")
    protocol: _Line | None = Field(None, description="Name of the protocol of the errors; left out: the default.")
    of: ClaimedStatistic | None = Field(None, description="What a number is of its runs; left out: the mean.")
    runs: int | None = Field(None, ge=1, le=1_000_000, description="How many runs are behind a number.")
    within: _Line | dict[str, _Line] | None = Field(
        None, description="How far our value may differ besides the rounding: 5%, or 1 mm; or that by metric."
    )
    repeats: int | None = Field(None, ge=2, le=MOST_REPEATS, description="How many runs of ours decide; left out: 5.")


class ClaimEntry(_Defaults):
    """Claims about one system on one sequence."""

    algorithm: str = Field(description="Name of the algorithm; NAME@2 is version 2 of its package here.")
    version: _Line | None = Field(None, description="The upstream version that the numbers are of.")
    dataset: str = Field(description="Name of the dataset.")
    parameters: dict[str, Any] = Field(default_factory=dict, description="Values that differ from the defaults.")
    variant: list[Any] = Field(default_factory=list, description="Pre-processing steps of the dataset, in order.")
    sensors: dict[str, str] = Field(default_factory=dict, description="The sensor for a role, where several fit.")
    playback_mode: PlaybackMode = Field(PlaybackMode.REALTIME, description="How the recording is played.")
    playback_rate: float = Field(1.0, ge=0.01, le=100, description="Playback speed.")
    states: dict[str, str] = Field(
        min_length=1, description="By metric, the number as it is printed, with its unit: 0.016 m, 1.6 ± 0.2 cm."
    )


class ClaimsFile(_Defaults):
    """Claims, as `slamhive claims check` reads them."""

    model_config = ConfigDict(title="SLAM Hive claims")

    format: Literal[1]
    name: _Name
    title: _Line
    obtain: dict[str, _Line] = Field(
        default_factory=dict, description="How to get a dataset or algorithm that an installation may lack."
    )
    claims: tuple[ClaimEntry, ...] = Field(min_length=1, max_length=MOST_CLAIMS)


class ClaimProtocol(Document):
    """A protocol under which a claim that differs would hold."""

    words: str
    preset: Annotated[str | None, described("Name of the tool whose rules these are; null if of none.")]
    key: Annotated[str, described("The metric.")]
    value: Annotated[float, described("What the run gives under it, in the printed unit.")]


class ClaimAnswer(Document):
    """Answer about one claim: how far it holds here."""

    about: Annotated[str, described("System, sequence and settings in words.")]
    algorithm: str
    dataset: str
    metric: str
    label: Annotated[str, described("The metric in words.")]
    stated: Annotated[str, described("The number as it is printed.")]
    unit: Annotated[str, described("Of all values here; empty for a pure number.")]
    statistic: Annotated[ClaimedStatistic, described("What the number is of its runs.")]
    source: str
    protocol: Annotated[str, described("Name of the protocol of the claim.")]
    state: ClaimState
    words: Annotated[str, described("The answer in one sentence.")]
    value: Annotated[float | None, described("The same of our good runs; null without one.")] = None
    std: Annotated[float | None, described("Their standard deviation (divisor n - 1); null for a single run.")] = None
    low: Annotated[float | None, described("The claim lies above this number if our runs agree with it.")] = None
    high: Annotated[float | None, described("The claim lies below this number if our runs agree with it.")] = None
    ratio: Annotated[float | None, described("Our value over the stated one; null if there is none.")] = None
    runs: Annotated[tuple[int, ...], described("The runs that count, failed ones among them.")] = ()
    failed: Annotated[tuple[int, ...], described("Those of them that failed.")] = ()
    lacking: Annotated[int, described("How many more runs are needed.")] = 0
    protocols: Annotated[
        tuple[ClaimProtocol, ...], described("Where it differs: protocols under which it would hold, the usual first.")
    ] = ()
    notes: Annotated[tuple[str, ...], described("What limits the answer.")] = ()


class ClaimsAnswer(Document):
    """Answers of the last check of one file of claims."""

    format: Literal[1] = 1
    name: str
    title: str
    words: Annotated[str, described("How many hold: 9 of 12 hold.")]
    checked_at: Timestamp
    software: Annotated[str, described("Version of SLAM Hive that checked.")]
    claims: tuple[ClaimAnswer, ...]
    hidden: Annotated[
        int, described("Claims that are left out: you may not see all their runs, or these are gone.")
    ] = 0


class ClaimsDocument(Document):
    """The last check of every file of claims."""

    files: tuple[ClaimsAnswer, ...]
