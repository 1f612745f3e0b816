"""Metrics of runs, each filed under the protocol that computed it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from sqlalchemy import case, delete, func, insert, select, update

from slamhive.errors import InvalidInput, NotFound
from slamhive.store.models import MEASURED_PROTOCOL_ID, Evaluation, Metric, MetricValue, Protocol, Run
from slamhive.store.rows import Repository, chunks, get_or_insert

VERDICT = "verdict"
"""The key under which :mod:`slamhive.store.verdicts` files verdicts among the metrics; it is not in the catalogue."""


class MetricRepository(Repository):
    """A new metric needs no migration: its key gets a row of its own when it is first stored."""

    def put(self, run_id: int, fingerprint: str | None, values: Mapping[str, float]) -> None:
        """Store metrics of a run, replacing those of the same keys.

        Args:
            run_id: The run.
            fingerprint: Of the protocol that computed them; None for measured metrics (CPU, memory, poses).
            values: {metric key: value}, without those that are missing; NaN and infinity raise InvalidInput.
        """
        self._write(run_id, self._protocol_id(fingerprint), values, replace_all=False)

    def replace(self, run_id: int, fingerprint: str | None, values: Mapping[str, float]) -> None:
        """The same, and remove the metrics of this run and protocol that ``values`` does not name."""
        self._write(run_id, self._protocol_id(fingerprint), values, replace_all=True)

    def for_runs(
        self,
        run_ids: Iterable[int],
        keys: Sequence[str] | None = None,
        protocol_id: int | None = None,
        *,
        verdicts: bool = False,
    ) -> dict[int, dict[str, float]]:
        """{run: {metric key: value}}: measured metrics, and those of each run's current protocol.

        ``keys`` restricts them to these metrics. ``protocol_id`` takes the metrics of this protocol instead.
        ``verdicts`` adds the stored verdicts under :data:`VERDICT`. One query serves a few hundred runs.
        """
        known = {row.id: row.key for row in self._connection.execute(select(Metric.id, Metric.key))}
        if not verdicts:
            known = {metric_id: key for metric_id, key in known.items() if key != VERDICT}
        chosen = MetricValue.is_current == 1
        if protocol_id is not None:
            chosen = MetricValue.protocol_id.in_([MEASURED_PROTOCOL_ID, protocol_id])
        metric_ids = [metric_id for metric_id, key in known.items() if keys is None or key in (*keys, VERDICT)]
        wanted = sorted(set(run_ids))
        found: dict[int, dict[str, float]] = {run_id: {} for run_id in wanted}
        for part in chunks(wanted):
            rows = self._connection.execute(
                select(MetricValue.run_id, MetricValue.metric_id, MetricValue.value)
                .where(MetricValue.run_id.in_(part), MetricValue.metric_id.in_(metric_ids), chosen)
                .order_by(MetricValue.run_id, MetricValue.metric_id)
            )
            for run_id, metric_id, value in rows:
                found[run_id][known[metric_id]] = value
        return found

    def follow_protocols(self, run_ids: Iterable[int]) -> None:
        """Mark the metrics of the current protocols. Call it whenever the current protocol of a run has changed.

        A run that no evaluation could evaluate has no current protocol: the verdict of its last evaluation counts.
        """
        runs, figures, ended = Run.__table__, MetricValue.__table__, Evaluation.__table__
        current = select(runs.c.current_protocol_id).where(runs.c.id == figures.c.run_id).scalar_subquery()
        last = (
            select(ended.c.protocol_id)
            .where(ended.c.run_id == figures.c.run_id, ended.c.open.is_(None))
            .order_by(ended.c.id.desc())
            .limit(1)
            .scalar_subquery()
        )
        mark = case((figures.c.protocol_id == func.coalesce(current, last, 0), 1), else_=0)
        for part in chunks(sorted(set(run_ids))):
            changing = [figures.c.run_id.in_(part), figures.c.protocol_id != MEASURED_PROTOCOL_ID]
            self._connection.execute(update(figures).where(*changing).values(is_current=mark))

    def by_protocol(self, run_id: int) -> dict[str | None, dict[str, float]]:
        """All metrics of one run: {protocol fingerprint, None for measured: {metric key: value}}."""
        rows = self._connection.execute(
            select(Protocol.id, Protocol.fingerprint, Metric.key, MetricValue.value)
            .join(Protocol, Protocol.id == MetricValue.protocol_id)
            .join(Metric, Metric.id == MetricValue.metric_id)
            .where(MetricValue.run_id == run_id, Metric.key != VERDICT)
            .order_by(Protocol.id, MetricValue.metric_id)
        )
        found: dict[str | None, dict[str, float]] = {}
        for protocol_id, fingerprint, key, value in rows:
            found.setdefault(None if protocol_id == MEASURED_PROTOCOL_ID else fingerprint, {})[key] = value
        return found

    def ids(self, keys: Iterable[str]) -> dict[str, int]:
        """{key: id} of metrics; a new key is stored."""
        wanted = list(keys)
        rows = self._connection.execute(select(Metric.key, Metric.id).where(Metric.key.in_(wanted)))
        known = {row.key: row.id for row in rows}
        for key in wanted:
            if key not in known:
                known[key], _ = get_or_insert(self._connection, Metric, {"key": key}, {})
        return known

    def _protocol_id(self, fingerprint: str | None) -> int:
        if fingerprint is None:
            return MEASURED_PROTOCOL_ID
        lookup = select(Protocol.id).where(Protocol.fingerprint == fingerprint)
        found = self._connection.execute(lookup).scalar_one_or_none()
        if found is None:
            raise NotFound(f"unknown protocol {fingerprint!r}", "store it with catalogue.put_protocol first")
        return found

    def _write(self, run_id: int, protocol_id: int, values: Mapping[str, float], *, replace_all: bool) -> None:
        for key, value in values.items():
            if not math.isfinite(value):
                raise InvalidInput(f"metric {key} of run {run_id} is {value}", "leave out a metric that is missing")
        metric_ids = self.ids(values)
        outdated = delete(MetricValue.__table__).where(
            MetricValue.run_id == run_id, MetricValue.protocol_id == protocol_id
        )
        if not replace_all:
            outdated = outdated.where(MetricValue.metric_id.in_(list(metric_ids.values())))
        self._connection.execute(outdated)
        rows = [
            {
                "run_id": run_id,
                "metric_id": metric_ids[key],
                "protocol_id": protocol_id,
                "value": float(value),
                "is_current": int(protocol_id == MEASURED_PROTOCOL_ID),
            }
            for key, value in values.items()
        ]
        if rows:
            self._connection.execute(insert(MetricValue.__table__), rows)
        if protocol_id != MEASURED_PROTOCOL_ID:
            self.follow_protocols([run_id])
