"""The values of a metric over the runs of an experiment, by configuration."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import ScalarSelect, and_, func, or_, select

from slamhive.domain.run import RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.store.experiments import retried_runs
from slamhive.store.metrics import VERDICT
from slamhive.store.models import Metric, MetricValue, Protocol, Run
from slamhive.store.records import ProtocolLabel
from slamhive.store.rows import Repository, chunks
from slamhive.store.verdicts import CODES

_RUNS = Run.__table__
_FIGURES = MetricValue.__table__
_JUDGED = (RunState.SUCCEEDED, RunState.FAILED)


@dataclass(frozen=True, slots=True)
class CellSample:
    """The good runs of a cell under one protocol: how many, and mean and sample variance of a metric in its unit."""

    cell: int
    protocol: ProtocolLabel
    n: int
    mean: float
    variance: float


class ExperimentValues(Repository):
    """What configurations of an experiment are ranked by. Runs that another run has replaced do not count."""

    def samples(self, experiment_id: int, metric: str) -> list[CellSample]:
        """Of each cell, under the current protocols of its good runs."""
        verdict = _FIGURES.alias("verdict")
        is_verdict = and_(
            verdict.c.run_id == _RUNS.c.id, verdict.c.metric_id == _id_of(VERDICT), verdict.c.is_current == 1
        )
        value = _FIGURES.c.value
        query = (
            select(
                _RUNS.c.cell,
                Protocol.fingerprint,
                Protocol.label,
                func.count(),
                func.avg(value),
                func.avg(value * value),
            )
            .join_from(_RUNS, _FIGURES, _FIGURES.c.run_id == _RUNS.c.id)
            .join(Protocol, Protocol.id == _FIGURES.c.protocol_id)
            .outerjoin(verdict, is_verdict)
            .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.state == RunState.SUCCEEDED)
            .where(_FIGURES.c.metric_id == _id_of(metric), _FIGURES.c.is_current == 1)
            .where(or_(verdict.c.value.is_(None), verdict.c.value <= CODES[VerdictKind.GOOD]))
            .where(~retried_runs(experiment_id))
            .group_by(_RUNS.c.cell, Protocol.fingerprint, Protocol.label)
        )
        return [
            CellSample(cell, ProtocolLabel(fingerprint, label), n, mean, max(0.0, square - mean**2) * n / max(1, n - 1))
            for cell, fingerprint, label, n, mean, square in self._connection.execute(query)
        ]

    def judged_runs(self, experiment_id: int, cells: Sequence[int], most: int) -> dict[int, list[int]]:
        """{cell: its latest runs that succeeded or failed, at most ``most``, in order}."""
        found: dict[int, list[int]] = defaultdict(list)
        for part in chunks(cells):
            query = (
                select(_RUNS.c.cell, _RUNS.c.id)
                .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.cell.in_(part), _RUNS.c.state.in_(_JUDGED))
                .where(~retried_runs(experiment_id))
                .order_by(_RUNS.c.id)
            )
            for cell, run_id in self._connection.execute(query):
                found[cell].append(run_id)
        return {cell: runs[-most:] for cell, runs in found.items()}


def _id_of(metric: str) -> ScalarSelect[int]:
    return select(Metric.id).where(Metric.key == metric).scalar_subquery()
