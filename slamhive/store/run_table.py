"""Runs column by column, for analyses: few statements, and no object for each run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Select, String, and_, cast, or_, select

from slamhive.domain.versions import VERSION_SIGN
from slamhive.errors import unknown
from slamhive.store.configuration_models import ConfigurationGroup
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    Algorithm,
    AlgorithmVersion,
    Configuration,
    ConfigurationValue,
    Dataset,
    Evaluation,
    Experiment,
    ExperimentCell,
    Host,
    Metric,
    MetricValue,
    Parameter,
    Protocol,
    Run,
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
        columns: dict[str, list[Any]] = {name: [] for name in (*names, *more)}
        for row in self._rows(_facts(), Run.id, run_ids):
            for name, value in zip(columns, row, strict=True):
                columns[name].append(value)
        return columns

    def parameters(self, configuration_ids: Iterable[int]) -> dict[str, dict[int, Any]]:
        """{key or general name: {configuration: value}}; a parameter with a general name is there twice."""
        query = select(
            ConfigurationValue.configuration_id, Parameter.key, Parameter.general, ConfigurationValue.value
        ).join(Parameter, Parameter.id == ConfigurationValue.parameter_id)
        found: dict[str, dict[int, Any]] = {}
        wanted = sorted(set(configuration_ids))
        for configuration_id, key, general, value in self._rows(query, ConfigurationValue.configuration_id, wanted):
            found.setdefault(key, {})[configuration_id] = value
            if general is not None and general != key:
                found.setdefault(general, {})[configuration_id] = value
        return found

    def units(self) -> dict[str, str]:
        """{key or general name: unit} of the parameters whose definitions agree on a unit."""
        query = select(Parameter.key, Parameter.general, Parameter.unit).distinct()
        found: dict[str, set[str]] = {}
        for key, general, unit in self._connection.execute(query):
            for name in (key, general):
                if name is not None:
                    found.setdefault(name, set()).add(unit)
        return {name: units.pop() for name, units in found.items() if len(units) == 1}

    def metric(self, key: str, run_ids: Sequence[int], fingerprint: str | None = None) -> dict[int, float]:
        """The values of one metric: measured, or under each run's current protocol, or that of ``fingerprint``."""
        metric_id = self._connection.execute(select(Metric.id).where(Metric.key == key)).scalar_one_or_none()
        if metric_id is None:
            return {}
        chosen: ColumnElement[bool]
        if fingerprint is None:
            chosen = MetricValue.protocol_id == Run.current_protocol_id
        else:
            chosen = MetricValue.protocol_id == self.protocol_id(fingerprint)
        query = select(MetricValue.run_id, MetricValue.value).where(
            MetricValue.metric_id == metric_id, or_(MetricValue.protocol_id == MEASURED_PROTOCOL_ID, chosen)
        )
        if fingerprint is None:
            query = query.join(Run, Run.id == MetricValue.run_id)
        return {run_id: value for run_id, value in self._rows(query, MetricValue.run_id, run_ids)}  # noqa: C416

    def evaluated(self, run_ids: Sequence[int], fingerprint: str | None = None) -> dict[int, EvaluationState]:
        """How the evaluations of runs ended, under any protocol or that of ``fingerprint``; a success comes first.

        Runs without an ended evaluation are left out.
        """
        query = select(Evaluation.run_id, Evaluation.state).where(Evaluation.open.is_(None))
        if fingerprint is not None:
            query = query.where(Evaluation.protocol_id == self.protocol_id(fingerprint))
        found: dict[int, EvaluationState] = {}
        for run_id, state in self._rows(query, Evaluation.run_id, run_ids):
            if found.get(run_id) is not EvaluationState.SUCCEEDED:
                found[run_id] = EvaluationState(state)
        return found

    def every_protocol(self, keys: Iterable[str], run_ids: Sequence[int]) -> list[ProtocolValue]:
        """The values of metrics under all protocols that the runs were evaluated under."""
        query = (
            select(MetricValue.run_id, Protocol.fingerprint, Protocol.label, Metric.key, MetricValue.value)
            .join(Metric, Metric.id == MetricValue.metric_id)
            .join(Protocol, Protocol.id == MetricValue.protocol_id)
            .where(Metric.key.in_(sorted(keys)), MetricValue.protocol_id != MEASURED_PROTOCOL_ID)
        )
        return [ProtocolValue(*row) for row in self._rows(query, MetricValue.run_id, run_ids)]

    def axes(self, run_ids: Sequence[int]) -> dict[str, dict[int, Any]]:
        """{axis of an experiment: {run: its value}}, also for values that leave the recording unchanged."""
        joined = and_(ExperimentCell.experiment_id == Run.experiment_id, ExperimentCell.number == Run.cell)
        query = select(Run.id, ExperimentCell.axis_values).join(ExperimentCell, joined)
        found: dict[str, dict[int, Any]] = {}
        for run_id, values in self._rows(query, Run.id, run_ids):
            for axis, value in values.items():
                found.setdefault(axis, {})[run_id] = value
        return found

    def protocol_id(self, fingerprint: str) -> int:
        """The row of a protocol; raises NotFound naming those that exist."""
        table = Protocol.__table__
        rows = self._connection.execute(
            select(table.c.id, table.c.fingerprint).where(table.c.id != MEASURED_PROTOCOL_ID)
        )
        known: Mapping[str, int] = {row.fingerprint: row.id for row in rows}
        if fingerprint not in known:
            raise unknown("protocol", fingerprint, list(known))
        return known[fingerprint]

    def protocol_label(self, fingerprint: str) -> str:
        """The label of a protocol; raises NotFound."""
        lookup = select(Protocol.label).where(Protocol.id == self.protocol_id(fingerprint))
        return str(self._connection.execute(lookup).scalar_one())

    def existing(self, run_ids: Sequence[int]) -> set[int]:
        """Those of these runs that exist."""
        return {row[0] for row in self._rows(select(Run.id), Run.id, run_ids)}

    def runs_of_experiment(self, name: str) -> list[int]:
        """The runs of an experiment; raises NotFound."""
        table = Experiment.__table__
        found = self._connection.execute(select(table.c.id).where(table.c.name == name)).scalar_one_or_none()
        if found is None:
            raise unknown("experiment", name, self._column(select(table.c.name)))
        return self._column(select(Run.id).where(Run.experiment_id == found))

    def experiment_names(self) -> dict[int, str]:
        """All experiments: {id: name}."""
        table = Experiment.__table__
        return {row.id: row.name for row in self._connection.execute(select(table.c.id, table.c.name))}

    def runs_of_group(self, name: str) -> list[int]:
        """The runs of the configurations of a group; raises NotFound."""
        table = ConfigurationGroup.__table__
        members = self._column(select(table.c.configuration_id).where(table.c.name == name))
        if not members:
            known = self._connection.execute(select(table.c.name).distinct()).scalars()
            raise unknown("group", name, list(known))
        return self.runs_of_configurations(members)

    def runs_of_configurations(self, configuration_ids: Sequence[int]) -> list[int]:
        """The runs of configurations."""
        query = select(Run.id)
        return [row[0] for row in self._rows(query, Run.configuration_id, sorted(set(configuration_ids)))]

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


def _version_label() -> ColumnElement[str]:
    """``aloam@2``; NULL for a run that never started."""
    return (AlgorithmVersion.package + VERSION_SIGN + cast(AlgorithmVersion.number, String(10))).label("version")


def _facts() -> Select[Any]:
    return (
        select(
            Run.id,
            Run.configuration_id,
            Algorithm.name.label("algorithm"),
            Dataset.name.label("dataset"),
            Run.state,
            Run.reason,
            Run.seed,
            Run.executor,
            _version_label(),
            Configuration.variant,
            Experiment.name.label("experiment"),
            Host.cpu_model.label("host"),
            Protocol.fingerprint.label("protocol"),
            Protocol.label.label("protocol_label"),
            Run.disturbed_by,
            Run.trajectory,
        )
        .join(Configuration, Configuration.id == Run.configuration_id)
        .join(Algorithm, Algorithm.id == Configuration.algorithm_id)
        .join(Dataset, Dataset.id == Configuration.dataset_id)
        .outerjoin(AlgorithmVersion, AlgorithmVersion.id == Run.algorithm_version_id)
        .outerjoin(Experiment, Experiment.id == Run.experiment_id)
        .outerjoin(Host, Host.id == Run.host_id)
        .outerjoin(Protocol, Protocol.id == Run.current_protocol_id)
    )
