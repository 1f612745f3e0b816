"""Experiments whose runs stay on one CPU model: which runs a worker may claim.

The column ``cpu_model`` of an experiment is NULL if any CPU will do, :data:`NOT_KNOWN` until one is known, and that CPU
model from then on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import exists, func, select, update

from slamhive.domain.run import RunState
from slamhive.store.durations import DURATION
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    DatasetRow,
    ExperimentRow,
    HostRow,
    MetricRow,
    MetricValueRow,
    RunRow,
)
from slamhive.store.rows import Repository

NOT_KNOWN = ""
"""The CPU model of an experiment of which no run has been measured."""
_EXPERIMENTS = ExperimentRow.__table__
_RUNS = RunRow.__table__
_ACTIVE = tuple(state for state in RunState if state.active)


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
_LATEST = 1000
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
            .limit(_LATEST)
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
