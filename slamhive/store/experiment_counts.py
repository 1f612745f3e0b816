"""How many runs of experiments are in which state, for which reason, and with which verdict."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, and_, func, or_, select

from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.store.experiment_records import StateCount
from slamhive.store.metrics import VERDICT, MetricRepository
from slamhive.store.models import Metric, MetricValue, Run
from slamhive.store.rows import Repository
from slamhive.store.verdicts import CODES, kind_of

_RUNS = Run.__table__
_FIGURES = MetricValue.__table__
REPLACEABLE = (RunState.FAILED, RunState.CANCELLED)
DISTURBED = and_(_RUNS.c.state == RunState.SUCCEEDED, func.coalesce(_RUNS.c.disturbed_by, "") > "")

_Key = tuple[int, RunState, FailureReason | None, VerdictKind | None]
"""Experiment or cell, and what its runs have in common."""


class ExperimentCounts(Repository):
    """Counts from indexes alone, except for the few runs that a verdict failed or that were tried again."""

    def by_experiment(self, experiment_id: int | None = None) -> dict[int, list[StateCount]]:
        """By experiment: of one, or of all."""
        return self._parted(_RUNS.c.experiment_id, experiment_id)

    def by_cell(self, experiment_id: int) -> dict[int, list[StateCount]]:
        """By the cells of one experiment."""
        return self._parted(_RUNS.c.cell, experiment_id)

    def disturbed(self, experiment_id: int | None = None) -> dict[int, int]:
        """How many runs of each experiment were measured on a disturbed machine and not repeated since."""
        owner = _RUNS.c.experiment_id
        query = select(owner, func.count()).where(_RUNS.c.disturbed_by > "", _of(experiment_id)).group_by(owner)
        found = {number: count for number, count in self._connection.execute(query)}  # noqa: C416 - rows, not pairs
        if not found:
            return {}
        repeated = Counter(row.experiment_id for row in self._all_retried(experiment_id) if row.disturbed_by)
        return {number: count - repeated[number] for number, count in found.items()}

    def last_ended(self, experiment_id: int, most: int) -> list[bool]:
        """Whether the runs that ended last have failed, the latest first."""
        query = (
            select(_RUNS.c.id, _RUNS.c.state)
            .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.ended_at.is_not(None))
            .where(_RUNS.c.state != RunState.CANCELLED)
            .order_by(_RUNS.c.ended_at.desc(), _RUNS.c.id.desc())
            .limit(most)
        )
        rows = self._connection.execute(query).all()
        kinds = self._kinds([row.id for row in rows if row.state is RunState.SUCCEEDED])
        judged = {run_id: kind is not None and kind.failed for run_id, kind in kinds.items()}
        return [row.state is RunState.FAILED or judged.get(row.id, False) for row in rows]

    def _parted(self, place: ColumnElement[int], experiment_id: int | None) -> dict[int, list[StateCount]]:
        """The counts of each place, with retried runs counted separately."""
        counts = self._counts(place, experiment_id)
        if not counts:
            return {}
        retried = self._all_retried(experiment_id)
        kinds = self._kinds([row.id for row in retried if row.state is RunState.SUCCEEDED])
        again: Counter[_Key] = Counter(
            (getattr(row, place.key or ""), row.state, row.reason, kinds.get(row.id)) for row in retried
        )
        found: dict[int, list[StateCount]] = defaultdict(list)
        for key, count in counts.items():
            number, state, reason, judged = key
            parts = ((False, count - again[key]), (True, again[key]))
            found[number] += [StateCount(state, reason, part, many, judged) for part, many in parts if many]
        return found

    def _counts(self, place: ColumnElement[int], experiment_id: int | None) -> Counter[_Key]:
        """Evaluated runs count as good, except for the few whose verdict says otherwise."""
        evaluated = _RUNS.c.current_protocol_id.is_not(None)
        keys = (place, _RUNS.c.state, _RUNS.c.reason, evaluated)
        counts: Counter[_Key] = Counter()
        for number, state, reason, is_evaluated, count in self._connection.execute(
            select(*keys, func.count()).where(_of(experiment_id)).group_by(*keys)
        ):
            counts[number, state, reason, VerdictKind.GOOD if is_evaluated else None] += count
        if not counts:  # no run belongs to an experiment, so that the verdicts of all runs need not be read
            return counts
        for number, judged, count in self._failed_by_verdict(place, experiment_id):
            before = None if judged is VerdictKind.NOT_EVALUABLE else VerdictKind.GOOD
            counts[number, RunState.SUCCEEDED, None, before] -= count
            counts[number, RunState.SUCCEEDED, None, judged] += count
        return counts

    def _failed_by_verdict(
        self, place: ColumnElement[int], experiment_id: int | None
    ) -> list[tuple[int, VerdictKind | None, int]]:
        verdict = select(Metric.id).where(Metric.key == VERDICT).scalar_subquery()
        failed = _FIGURES.c.metric_id == verdict, _FIGURES.c.is_current == 1, _FIGURES.c.value > CODES[VerdictKind.GOOD]
        query = (
            select(place, _FIGURES.c.value, func.count())
            .join_from(_FIGURES, _RUNS, _RUNS.c.id == _FIGURES.c.run_id + 0)
            .where(*failed, _of(experiment_id, guarded=True))
            .group_by(place, _FIGURES.c.value)
        )
        return [(number, kind_of(code), count) for number, code, count in self._connection.execute(query)]

    def _kinds(self, run_ids: Sequence[int]) -> dict[int, VerdictKind | None]:
        found = MetricRepository(self._connection).for_runs(run_ids, [], verdicts=True)
        return {run_id: kind_of(values.get(VERDICT)) for run_id, values in found.items()}

    def _all_retried(self, experiment_id: int | None) -> Sequence[Any]:
        """The runs that another run has replaced, found through the few retries."""
        later = _RUNS.alias("later")
        columns = (_RUNS.c[name] for name in ("id", "experiment_id", "cell", "state", "reason", "disturbed_by"))
        query = (
            select(*columns)
            .distinct()
            .select_from(later.join(_RUNS, _RUNS.c.id == later.c.retry_of))
            .where(_of(experiment_id, guarded=True), later.c.retry_of.is_not(None), _replaced_by(later))
        )
        return self._connection.execute(query).all()


def _of(experiment_id: int | None, *, guarded: bool = False) -> ColumnElement[bool]:
    """Whether a run belongs to this experiment, or to any; ``guarded`` keeps its index from being used."""
    owner = _RUNS.c.experiment_id
    if experiment_id is None:
        return owner.is_not(None)
    return (owner + 0 if guarded else owner) == experiment_id


def _replaced_by(later: Any) -> ColumnElement[bool]:
    """A failed or cancelled run is replaced by any later one, a good but disturbed one unless that was cancelled."""
    return or_(_RUNS.c.state.in_(REPLACEABLE), and_(DISTURBED, later.c.state != RunState.CANCELLED))
