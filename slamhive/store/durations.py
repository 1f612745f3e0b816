"""Durations of past runs and evaluations, from which those of others are estimated; and on which CPU models they were.

The column ``cpu_model`` of an experiment is NULL if any CPU will do, :data:`NOT_KNOWN` until one is known, and that CPU
model from then on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import median, stdev

from sqlalchemy import ColumnElement, Integer, and_, case, cast, exists, func, select, update

from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    AlgorithmRow,
    AlgorithmVersionRow,
    ConfigurationRow,
    DatasetRow,
    EvaluationRow,
    ExperimentRow,
    HostRow,
    MetricRow,
    MetricValueRow,
    RunEventRow,
    RunRow,
)
from slamhive.store.records import EvaluationState, KnownConfiguration
from slamhive.store.rows import Repository, chunks, sample_variance

DURATION = "duration"
_PAIRING = (AlgorithmRow.name, DatasetRow.name, ConfigurationRow.playback_mode, ConfigurationRow.playback_rate)
_ENDED = tuple(state for state in RunState if state.ended)
_ACTIVE = tuple(state for state in RunState if state.active)
_BUILT = select(AlgorithmVersionRow.package).where(AlgorithmVersionRow.removed_at.is_(None))
_LEAST_BUILD = timedelta(seconds=5)
"""A shorter preparation built nothing."""
_LATEST = 50
"""So many of the latest runs and evaluations are looked at for a median."""
Pairing = tuple[str, str, PlaybackMode, float]
"""Algorithm, dataset, playback mode and rate."""


@dataclass(frozen=True, slots=True)
class Measured:
    """The duration of ``n``: mean or median, and standard deviation, which is 0 for a single one."""

    n: int
    seconds: float
    std_s: float


@dataclass(frozen=True, slots=True)
class Unfinished:
    """The number of runs that have not ended, and of those among them that will be evaluated."""

    runs: int
    to_evaluate: int


@dataclass(frozen=True, slots=True)
class ActiveRun:
    """A run that a worker has claimed."""

    id: int
    claimed_at: datetime
    state: RunState = RunState.RUNNING
    package: str = ""


@dataclass(frozen=True, slots=True)
class MachineRuns:
    """Runs that ended on machines with the same processor.

    ``judged`` of ``runs`` know whether they were disturbed, ``disturbed`` of these were.
    """

    cpu_model: str
    cpu_count: int
    runs: int
    judged: int
    disturbed: int


class DurationRepository(Repository):
    """Durations of runs, evaluations and builds."""

    def of_configurations(self, content_hashes: Sequence[str]) -> dict[str, KnownConfiguration]:
        """The runs and durations of those configurations that are stored, by content hash."""
        found: dict[str, KnownConfiguration] = {}
        for part in chunks(content_hashes):
            query = (
                select(
                    ConfigurationRow.content_hash,
                    func.count(RunRow.id).label("runs"),
                    func.count(MetricValueRow.value).label("measured"),
                    func.avg(MetricValueRow.value).label("duration_s"),
                )
                .outerjoin(RunRow, RunRow.configuration_id == ConfigurationRow.id)
                .outerjoin(MetricValueRow, self._is_duration())
                .where(ConfigurationRow.content_hash.in_(part))
                .group_by(ConfigurationRow.content_hash)
            )
            for row in self._connection.execute(query):
                found[row.content_hash] = KnownConfiguration(row.runs, row.measured, row.duration_s)
        return found

    def of_pairings(self, experiment_id: int | None = None) -> dict[Pairing, Measured]:
        """Of each algorithm on each dataset, of all runs or of those of an experiment."""
        among = [] if experiment_id is None else [RunRow.experiment_id == experiment_id]
        query = (
            select(
                *_PAIRING,
                func.count(),
                func.avg(MetricValueRow.value),
                func.avg(MetricValueRow.value * MetricValueRow.value),
            )
            .select_from(RunRow)
            .join(MetricValueRow, self._is_duration())
            .join(ConfigurationRow, ConfigurationRow.id == RunRow.configuration_id)
            .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
            .join(DatasetRow, DatasetRow.id == ConfigurationRow.dataset_id)
            .where(*among)
            .group_by(*_PAIRING)
        )
        found: dict[Pairing, Measured] = {}
        for algorithm, dataset, mode, rate, n, mean_s, mean_square_s2 in self._connection.execute(query):
            std_s = math.sqrt(sample_variance(n, mean_s, mean_square_s2))
            found[algorithm, dataset, mode, rate] = Measured(n, mean_s, std_s)
        return found

    def unfinished(self, experiment_id: int) -> dict[Pairing, Unfinished]:
        """The runs of an experiment that have not ended, of each algorithm on each dataset."""
        query = (
            select(*_PAIRING, func.count(), func.sum(cast(RunRow.evaluate, Integer)))
            .select_from(RunRow)
            .join(ConfigurationRow, ConfigurationRow.id == RunRow.configuration_id)
            .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
            .join(DatasetRow, DatasetRow.id == ConfigurationRow.dataset_id)
            .where(RunRow.experiment_id == experiment_id, RunRow.state.not_in(_ENDED))
            .group_by(*_PAIRING)
        )
        return {
            (row[0], row[1], row[2], row[3]): Unfinished(row[4], int(row[5])) for row in self._connection.execute(query)
        }

    def active(self, experiment_id: int) -> list[ActiveRun]:
        """The runs of an experiment that workers have claimed; there are at most as many as slots."""
        query = (
            select(RunEventRow.run_id, func.max(RunEventRow.at), RunRow.state, AlgorithmRow.package)
            .join(RunRow, RunRow.id == RunEventRow.run_id)
            .join(ConfigurationRow, ConfigurationRow.id == RunRow.configuration_id)
            .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
            .where(
                RunRow.experiment_id == experiment_id,
                RunRow.state.in_(_ACTIVE),
                RunEventRow.to_state == RunState.PREPARING,
            )
            .group_by(RunEventRow.run_id, RunRow.state, AlgorithmRow.package)
        )
        return [ActiveRun(*row) for row in self._connection.execute(query)]

    def unbuilt(self, experiment_id: int) -> list[str]:
        """The packages of runs that have not ended, of which no version was ever built here."""
        query = (
            select(AlgorithmRow.package)
            .distinct()
            .select_from(RunRow)
            .join(ConfigurationRow, ConfigurationRow.id == RunRow.configuration_id)
            .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
            .where(RunRow.experiment_id == experiment_id, RunRow.state.not_in(_ENDED))
            .where(AlgorithmRow.package.not_in(_BUILT))
        )
        return list(self._connection.scalars(query))

    def built(self) -> set[str]:
        """The packages of which a version was built here."""
        return set(self._connection.scalars(_BUILT))

    def build(self) -> Measured | None:
        """The time to build a package: the median wait of the first runs of versions, None if there are none.

        A version that was built before its first run says nothing about it.
        """
        firsts = (
            select(func.min(RunRow.id).label("id"))
            .where(RunRow.algorithm_version_id.is_not(None))
            .group_by(RunRow.algorithm_version_id)
            .order_by(func.min(RunRow.id).desc())
            .limit(_LATEST)
            .subquery()
        )
        moves = (
            select(RunEventRow.run_id, RunEventRow.to_state, RunEventRow.at)
            .join(firsts, firsts.c.id == RunEventRow.run_id)
            .where(RunEventRow.to_state.in_((RunState.PREPARING, RunState.STARTING)))
        )
        at: dict[RunState, dict[int, datetime]] = {RunState.PREPARING: {}, RunState.STARTING: {}}
        for run_id, state, moved_at in self._connection.execute(moves.order_by(RunEventRow.id)):
            at[state][run_id] = moved_at
        claimed, starting = at[RunState.PREPARING], at[RunState.STARTING]
        times = [starting[run_id] - claimed[run_id] for run_id in claimed.keys() & starting.keys()]
        return _measured([time for time in times if time >= _LEAST_BUILD])

    def overhead(self) -> Measured | None:
        """The time from claim to end that a run does not spend running: the median of the latest runs, None if none."""
        query = (
            select(RunRow.id, RunRow.started_at, RunRow.ended_at)
            .where(RunRow.state.in_(_ENDED), RunRow.started_at.is_not(None), RunRow.ended_at.is_not(None))
            .order_by(RunRow.ended_at.desc())
            .limit(_LATEST)
        )
        ran = {row.id: row.ended_at - row.started_at for row in self._connection.execute(query)}
        moves = select(RunEventRow.run_id, RunEventRow.to_state, RunEventRow.at).where(RunEventRow.run_id.in_(ran))
        claimed: dict[int, datetime] = {}
        ended: dict[int, datetime] = {}
        for run_id, state, at in self._connection.execute(moves.order_by(RunEventRow.id)):
            if state is RunState.PREPARING:
                claimed[run_id] = at
            elif state.ended:
                ended[run_id] = at
        known = claimed.keys() & ended.keys()
        return _measured([ended[run_id] - claimed[run_id] - ran[run_id] for run_id in known])

    def open_evaluations(self, experiment_id: int) -> int:
        """The number of evaluations of an experiment's runs that wait or are under way."""
        query = select(func.count()).select_from(EvaluationRow).join(RunRow, RunRow.id == EvaluationRow.run_id)
        states = (EvaluationState.QUEUED, EvaluationState.RUNNING)
        found = self._connection.scalar(
            query.where(RunRow.experiment_id == experiment_id, EvaluationRow.state.in_(states))
        )
        return found or 0

    def by_machine(self, since: datetime) -> list[MachineRuns]:
        """The runs that succeeded or failed after ``since``, by processor, the most used first."""
        disturbed = func.sum(case((RunRow.disturbed_by > "", 1), else_=0))
        query = (
            select(HostRow.cpu_model, HostRow.cpu_count, func.count(), func.count(RunRow.disturbed_by), disturbed)
            .select_from(RunRow)
            .join(HostRow, HostRow.id == RunRow.host_id)
            .where(RunRow.ended_at >= since, RunRow.state.in_((RunState.SUCCEEDED, RunState.FAILED)))
            .group_by(HostRow.cpu_model, HostRow.cpu_count)
            .order_by(func.count().desc(), HostRow.cpu_model, HostRow.cpu_count)
        )
        return [MachineRuns(row[0], row[1], row[2], row[3], int(row[4])) for row in self._connection.execute(query)]

    def queued(self) -> dict[str, int]:
        """The number of runs that wait for each executor."""
        query = select(RunRow.executor, func.count()).where(RunRow.state == RunState.QUEUED).group_by(RunRow.executor)
        return {row[0]: row[1] for row in self._connection.execute(query)}

    def evaluation(self) -> Measured | None:
        """The time of an evaluation: the median of the latest, None if none has ended well."""
        query = (
            select(EvaluationRow.started_at, EvaluationRow.ended_at)
            .where(EvaluationRow.state == EvaluationState.SUCCEEDED)
            .order_by(EvaluationRow.id.desc())
            .limit(_LATEST)
        )
        return _measured([ended - started for started, ended in self._connection.execute(query) if started and ended])

    def _is_duration(self) -> ColumnElement[bool]:
        metric_id = select(MetricRow.id).where(MetricRow.key == DURATION).scalar_subquery()
        return and_(
            MetricValueRow.run_id == RunRow.id,
            MetricValueRow.metric_id == metric_id,
            MetricValueRow.protocol_id == MEASURED_PROTOCOL_ID,
        )


def _measured(times: Sequence[timedelta]) -> Measured | None:
    """Their median and standard deviation; None if there are none."""
    if not times:
        return None
    times_s = [time.total_seconds() for time in times]
    return Measured(len(times_s), max(0.0, median(times_s)), stdev(times_s) if len(times_s) > 1 else 0.0)


# -- experiments whose runs stay on one CPU model: which runs a worker may claim ---------------------------------------


NOT_KNOWN = ""
"""The CPU model of an experiment of which no run has been measured."""
_EXPERIMENTS = ExperimentRow.__table__
_RUNS = RunRow.__table__


@dataclass(frozen=True, slots=True)
class MeasuredMachine:
    """The machine of a worker.

    Attributes:
        cpu_model: Of this machine.
        elsewhere: Whether runs of an executor are on other machines, which its engine chooses.
    """

    cpu_model: str
    elsewhere: Callable[[str], bool] = lambda _executor: False


@dataclass(frozen=True, slots=True)
class Barred:
    """An experiment with queued runs that a machine must not execute, since they stay on ``cpu_model``."""

    experiment_id: int
    name: str
    cpu_model: str


class SameCpu(Repository):
    """Asked by the queue before it gives a run away."""

    def barred(self, machine: MeasuredMachine) -> list[Barred]:
        """The experiments with queued runs that stay on another CPU model."""
        of = _EXPERIMENTS.c
        waits = exists().where(_RUNS.c.experiment_id == of.id, _RUNS.c.state == RunState.QUEUED)
        query = select(of.id, of.name, of.executor, of.cpu_model).where(
            of.cpu_model.not_in((NOT_KNOWN, machine.cpu_model)), waits
        )
        return [
            Barred(row.id, row.name, row.cpu_model)
            for row in self._connection.execute(query)
            if not machine.elsewhere(row.executor)
        ]

    def admits(self, run_id: int, machine: MeasuredMachine) -> int | None:
        """None if the machine may take the run; otherwise the experiment that does not let it.

        The first machine that takes a run of an experiment decides its CPU model. Where an engine chooses the machine,
        the first run goes alone until it has started, because until then nobody knows the CPU model.
        """
        of = _EXPERIMENTS.c
        query = select(of.id, of.executor, of.cpu_model).join(_RUNS, _RUNS.c.experiment_id == of.id)
        row = self._connection.execute(query.where(_RUNS.c.id == run_id)).one_or_none()
        if row is None or row.cpu_model is None:
            return None
        elsewhere = machine.elsewhere(row.executor)
        if row.cpu_model != NOT_KNOWN:
            return None if elsewhere or row.cpu_model == machine.cpu_model else int(row.id)
        # Workers of other machines ask the same now: one after the other gets the row.
        self._connection.execute(select(_EXPERIMENTS.c.id).where(_EXPERIMENTS.c.id == row.id).with_for_update())
        known = self.known(row.id)
        if known is None and elsewhere:
            active = select(func.count()).where(_RUNS.c.experiment_id == row.id, _RUNS.c.state.in_(_ACTIVE))
            return int(row.id) if self._number(active) > 0 else None
        wanted = known or machine.cpu_model
        self._connection.execute(update(_EXPERIMENTS).where(_EXPERIMENTS.c.id == row.id).values(cpu_model=wanted))
        return None if elsewhere or wanted == machine.cpu_model else int(row.id)

    def known(self, experiment_id: int) -> str | None:
        """The CPU model that all runs of an experiment need; None if any will do, or none is known yet."""
        stored = self._connection.scalar(select(_EXPERIMENTS.c.cpu_model).where(_EXPERIMENTS.c.id == experiment_id))
        return self._measured(experiment_id) if stored == NOT_KNOWN else stored

    def settle(self, experiment_id: int) -> None:
        """Store the CPU model that the runs of an experiment show, if it has to have one and none is stored."""
        measured = self._measured(experiment_id)
        if measured is not None:
            waits = (_EXPERIMENTS.c.id == experiment_id, _EXPERIMENTS.c.cpu_model == NOT_KNOWN)
            self._connection.execute(update(_EXPERIMENTS).where(*waits).values(cpu_model=measured))

    def _measured(self, experiment_id: int) -> str | None:
        """The CPU model of the run that started first."""
        query = (
            select(HostRow.cpu_model)
            .join(RunRow, RunRow.host_id == HostRow.id)
            .where(RunRow.experiment_id == experiment_id, RunRow.started_at.is_not(None))
            .order_by(RunRow.started_at, RunRow.id)
            .limit(1)
        )
        return self._connection.scalar(query)


# -- earlier runs: the nodes of a cluster, and the time that a run takes -----------------------------------------------

NODE = "node"
"""Where executors on several machines note the node of a run, in its handle."""
_LATEST_OF_EXECUTOR = 1000
"""So many of the latest runs of an executor are looked at."""


@dataclass(frozen=True, slots=True)
class NodeSeen:
    """A run that was on a node: the CPU model there, and the affinity of the run."""

    node: str
    cpu_model: str
    affinity: str


class PlacingRepository(Repository):
    """Read before a run is handed to the engine of a cluster."""

    def seen(self, executor: str) -> list[NodeSeen]:
        """The nodes of the latest runs of an executor, the newest first."""
        query = (
            select(RunRow.handle, HostRow.cpu_model, RunRow.affinity)
            .join(HostRow, HostRow.id == RunRow.host_id)
            .where(RunRow.executor == executor, RunRow.started_at.is_not(None))
            .order_by(RunRow.id.desc())
            .limit(_LATEST_OF_EXECUTOR)
        )
        found = []
        for handle, cpu_model, affinity in self._connection.execute(query):
            node = ((handle or {}).get("data") or {}).get(NODE)
            if node:
                found.append(NodeSeen(str(node), cpu_model, affinity))
        return found

    def ended_on(self, since: datetime) -> dict[tuple[str, str | None], int]:
        """{(executor, node): runs that succeeded or failed after ``since``}; the node is None where none is noted."""
        node = func.json_extract(RunRow.handle, f"$.data.{NODE}")
        query = (
            select(RunRow.executor, node, func.count())
            .where(
                RunRow.ended_at >= since,
                RunRow.state.in_((RunState.SUCCEEDED, RunState.FAILED)),
                RunRow.handle.is_not(None),
            )
            .group_by(RunRow.executor, node)
        )
        # MySQL gives the JSON of a text, SQLite the text.
        return {
            (row[0], None if row[1] is None else row[1].strip('"')): row[2] for row in self._connection.execute(query)
        }

    def measured_s(self, configuration_id: int) -> float | None:
        """The mean duration of the runs of a configuration; None if none was measured."""
        metric_id = select(MetricRow.id).where(MetricRow.key == DURATION).scalar_subquery()
        query = (
            select(func.avg(MetricValueRow.value))
            .join(RunRow, RunRow.id == MetricValueRow.run_id)
            .where(RunRow.configuration_id == configuration_id)
            .where(MetricValueRow.metric_id == metric_id, MetricValueRow.protocol_id == MEASURED_PROTOCOL_ID)
        )
        return self._connection.scalar(query)

    def recording_s(self, dataset: str) -> float:
        """The duration of a dataset's recording."""
        return float(
            self._connection.execute(select(DatasetRow.duration_s).where(DatasetRow.name == dataset)).scalar_one()
        )
