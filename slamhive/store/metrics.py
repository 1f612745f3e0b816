"""Metrics of runs, each filed under the protocol that computed it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import bindparam, case, delete, func, insert, select, update

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.verdict import ERROR, EVIDENCE, FROM_REPEATS, VerdictKind, compare_repeats, judge, tracked_enough
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    ConfigurationRow,
    EvaluationRow,
    MetricRow,
    MetricValueRow,
    ProtocolRow,
    RunRow,
)
from slamhive.store.records import EvaluationState
from slamhive.store.rows import Repository, chunks, get_or_insert

VERDICT = "verdict"
"""The key under which :mod:`slamhive.store.metrics` files verdicts among the metrics; it is not in the catalogue."""


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
        known = {row.id: row.key for row in self._connection.execute(select(MetricRow.id, MetricRow.key))}
        if not verdicts:
            known = {metric_id: key for metric_id, key in known.items() if key != VERDICT}
        chosen = MetricValueRow.is_current == 1
        if protocol_id is not None:
            chosen = MetricValueRow.protocol_id.in_([MEASURED_PROTOCOL_ID, protocol_id])
        metric_ids = [metric_id for metric_id, key in known.items() if keys is None or key in (*keys, VERDICT)]
        wanted = sorted(set(run_ids))
        found: dict[int, dict[str, float]] = {run_id: {} for run_id in wanted}
        for part in chunks(wanted):
            rows = self._connection.execute(
                select(MetricValueRow.run_id, MetricValueRow.metric_id, MetricValueRow.value)
                .where(MetricValueRow.run_id.in_(part), MetricValueRow.metric_id.in_(metric_ids), chosen)
                .order_by(MetricValueRow.run_id, MetricValueRow.metric_id)
            )
            for run_id, metric_id, value in rows.all():  # at once: a fetch of each row takes longer than the query
                found[run_id][known[metric_id]] = value
        return found

    def follow_protocols(self, run_ids: Iterable[int]) -> None:
        """Mark the metrics of the current protocols. Call it whenever the current protocol of a run has changed.

        A run that no evaluation could evaluate has no current protocol: the verdict of its last evaluation counts.
        """
        runs, figures, ended = RunRow.__table__, MetricValueRow.__table__, EvaluationRow.__table__
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
            select(ProtocolRow.id, ProtocolRow.fingerprint, MetricRow.key, MetricValueRow.value)
            .join(ProtocolRow, ProtocolRow.id == MetricValueRow.protocol_id)
            .join(MetricRow, MetricRow.id == MetricValueRow.metric_id)
            .where(MetricValueRow.run_id == run_id, MetricRow.key != VERDICT)
            .order_by(ProtocolRow.id, MetricValueRow.metric_id)
        )
        found: dict[str | None, dict[str, float]] = {}
        for protocol_id, fingerprint, key, value in rows:
            found.setdefault(None if protocol_id == MEASURED_PROTOCOL_ID else fingerprint, {})[key] = value
        return found

    def ids(self, keys: Iterable[str]) -> dict[str, int]:
        """{key: id} of metrics; a new key is stored."""
        wanted = list(keys)
        rows = self._connection.execute(select(MetricRow.key, MetricRow.id).where(MetricRow.key.in_(wanted)))
        known = {row.key: row.id for row in rows}
        for key in wanted:
            if key not in known:
                known[key], _ = get_or_insert(self._connection, MetricRow, {"key": key}, {})
        return known

    def _protocol_id(self, fingerprint: str | None) -> int:
        if fingerprint is None:
            return MEASURED_PROTOCOL_ID
        lookup = select(ProtocolRow.id).where(ProtocolRow.fingerprint == fingerprint)
        found = self._connection.execute(lookup).scalar_one_or_none()
        if found is None:
            raise NotFound(f"unknown protocol {fingerprint!r}", "store it with catalogue.put_protocol first")
        return found

    def _write(self, run_id: int, protocol_id: int, values: Mapping[str, float], *, replace_all: bool) -> None:
        for key, value in values.items():
            if not math.isfinite(value):
                raise InvalidInput(f"metric {key} of run {run_id} is {value}", "leave out a metric that is missing")
        metric_ids = self.ids(values)
        outdated = delete(MetricValueRow.__table__).where(
            MetricValueRow.run_id == run_id, MetricValueRow.protocol_id == protocol_id
        )
        if not replace_all:
            outdated = outdated.where(MetricValueRow.metric_id.in_(list(metric_ids.values())))
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
            self._connection.execute(insert(MetricValueRow.__table__), rows)
        if protocol_id != MEASURED_PROTOCOL_ID:
            self.follow_protocols([run_id])


# -- verdicts on evaluated runs, stored among the metrics that they follow from ----------------------------------------

# A verdict belongs to a run and a protocol, as a metric does. Lists, filters and groups therefore find it as fast as
# they find a metric. Verdicts are derived: reindexing, imports and the migration derive them again.


CODES = {
    VerdictKind.GOOD: 0,
    VerdictKind.NOT_EVALUABLE: 1,
    VerdictKind.TRACKED_TOO_LITTLE: 2,
    VerdictKind.DIVERGED_FAR: 3,
    VerdictKind.DIVERGED_OUTLIER: 4,
    VerdictKind.MISSED_INPUT: 5,
}
"""How the kinds are stored. ``ENDED_BADLY`` is missing: it follows from the state of a run."""

_KINDS = {code: kind for kind, code in CODES.items()}
_DERIVED = (VERDICT, *FROM_REPEATS)
_CONFIGURATIONS_AT_ONCE = 100
_EVALUATIONS = EvaluationRow.__table__
_RUNS = RunRow.__table__
_FIGURES = MetricValueRow.__table__


@dataclass
class _Judged:
    """A run under one protocol, and what its verdict depends on."""

    is_current: bool
    succeeded: bool
    stored: dict[str, float] = field(default_factory=dict)

    @property
    def metrics(self) -> dict[str, float]:
        """The metrics of its evaluation."""
        return {key: value for key, value in self.stored.items() if key not in _DERIVED}


def kind_of(code: float | None) -> VerdictKind | None:
    """The kind behind ``code``; None if no verdict is stored."""
    return None if code is None else _KINDS[int(code)]


class VerdictRepository(Repository):
    """Derives verdicts from what is stored and stores them."""

    def renew(self, run_ids: Iterable[int], protocol_id: int | None = None) -> None:
        """Renew the verdicts of these runs and of all their repeats, under each protocol of their evaluations.

        ``protocol_id``: only under this one. Another process may evaluate a repeat at the same time. The rows of the
        configurations are locked, so the later process sees both.
        """
        places: dict[int, set[int]] = defaultdict(set)
        for part in chunks(sorted(set(run_ids))):
            query = (
                select(_EVALUATIONS.c.protocol_id, _RUNS.c.configuration_id)
                .distinct()
                .join(_RUNS, _RUNS.c.id == _EVALUATIONS.c.run_id)
                .where(_EVALUATIONS.c.run_id.in_(part), _EVALUATIONS.c.open.is_(None))
            )
            if protocol_id is not None:
                query = query.where(_EVALUATIONS.c.protocol_id == protocol_id)
            for protocol, configuration in self._connection.execute(query):
                places[protocol].add(configuration)
        for protocol, configurations in places.items():
            for chosen in chunks(sorted(configurations), _CONFIGURATIONS_AT_ONCE):
                # In the order of their ids, so that two processes never wait for each other.
                table = ConfigurationRow.__table__
                locked = select(table.c.id).where(table.c.id.in_(chosen)).order_by(table.c.id).with_for_update()
                self._connection.execute(locked).all()
                groups = self._read(protocol, chosen)
                for runs in groups.values():
                    self._write(protocol, runs)
                without = [run for runs in groups.values() for run, found in runs.items() if not found.succeeded]
                MetricRepository(self._connection).follow_protocols(without)

    def renew_all(self) -> None:
        """Renew the verdicts of all evaluated runs."""
        evaluated = select(_EVALUATIONS.c.run_id).where(_EVALUATIONS.c.open.is_(None)).distinct()
        self.renew(self._connection.execute(evaluated).scalars().all())

    def _write(self, protocol_id: int, runs: Mapping[int, _Judged]) -> None:
        """Derive the metrics of the runs of one configuration, and store what differs from what is stored."""
        judged = {run: entry.metrics for run, entry in runs.items() if entry.succeeded}
        errors_m = {run: metrics[ERROR] for run, metrics in judged.items() if ERROR in metrics}
        compared = {run: error for run, error in errors_m.items() if tracked_enough(judged[run])}
        repeats = compare_repeats(errors_m, compared)
        derived: dict[int, dict[str, float]] = {}
        for run, entry in runs.items():
            kind = VerdictKind.NOT_EVALUABLE
            if entry.succeeded:
                kind = judge({**judged[run], **repeats.get(run, {})}).kind
            derived[run] = {VERDICT: float(CODES[kind]), **repeats.get(run, {})}

        known: list[Mapping[str, float]] = [*derived.values(), *(found.stored for found in runs.values())]
        metric_ids = MetricRepository(self._connection).ids(
            key for key in _DERIVED if any(key in entry for entry in known)
        )
        outdated: list[tuple[int, int]] = []
        rows: list[dict[str, Any]] = []
        for run_id, wanted in derived.items():
            found = runs[run_id]
            for key, metric_id in metric_ids.items():
                if wanted.get(key) == found.stored.get(key):
                    continue
                if key in found.stored:
                    outdated.append((metric_id, run_id))
                if key in wanted:
                    place = {"run_id": run_id, "metric_id": metric_id, "protocol_id": protocol_id}
                    rows.append({**place, "value": wanted[key], "is_current": int(found.is_current)})
        if outdated:
            same = _FIGURES.c.metric_id == bindparam("metric"), _FIGURES.c.run_id == bindparam("run")
            removal = delete(_FIGURES).where(*same, _FIGURES.c.protocol_id == protocol_id)
            self._connection.execute(removal, [{"metric": metric, "run": run} for metric, run in outdated])
        if rows:
            self._connection.execute(insert(_FIGURES), rows)

    def _read(self, protocol_id: int, configurations: Collection[int]) -> dict[int, dict[int, _Judged]]:
        """{configuration: {run: what its verdict depends on}} of runs with an ended evaluation under the protocol."""
        groups: dict[int, dict[int, _Judged]] = defaultdict(dict)
        query = (
            select(_RUNS.c.configuration_id, _RUNS.c.id, _RUNS.c.current_protocol_id, _EVALUATIONS.c.state)
            .join(_EVALUATIONS, _EVALUATIONS.c.run_id == _RUNS.c.id)
            .where(
                _RUNS.c.configuration_id.in_(configurations),
                _EVALUATIONS.c.protocol_id == protocol_id,
                _EVALUATIONS.c.open.is_(None),
            )
        )
        for configuration, run_id, current, state in self._connection.execute(query):
            entry = groups[configuration].setdefault(run_id, _Judged(current == protocol_id, succeeded=False))
            entry.succeeded |= state is EvaluationState.SUCCEEDED
        for configuration, run_id, key, value in self._stored(protocol_id, configurations):
            if run_id in groups[configuration]:
                groups[configuration][run_id].stored[key] = value
        return groups

    def _stored(self, protocol_id: int, configurations: Collection[int]) -> Iterator[tuple[int, int, str, float]]:
        """Configuration, run, key and value of the metrics behind verdicts, and of the verdicts."""
        wanted = select(MetricRow.id, MetricRow.key).where(MetricRow.key.in_((*EVIDENCE, VERDICT)))
        names = {row.id: row.key for row in self._connection.execute(wanted)}
        query = (
            select(_RUNS.c.configuration_id, _RUNS.c.id, _FIGURES.c.metric_id, _FIGURES.c.value)
            .join(_FIGURES, _FIGURES.c.run_id == _RUNS.c.id)
            .where(
                _RUNS.c.configuration_id.in_(configurations),
                _FIGURES.c.metric_id.in_(sorted(names)),
                # Frames that did not arrive were counted while the run was running, under no protocol.
                _FIGURES.c.protocol_id.in_((protocol_id, MEASURED_PROTOCOL_ID)),
            )
        )
        for configuration, run_id, metric_id, value in self._connection.execute(query):
            yield configuration, run_id, names[metric_id], value
