"""Makes :class:`RunRecord` from rows: one query for the runs, one for parameters, one for metrics."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from sqlalchemy import Connection, Integer, Row, Select, func, literal, select

from slamhive.domain.configuration import InputMap, Playback
from slamhive.domain.disturbance import Disturbance
from slamhive.domain.host import Host as HostRecord
from slamhive.domain.notes import NO_NOTES, RunNotes
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import protocol_from_content
from slamhive.domain.trajectory_kind import with_trajectory
from slamhive.domain.variant import Variant
from slamhive.domain.verdict import VerdictKind
from slamhive.schema.limits import StopWhen
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.metrics import VERDICT, MetricRepository
from slamhive.store.models import Algorithm, AlgorithmVersion, Configuration, Dataset, Experiment, Host, Protocol, Run
from slamhive.store.notes import NoteRepository
from slamhive.store.records import AlgorithmVersion as VersionRecord
from slamhive.store.records import ProtocolLabel, RunRecord
from slamhive.store.rows import from_json
from slamhive.store.verdicts import kind_of

_CONVERTED = {"protocol_override", "stop_when", "disturbance"}
_AS_STORED = sorted(set(RunRecord.__dataclass_fields__) & set(Run.__table__.c.keys()) - _CONVERTED)
"""The fields of a record that are columns of ``runs`` as they are."""


@lru_cache(maxsize=64)
def run_query(protocol_id: int | None = None) -> Select[Any]:
    """All columns that a record needs; the caller adds conditions and order.

    ``protocol_id``: the protocol whose metrics are shown, None for each run's current one. The statement is kept:
    making it takes longer than executing it for one run.
    """
    shown = func.coalesce(literal(protocol_id, Integer), Run.current_protocol_id)
    return (
        select(
            Run.__table__,
            Algorithm.name.label("algorithm"),
            Algorithm.package.label("package"),
            Dataset.name.label("dataset"),
            Configuration.playback_mode,
            Configuration.playback_rate,
            Configuration.variant,
            Configuration.sensors,
            Configuration.version.label("asked_version"),
            Configuration.map.label("input_map"),
            Protocol.fingerprint.label("protocol_fingerprint"),
            Protocol.label.label("protocol_label"),
            AlgorithmVersion.identity,
            AlgorithmVersion.package_hash,
            AlgorithmVersion.version,
            AlgorithmVersion.number.label("version_number"),
            Host.cpu_model,
            Host.cpu_count,
            Host.memory_bytes,
            Host.kernel,
            Host.os,
            Experiment.name.label("experiment"),
        )
        .join(Configuration, Configuration.id == Run.configuration_id)
        .join(Algorithm, Algorithm.id == Configuration.algorithm_id)
        .join(Dataset, Dataset.id == Configuration.dataset_id)
        .outerjoin(Protocol, Protocol.id == shown)
        .outerjoin(AlgorithmVersion, AlgorithmVersion.id == Run.algorithm_version_id)
        .outerjoin(Host, Host.id == Run.host_id)
        .outerjoin(Experiment, Experiment.id == Run.experiment_id)
    )


def to_records(
    connection: Connection, rows: Sequence[Row[Any]], *, with_metrics: bool = False, protocol_id: int | None = None
) -> tuple[RunRecord, ...]:
    """The rows of :func:`run_query` as records, in the same order, with metrics of the same protocol."""
    parameters = ConfigurationRepository(connection).parameters_of_all(row.configuration_id for row in rows)
    run_ids = [row.id for row in rows]
    notes = NoteRepository(connection).for_runs(run_ids)
    if not with_metrics:
        return tuple(_record(row, parameters[row.configuration_id], notes=notes.get(row.id, NO_NOTES)) for row in rows)
    metrics = MetricRepository(connection).for_runs(run_ids, protocol_id=protocol_id, verdicts=True)
    kinds = {run_id: kind_of(values.pop(VERDICT, None)) for run_id, values in metrics.items()}
    return tuple(
        _record(
            row,
            parameters[row.configuration_id],
            metrics[row.id],
            kinds[row.id],
            notes=notes.get(row.id, NO_NOTES),
        )
        for row in rows
    )


def _record(
    row: Row[Any],
    parameters: dict[str, Value],
    metrics: dict[str, float] | None = None,
    judged: VerdictKind | None = None,
    *,
    notes: RunNotes,
) -> RunRecord:
    override, fingerprint = row.protocol_override, row.protocol_fingerprint
    return RunRecord(
        **{name: getattr(row, name) for name in _AS_STORED},
        algorithm=row.algorithm,
        package=row.package,
        dataset=row.dataset,
        parameters=parameters,
        playback=Playback(row.playback_mode, row.playback_rate),
        variant=from_json(Variant, row.variant) if row.variant else (),
        sensors=row.sensors or {},
        asked_version=row.asked_version,
        input_map=None if row.input_map is None else from_json(InputMap, row.input_map),
        protocol_override=None if override is None else protocol_from_content(override),
        protocol=None
        if fingerprint is None
        else ProtocolLabel(fingerprint, with_trajectory(row.protocol_label, row.trajectory)),
        version=_version(row),
        host=None
        if row.cpu_model is None
        else HostRecord(row.cpu_model, row.cpu_count, row.memory_bytes, row.kernel, row.os),
        experiment=row.experiment,
        stop_when=StopWhen.of(row.stop_when),
        disturbance=None if row.disturbance is None else Disturbance.of(row.disturbance),
        metrics=metrics,
        judged=judged,
        notes=notes,
    )


def _version(row: Row[Any]) -> VersionRecord | None:
    if row.identity is None:
        return None
    return VersionRecord(row.identity, row.package_hash, row.version, row.version_number)
