"""The lines of the ledger. Rows that were stored together share a line, and a row is a list without keys."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import AliasChoices, Field, FiniteFloat
from pydantic import StrictInt as Whole

from slamhive.domain.configuration import Configuration, InputMap, Playback, PlaybackMode
from slamhive.domain.variant import Variant
from slamhive.domain.visibility import Visibility
from slamhive.schema.fields import described
from slamhive.schema.limits import NEVER
from slamhive.schema.model import Document
from slamhive.schema.protocol import StatedProtocol
from slamhive.schema.types import Definitions, Moment, Rules, Uid, Values


class ConfigurationRow(NamedTuple):
    """A configuration with its number."""

    id: Whole
    algorithm: str
    dataset: str
    parameters: Values
    mode: PlaybackMode
    rate: FiniteFloat
    variant: Variant
    sensors: dict[str, str] = {}  # noqa: RUF012 - a field of a named tuple, which nobody changes
    version: Whole | None = None
    map: InputMap | None = None

    @property
    def configuration(self) -> Configuration:
        """What exactly is run."""
        playback, steps = Playback(self.mode, self.rate), self.variant
        more = (self.sensors, self.version, self.map)
        return Configuration(self.algorithm, self.dataset, self.parameters, playback, steps, *more)


class ConfigurationsLine(Document):
    """Configurations that were stored together."""

    at: Moment
    parameters: Definitions
    configurations: tuple[ConfigurationRow, ...] = ()


class LabelLine(Document):
    """What users say about a configuration."""

    label: Annotated[int, described("Number of the configuration.")]
    name: str | None
    note: str
    groups: tuple[str, ...]


class RunRow(NamedTuple):
    """What distinguishes a run from the others of its line."""

    id: Whole
    uid: Uid
    configuration_id: Whole
    seed: Whole
    cell: Whole | None
    retry_of: Whole | None


class SharedRequest(Document):
    """What the runs of a line have in common. A new option has a default, so that older lines can be read."""

    executor: str
    priority: int = 0
    evaluate: bool = False
    cpu_cores: float | None = None
    memory_mb: int | None = None
    timeout_s: float | None = None
    affinity: str = ""
    repeat_disturbed: int = 0
    experiment: Annotated[str | None, described("The uid of their experiment.")]
    protocol: StatedProtocol | None
    stop_when: Rules = NEVER
    owner: str | None = None
    visibility: Visibility | None = None


class RunsLine(Document):
    """Runs that were queued together."""

    at: Moment
    request: SharedRequest
    runs: tuple[RunRow, ...] = ()


class CellRow(NamedTuple):
    """A cell of an experiment with its value on each axis."""

    number: Whole
    name: str
    configuration_id: Whole
    values: Values


class CellsLine(Document):
    """Cells of one experiment."""

    experiment: Annotated[str, described("The uid of the experiment.")]
    cells: tuple[CellRow, ...] = ()


class CancelledLine(Document):
    """Runs that were cancelled while they waited."""

    cancelled: tuple[int, ...]
    at: Moment
    why: str


class SharedLine(Document):
    """Owner and readers of runs that have no folder yet; later lines and the folder of a run override it."""

    shared: tuple[int, ...]
    owner: Annotated[str | None, described("Null also for a run of an experiment, whose owner it has.")]
    visibility: Visibility | None


class AskedLine(Document):
    """Evaluations that were queued together."""

    at: Moment
    protocol: StatedProtocol
    artefacts: str
    asked: Annotated[tuple[int, ...], described("Numbers of the runs.")]


class EndedLine(Document):
    """An evaluation that has ended. The line of its request holds the protocol."""

    ended: Annotated[int, described("Number of the run.")]
    protocol: Annotated[str, described("Fingerprint.")]
    state: str
    reason: str | None
    artefacts: str
    engine: str | None
    times: Annotated[
        tuple[Moment, Moment | None, Moment | None], described("When it was requested, when it began, when it ended.")
    ]
    attempt: int


class VersionRow(Document):
    """A version without a number, as lines of algorithms held it before versions had numbers."""

    identity: str
    package_hash: str
    version: str
    created_at: Moment


class AlgorithmLine(Document):
    """An algorithm that runs are stored for."""

    algorithm: str = Field(validation_alias=AliasChoices("name", "algorithm"))
    package: str
    mode: str
    versions: tuple[VersionRow, ...] = ()


class VersionLine(VersionRow):
    """A version of a package."""

    versions_of: Annotated[str, described("The package.")] = Field(
        validation_alias=AliasChoices("package", "versions_of")
    )
    number: Annotated[int, described("Counts the versions of the package.")]
    removed_at: Annotated[Moment | None, described("When its image was removed on purpose.")] = None


LedgerLine = (
    AlgorithmLine
    | VersionLine
    | ConfigurationsLine
    | LabelLine
    | CellsLine
    | RunsLine
    | CancelledLine
    | SharedLine
    | AskedLine
    | EndedLine
)
"""Lines of all books of the ledger, apart from bare lists of numbers."""
