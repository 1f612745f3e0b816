"""What the store knows about experiments: frozen values, never rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum

from slamhive.domain.configuration import Configuration
from slamhive.domain.parameters import Parameter, Value
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.domain.visibility import Sharing, Visibility


class ExperimentState(StrEnum):
    """What the user last wanted. Whether it has finished follows from its runs."""

    ACTIVE = "active"
    PAUSED = "paused"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class ExperimentRecord:
    """An experiment. ``source`` is the file as the user gave it, ``content_hash`` identifies its content.

    The uids of its runs follow from ``uid`` (32 hex digits). ``repeats`` is for each seed and may have grown since.
    ``cells`` and ``runs`` (without retries) are upper bounds until all are stored, that is, until it is ``complete``.
    ``cpu_model``: that of all its runs, empty while none has been measured, None if any will do.
    ``owner`` and ``visibility``: see :class:`slamhive.domain.visibility.Sharing`; they are those of its runs, too.
    """

    id: int
    uid: str
    name: str
    description: str
    content_hash: str
    source: str
    state: ExperimentState
    executor: str
    priority: int
    repeats: int
    cells: int
    runs: int
    complete: bool
    created_at: datetime
    cpu_model: str | None = None
    owner: str | None = None
    visibility: Visibility | None = None

    @property
    def sharing(self) -> Sharing:
        """Owner and visibility."""
        return Sharing(self.owner, self.visibility)

    @property
    def seen_by(self) -> Visibility:
        """Who sees the experiment besides admins."""
        return self.sharing.seen_by


@dataclass(frozen=True, slots=True)
class NewCell:
    """A cell to store: its configuration, and its value on each axis that applies to it."""

    number: int
    name: str
    configuration_id: int
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class CellRecord:
    """A stored cell."""

    number: int
    name: str
    configuration_id: int
    values: dict[str, Value]


@dataclass(frozen=True, slots=True)
class CellRun:
    """A run of a cell, for tables of cells. ``retried``: a later run replaced it; ``retry_of``: the one it replaced.

    ``disturbed``: it was measured on a disturbed machine; None if that is not known. ``judged``: the stored verdict,
    None if nobody has evaluated it.
    """

    id: int
    cell: int
    seed: int
    state: RunState
    reason: FailureReason | None
    retried: bool
    retry_of: int | None = None
    disturbed: bool | None = None
    protocol: str | None = None
    metrics: dict[str, float] = field(default_factory=dict)
    judged: VerdictKind | None = None


@dataclass(frozen=True, slots=True)
class StateCount:
    """How many runs are in a state for a reason; ``retried`` runs, which another run replaced, count separately.

    ``judged``: their stored verdict, None where nobody has evaluated them.
    """

    state: RunState
    reason: FailureReason | None
    retried: bool
    count: int
    judged: VerdictKind | None = None


@dataclass(frozen=True, slots=True)
class NewConfiguration:
    """A configuration to store; its algorithm and dataset are stored already.

    ``definitions``: the algorithm's parameters; a key without one is filed under its value's own type.
    """

    configuration: Configuration
    content_hash: str
    algorithm_id: int
    dataset_id: int
    definitions: Sequence[Parameter] = ()


@dataclass(frozen=True, slots=True)
class KnownConfiguration:
    """How many runs a stored configuration has, and their mean duration; None if no duration is known."""

    runs: int
    measured_runs: int
    duration_s: float | None
