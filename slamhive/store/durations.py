"""Durations of past runs and evaluations, from which those of others are estimated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import median, stdev

from sqlalchemy import ColumnElement, Integer, and_, case, cast, func, select

from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    AlgorithmRow,
    AlgorithmVersionRow,
    ConfigurationRow,
    DatasetRow,
    EvaluationRow,
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
