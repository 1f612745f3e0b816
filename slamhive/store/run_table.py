"""Runs column by column, for analyses: few statements, and no object for each run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Select, String, and_, cast, or_, select

from slamhive.base.errors import unknown
from slamhive.domain.packages import VERSION_SIGN
from slamhive.store.configuration_listing import ConfigurationGroupRow
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    AlgorithmRow,
    AlgorithmVersionRow,
    ConfigurationRow,
    ConfigurationValueRow,
    DatasetRow,
    EvaluationRow,
    ExperimentCellRow,
    ExperimentRow,
    HostRow,
    MetricRow,
    MetricValueRow,
    ParameterRow,
    ProtocolRow,
    RunRow,
)
from slamhive.store.records import EvaluationState
from slamhive.store.rows import Repository, chunks

SCANNED_FROM = 2_000
"""From so many runs on, a column is read from the first to the last id, without naming each run."""


@dataclass(frozen=True, slots=True)
class ProtocolValue:
    """One metric under one protocol."""

    run_id: int
    fingerprint: str
    label: str
    metric: str
    value: float


class RunTableRepository(Repository):
    """Columns of runs by run id; a run without a value is not in the column."""

    def facts(self, run_ids: Sequence[int]) -> dict[str, list[Any]]:
        """The columns that every run has, by name and in the order of the ids; unknown runs are left out."""
        names = ("run_id", "configuration_id", "algorithm", "dataset", "state", "reason", "seed", "executor")
        more = ("version", "variant", "experiment", "host", "protocol", "protocol_label", "disturbed_by", "trajectory")
        limits = ("cpu_cores", "memory_mb", "slow_down")
        columns: dict[str, list[Any]] = {name: [] for name in (*names, *more, *limits)}
        for row in self._rows(_facts(), RunRow.id, run_ids):
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value)
        return columns

    def parameters(self, configuration_ids: Iterable[int]) -> dict[str, dict[int, Any]]:
        """{key or general name: {configuration: value}}; a parameter with a general name is there twice."""
        query = select(
            ConfigurationValueRow.configuration_id, ParameterRow.key, ParameterRow.general, ConfigurationValueRow.value
        ).join(ParameterRow, ParameterRow.id == ConfigurationValueRow.parameter_id)
        found: dict[str, dict[int, Any]] = {}
        wanted = sorted(set(configuration_ids))
        for configuration_id, key, general, value in self._rows(query, ConfigurationValueRow.configuration_id, wanted):
            found.setdefault(key, {})[configuration_id] = value
            if general is not None and general != key:
                found.setdefault(general, {})[configuration_id] = value
        return found

    def units(self) -> dict[str, str]:
        """{key or general name: unit} of the parameters whose definitions agree on a unit."""
        query = select(ParameterRow.key, ParameterRow.general, ParameterRow.unit).distinct()
        found: dict[str, set[str]] = {}
        for key, general, unit in self._connection.execute(query):
            for name in (key, general):
                if name is not None:
                    found.setdefault(name, set()).add(unit)
        return {name: units.pop() for name, units in found.items() if len(units) == 1}

    def metric(self, key: str, run_ids: Sequence[int], fingerprint: str | None = None) -> dict[int, float]:
        """The values of one metric: measured, or under each run's current protocol, or that of ``fingerprint``."""
        metric_id = self._connection.execute(select(MetricRow.id).where(MetricRow.key == key)).scalar_one_or_none()
        if metric_id is None:
            return {}
        chosen: ColumnElement[bool]
        if fingerprint is None:
            chosen = MetricValueRow.protocol_id == RunRow.current_protocol_id
        else:
            chosen = MetricValueRow.protocol_id == self.protocol_id(fingerprint)
        query = select(MetricValueRow.run_id, MetricValueRow.value).where(
            MetricValueRow.metric_id == metric_id, or_(MetricValueRow.protocol_id == MEASURED_PROTOCOL_ID, chosen)
        )
        if fingerprint is None:
            query = query.join(RunRow, RunRow.id == MetricValueRow.run_id)
        return {run_id: value for run_id, value in self._rows(query, MetricValueRow.run_id, run_ids)}  # noqa: C416

    def evaluated(self, run_ids: Sequence[int], fingerprint: str | None = None) -> dict[int, EvaluationState]:
        """The ends of the evaluations of runs, under any protocol or that of ``fingerprint``; a success comes first.

        Runs without an ended evaluation are left out.
        """
        query = select(EvaluationRow.run_id, EvaluationRow.state).where(EvaluationRow.open.is_(None))
        if fingerprint is not None:
            query = query.where(EvaluationRow.protocol_id == self.protocol_id(fingerprint))
        found: dict[int, EvaluationState] = {}
        for run_id, state in self._rows(query, EvaluationRow.run_id, run_ids):
            if found.get(run_id) is not EvaluationState.SUCCEEDED:
                found[run_id] = EvaluationState(state)
        return found

    def every_protocol(self, keys: Iterable[str], run_ids: Sequence[int]) -> list[ProtocolValue]:
        """The values of metrics under all protocols that the runs were evaluated under."""
        query = (
            select(
                MetricValueRow.run_id, ProtocolRow.fingerprint, ProtocolRow.label, MetricRow.key, MetricValueRow.value
            )
            .join(MetricRow, MetricRow.id == MetricValueRow.metric_id)
            .join(ProtocolRow, ProtocolRow.id == MetricValueRow.protocol_id)
            .where(MetricRow.key.in_(sorted(keys)), MetricValueRow.protocol_id != MEASURED_PROTOCOL_ID)
        )
        return [ProtocolValue(*row) for row in self._rows(query, MetricValueRow.run_id, run_ids)]

    def axes(self, run_ids: Sequence[int]) -> dict[str, dict[int, Any]]:
        """{axis of an experiment: {run: its value}}, also for values that leave the recording unchanged."""
        joined = and_(ExperimentCellRow.experiment_id == RunRow.experiment_id, ExperimentCellRow.number == RunRow.cell)
        query = select(RunRow.id, ExperimentCellRow.axis_values).join(ExperimentCellRow, joined)
        found: dict[str, dict[int, Any]] = {}
        for run_id, values in self._rows(query, RunRow.id, run_ids):
            for axis, value in values.items():
                found.setdefault(axis, {})[run_id] = value
        return found

    def protocol_id(self, fingerprint: str) -> int:
        """The row of a protocol; raises NotFound naming those that exist."""
        table = ProtocolRow.__table__
        rows = self._connection.execute(
            select(table.c.id, table.c.fingerprint).where(table.c.id != MEASURED_PROTOCOL_ID)
        )
        known: Mapping[str, int] = {row.fingerprint: row.id for row in rows}
        if fingerprint not in known:
            raise unknown("protocol", fingerprint, list(known))
        return known[fingerprint]

    def protocol_label(self, fingerprint: str) -> str:
        """The label of a protocol; raises NotFound."""
        lookup = select(ProtocolRow.label).where(ProtocolRow.id == self.protocol_id(fingerprint))
        return str(self._connection.execute(lookup).scalar_one())

    def existing(self, run_ids: Sequence[int]) -> set[int]:
        """Those of these runs that exist."""
        return {row[0] for row in self._rows(select(RunRow.id), RunRow.id, run_ids)}

    def runs_of_experiment(self, name: str) -> list[int]:
        """The runs of an experiment; raises NotFound."""
        table = ExperimentRow.__table__
        found = self._connection.execute(select(table.c.id).where(table.c.name == name)).scalar_one_or_none()
        if found is None:
            raise unknown("experiment", name, self._column(select(table.c.name)))
        return self._column(select(RunRow.id).where(RunRow.experiment_id == found))

    def experiment_names(self) -> dict[int, str]:
        """All experiments: {id: name}."""
        table = ExperimentRow.__table__
        return {row.id: row.name for row in self._connection.execute(select(table.c.id, table.c.name))}

    def runs_of_group(self, name: str) -> list[int]:
        """The runs of the configurations of a group; raises NotFound."""
        table = ConfigurationGroupRow.__table__
        members = self._column(select(table.c.configuration_id).where(table.c.name == name))
        if not members:
            known = self._connection.execute(select(table.c.name).distinct()).scalars()
            raise unknown("group", name, list(known))
        return self.runs_of_configurations(members)

    def runs_of_configurations(self, configuration_ids: Sequence[int]) -> list[int]:
        """The runs of configurations."""
        query = select(RunRow.id)
        return [row[0] for row in self._rows(query, RunRow.configuration_id, sorted(set(configuration_ids)))]

    def _rows(self, query: Any, key: Any, ids: Sequence[int]) -> Iterator[Any]:
        """The rows whose ``key`` is among ``ids``, by run or configuration."""
        wanted = sorted(set(ids))
        if len(wanted) < SCANNED_FROM:
            for part in chunks(wanted):
                yield from self._connection.execute(query.where(key.in_(part)).order_by(key))
            return
        chosen = set(wanted)
        scanned = query.add_columns(key.label("scanned")).where(and_(key >= wanted[0], key <= wanted[-1]))
        for row in self._connection.execute(scanned.order_by(key), execution_options={"yield_per": 10_000}):
            if row[-1] in chosen:
                yield row[:-1]


def _facts() -> Select[Any]:
    # ``aloam@2``; NULL for a run that never started
    version = AlgorithmVersionRow.package + VERSION_SIGN + cast(AlgorithmVersionRow.number, String(10))
    return (
        select(
            RunRow.id,
            RunRow.configuration_id,
            AlgorithmRow.name.label("algorithm"),
            DatasetRow.name.label("dataset"),
            RunRow.state,
            RunRow.reason,
            RunRow.seed,
            RunRow.executor,
            version.label("version"),
            ConfigurationRow.variant,
            ExperimentRow.name.label("experiment"),
            HostRow.cpu_model.label("host"),
            ProtocolRow.fingerprint.label("protocol"),
            ProtocolRow.label.label("protocol_label"),
            RunRow.disturbed_by,
            RunRow.trajectory,
            RunRow.cpu_cores,
            RunRow.memory_mb,
            RunRow.slow_down,
        )
        .join(ConfigurationRow, ConfigurationRow.id == RunRow.configuration_id)
        .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
        .join(DatasetRow, DatasetRow.id == ConfigurationRow.dataset_id)
        .outerjoin(AlgorithmVersionRow, AlgorithmVersionRow.id == RunRow.algorithm_version_id)
        .outerjoin(ExperimentRow, ExperimentRow.id == RunRow.experiment_id)
        .outerjoin(HostRow, HostRow.id == RunRow.host_id)
        .outerjoin(ProtocolRow, ProtocolRow.id == RunRow.current_protocol_id)
    )
