"""Experiments whose runs stay on one CPU model: which runs a worker may claim.

The column ``cpu_model`` of an experiment is NULL if any CPU will do, :data:`NOT_KNOWN` until one is known, and that CPU
model from then on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import exists, func, select, update

from slamhive.domain.run import RunState
from slamhive.store.models import Experiment, Host, Run
from slamhive.store.rows import Repository

NOT_KNOWN = ""
"""The CPU model of an experiment of which no run has been measured."""
_EXPERIMENTS = Experiment.__table__
_RUNS = Run.__table__
_ACTIVE = tuple(state for state in RunState if state.active)


def _never(_executor: str) -> bool:
    return False


@dataclass(frozen=True, slots=True)
class Machine:
    """The machine of a worker.

    Attributes:
        cpu_model: Of this machine.
        elsewhere: Whether runs of an executor are on other machines, which its engine chooses.
    """

    cpu_model: str
    elsewhere: Callable[[str], bool] = field(default=_never)


@dataclass(frozen=True, slots=True)
class Barred:
    """An experiment with queued runs that a machine must not execute, since they stay on ``cpu_model``."""

    experiment_id: int
    name: str
    cpu_model: str


class SameCpu(Repository):
    """Asked by the queue before it gives a run away."""

    def barred(self, machine: Machine) -> list[Barred]:
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

    def admits(self, run_id: int, machine: Machine) -> int | None:
        """None if the machine may take the run; otherwise the experiment that does not let it.

        The first machine that takes a run of an experiment decides its CPU model. Where an engine chooses the machine,
        the first run goes alone until it has started, because until then nobody knows the CPU model.
        """
        row = self._experiment_of(run_id)
        if row is None or row.cpu_model is None:
            return None
        elsewhere = machine.elsewhere(row.executor)
        if row.cpu_model != NOT_KNOWN:
            return None if elsewhere or row.cpu_model == machine.cpu_model else int(row.id)
        # Workers of other machines ask the same now: one after the other gets the row.
        self._connection.execute(select(_EXPERIMENTS.c.id).where(_EXPERIMENTS.c.id == row.id).with_for_update())
        known = self.known(row.id)
        if known is None and elsewhere:
            return int(row.id) if self._has_active_runs(row.id) else None
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
            select(Host.cpu_model)
            .join(Run, Run.host_id == Host.id)
            .where(Run.experiment_id == experiment_id, Run.started_at.is_not(None))
            .order_by(Run.started_at, Run.id)
            .limit(1)
        )
        return self._connection.scalar(query)

    def _experiment_of(self, run_id: int) -> Any:
        of = _EXPERIMENTS.c
        query = select(of.id, of.executor, of.cpu_model).join(_RUNS, _RUNS.c.experiment_id == of.id)
        return self._connection.execute(query.where(_RUNS.c.id == run_id)).one_or_none()

    def _has_active_runs(self, experiment_id: int) -> bool:
        query = select(func.count()).where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.state.in_(_ACTIVE))
        return self._number(query) > 0
