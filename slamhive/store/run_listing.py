"""Lists of runs: filter, sort by any column or metric, page by key."""

from __future__ import annotations

import base64
import json
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Select, and_, func, or_, select
from sqlalchemy.orm import Session

from slamhive.domain.metrics import CATALOGUE
from slamhive.errors import InvalidInput, unknown
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    Algorithm,
    Configuration,
    Dataset,
    Experiment,
    Metric,
    MetricValue,
    Run,
)
from slamhive.store.records import Page, RunFilter, RunSort
from slamhive.store.run_rows import run_query, to_records
from slamhive.store.types import UtcDateTime

SORT_COLUMNS: dict[str, ColumnElement[Any]] = {
    "id": Run.__table__.c.id,
    "algorithm": Algorithm.__table__.c.name,
    "dataset": Dataset.__table__.c.name,
    "executor": Run.__table__.c.executor,
    "state": Run.__table__.c.state,
    "reason": Run.__table__.c.reason,
    "priority": Run.__table__.c.priority,
    "created_at": Run.__table__.c.created_at,
    "started_at": Run.__table__.c.started_at,
    "ended_at": Run.__table__.c.ended_at,
    "poses": Run.__table__.c.poses,
}
"""What a list can be sorted by, besides every metric of the catalogue."""

_TEXT_KEYS = SORT_COLUMNS.keys() - {"id", "priority", "poses"}
_ALWAYS_THERE = SORT_COLUMNS.keys() - {"reason", "started_at", "ended_at", "poses"}
LARGEST_PAGE = 1000


def list_page(
    session: Session, wanted: RunFilter, sort: RunSort, after: str | None, limit: int, *, with_metrics: bool
) -> Page:
    """One page of the runs that match ``wanted``; see :meth:`RunRepository.page`."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    conditions = _conditions(wanted)
    total = int(session.execute(select(func.count()).select_from(Run).where(*conditions)).scalar_one())
    query, column = _sorted_query(sort)
    query = query.where(*conditions)
    if after is not None:
        query = query.where(_behind(column, sort, *_decode(after)))
    # Sorting ids alone, and fetching the rest for the page only, is several times faster on 100,000 runs.
    found = session.execute(query.order_by(*_order(column, sort)).limit(limit + 1)).all()
    shown = found[:limit]
    next_key = _encode(shown[-1].sort_value, shown[-1].id) if len(found) > limit else None
    rows = session.execute(run_query().where(Run.id.in_([row.id for row in shown]))).all()
    records = {record.id: record for record in to_records(session, rows, with_metrics=with_metrics)}
    return Page(tuple(records[row.id] for row in shown), total, next_key)


def _order(column: ColumnElement[Any], sort: RunSort) -> list[ColumnElement[Any]]:
    run_id = Run.__table__.c.id
    by_id = run_id.desc() if sort.descending else run_id.asc()
    if column is run_id:
        return [by_id]
    by_value = column.desc() if sort.descending else column.asc()
    return [*([] if sort.key in _ALWAYS_THERE else [column.is_(None)]), by_value, by_id]


def _conditions(wanted: RunFilter) -> list[ColumnElement[bool]]:
    runs = Run.__table__.c
    chosen: list[tuple[ColumnElement[Any], tuple[Any, ...]]] = [
        (runs.state, wanted.states),
        (runs.reason, wanted.reasons),
        (runs.executor, wanted.executors),
    ]
    conditions: list[ColumnElement[bool]] = [column.in_(values) for column, values in chosen if values]
    if wanted.algorithms:
        named = select(Configuration.id).join(Algorithm, Algorithm.id == Configuration.algorithm_id)
        conditions.append(runs.configuration_id.in_(named.where(Algorithm.name.in_(wanted.algorithms))))
    if wanted.datasets:
        named = select(Configuration.id).join(Dataset, Dataset.id == Configuration.dataset_id)
        conditions.append(runs.configuration_id.in_(named.where(Dataset.name.in_(wanted.datasets))))
    if wanted.experiments:
        named = select(Experiment.id).where(Experiment.name.in_(wanted.experiments))
        conditions.append(runs.experiment_id.in_(named))
    if wanted.configuration_id is not None:
        conditions.append(runs.configuration_id == wanted.configuration_id)
    if wanted.created_after is not None:
        conditions.append(runs.created_at >= wanted.created_after)
    if wanted.created_before is not None:
        conditions.append(runs.created_at < wanted.created_before)
    if wanted.evaluated is not None:
        protocol = runs.current_protocol_id
        conditions.append(protocol.is_not(None) if wanted.evaluated else protocol.is_(None))
    return conditions


def _sorted_query(sort: RunSort) -> tuple[Select[Any], ColumnElement[Any]]:
    """Ids and sort values, and the column to sort by: one of a run, or a metric of the run's current protocol."""
    if sort.key in SORT_COLUMNS:
        column = SORT_COLUMNS[sort.key]
        query: Select[Any] = select(Run.__table__.c.id, column.label("sort_value"))
        if sort.key in {"algorithm", "dataset"}:
            query = query.join(Configuration, Configuration.id == Run.configuration_id)
        if sort.key == "algorithm":
            query = query.join(Algorithm, Algorithm.id == Configuration.algorithm_id)
        if sort.key == "dataset":
            query = query.join(Dataset, Dataset.id == Configuration.dataset_id)
        return query, column
    if sort.key not in CATALOGUE:
        raise unknown("sort key", sort.key, [*SORT_COLUMNS, *CATALOGUE])
    metric_id = select(Metric.id).where(Metric.key == sort.key).scalar_subquery()
    protocol_id = Run.__table__.c.current_protocol_id if CATALOGUE[sort.key].needs_protocol else MEASURED_PROTOCOL_ID
    figures = MetricValue.__table__
    this_one = and_(figures.c.run_id == Run.id, figures.c.metric_id == metric_id, figures.c.protocol_id == protocol_id)
    valued: Select[Any] = select(Run.__table__.c.id, figures.c.value.label("sort_value"))
    return valued.select_from(Run.__table__.outerjoin(figures, this_one)), figures.c.value


def _behind(column: ColumnElement[Any], sort: RunSort, value: Any, run_id: int) -> ColumnElement[bool]:
    """The rows that come after the one with this sort value and id; NULLs are last in both directions."""
    runs = Run.__table__.c
    next_id = runs.id < run_id if sort.descending else runs.id > run_id
    if column is runs.id:
        return next_id
    if value is None:
        return and_(column.is_(None), next_id)
    if isinstance(value, str) != (sort.key in _TEXT_KEYS):
        raise _not_ours(str(value))
    if isinstance(column.type, UtcDateTime):
        value = _moment(value)
    further = column < value if sort.descending else column > value
    return or_(further, and_(column == value, next_id), column.is_(None))


def _moment(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        raise _not_ours(text) from None


def _encode(value: Any, run_id: int) -> str:
    plain = value.isoformat() if isinstance(value, datetime) else value
    return base64.urlsafe_b64encode(json.dumps([plain, run_id]).encode()).decode().rstrip("=")


def _decode(key: str) -> tuple[Any, int]:
    try:
        value, run_id = json.loads(base64.urlsafe_b64decode(key + "=" * (-len(key) % 4)))
    except (ValueError, TypeError):
        raise _not_ours(key) from None
    if not isinstance(run_id, int) or isinstance(value, list | dict):
        raise _not_ours(key)
    return value, run_id


def _not_ours(key: str) -> InvalidInput:
    return InvalidInput(f"page key {key[:60]!r} is not one of ours", "start at the first page")
