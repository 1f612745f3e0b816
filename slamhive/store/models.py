"""The tables. Nothing outside the store sees these classes; :mod:`slamhive.store.records` is what comes out."""

from __future__ import annotations

from datetime import datetime
from typing import Any, ClassVar

from sqlalchemy import BigInteger, ForeignKey, Index, MetaData, SmallInteger, String, Table, UniqueConstraint, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from slamhive.domain.accounts import Role
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.evaluation.job import Artefacts
from slamhive.store.account_records import KeyKind
from slamhive.store.analysis_records import AnalysisState
from slamhive.store.experiment_records import ExperimentState
from slamhive.store.records import EvaluationState
from slamhive.store.types import JsonText, LongText, Number, UtcDateTime, enum_column

MEASURED_PROTOCOL_ID = 1
"""The row of ``protocols`` for metrics that need no protocol (CPU, memory, poses)."""

TABLE_OPTIONS = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}
"""Binary collation: MySQL must distinguish ``nFeatures`` and ``nfeatures``, as SQLite does."""

NAME_LENGTH = 64
TEXT_VALUE_LENGTH = 190
WHY_LENGTH = 500


class Base(DeclarativeBase):
    """Every constraint has a name, so that a migration can drop it."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: UtcDateTime(),
        float: Number,
        **{
            kind: enum_column(kind)
            for kind in (
                RunState,
                FailureReason,
                PlaybackMode,
                Artefacts,
                EvaluationState,
                ExperimentState,
                AnalysisState,
                TrajectoryKind,
                Role,
                KeyKind,
            )
        },
    }
    __table__: ClassVar[Table]
    __table_args__: Any = TABLE_OPTIONS


class Algorithm(Base):
    """One mode of one package."""

    __tablename__ = "algorithms"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH), unique=True)
    package: Mapped[str] = mapped_column(String(NAME_LENGTH))
    mode: Mapped[str] = mapped_column(String(NAME_LENGTH))


class AlgorithmVersion(Base):
    """One version of a package: the image digest (or environment hash) and the hash of the package folder.

    ``number`` counts the versions of a package from 1 and is never used twice: a version that was removed from the
    engine keeps its row.
    """

    __tablename__ = "algorithm_versions"
    __table_args__ = (
        UniqueConstraint("package", "number"),
        UniqueConstraint("package", "identity", "package_hash"),
        TABLE_OPTIONS,
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    package: Mapped[str] = mapped_column(String(NAME_LENGTH))
    number: Mapped[int]
    identity: Mapped[str] = mapped_column(String(190))
    package_hash: Mapped[str] = mapped_column(String(80))
    version: Mapped[str] = mapped_column(String(190))
    created_at: Mapped[datetime]
    removed_at: Mapped[datetime | None]


class Dataset(Base):
    """A registered dataset."""

    __tablename__ = "datasets"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH), unique=True)
    checksum: Mapped[str] = mapped_column(String(80))
    duration_s: Mapped[float]
    folder: Mapped[str] = mapped_column(String(1024))
    sensors: Mapped[Any] = mapped_column(JsonText)
    title: Mapped[str] = mapped_column(String(255))
    registered_at: Mapped[datetime]


class Parameter(Base):
    """A parameter of a package (``scope``), under its own key and the name shared across packages (``general``).

    Type and unit say what the stored values mean. If they are edited, the parameter gets another row.
    """

    __tablename__ = "parameters"
    __table_args__ = (UniqueConstraint("scope", "key", "type", "unit"), TABLE_OPTIONS)
    id: Mapped[int] = mapped_column(primary_key=True)
    scope: Mapped[str] = mapped_column(String(NAME_LENGTH))
    key: Mapped[str] = mapped_column(String(190))
    type: Mapped[str] = mapped_column(String(16))
    unit: Mapped[str] = mapped_column(String(32))
    general: Mapped[str | None] = mapped_column(String(NAME_LENGTH), index=True)


class Configuration(Base):
    """What a run runs; equal content is one row. ``variant`` is NULL where the dataset is used unchanged.

    ``sensors`` is NULL where the rule assigns them.
    ``version``: of the package, if one was asked for. ``map``: the map that the algorithm starts with, if any.
    """

    __tablename__ = "configurations"
    id: Mapped[int] = mapped_column(primary_key=True)
    content_hash: Mapped[str] = mapped_column(String(64), unique=True)
    algorithm_id: Mapped[int] = mapped_column(ForeignKey("algorithms.id"), index=True)
    dataset_id: Mapped[int] = mapped_column(ForeignKey("datasets.id"), index=True)
    playback_mode: Mapped[PlaybackMode]
    playback_rate: Mapped[float]
    variant: Mapped[Any | None] = mapped_column(JsonText)
    sensors: Mapped[Any | None] = mapped_column(JsonText)
    version: Mapped[int | None]
    map: Mapped[Any | None] = mapped_column(JsonText)
    created_at: Mapped[datetime]


class ConfigurationValue(Base):
    """The value of one parameter: exactly (``value``), and in the two columns that searches read."""

    __tablename__ = "configuration_values"
    __table_args__ = (
        Index("ix_configuration_values_number", "parameter_id", "number_value", "configuration_id"),
        Index("ix_configuration_values_text", "parameter_id", "text_value", "configuration_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    configuration_id: Mapped[int] = mapped_column(ForeignKey("configurations.id"), primary_key=True)
    parameter_id: Mapped[int] = mapped_column(ForeignKey("parameters.id"), primary_key=True)
    value: Mapped[Any] = mapped_column(JsonText)
    number_value: Mapped[float | None]
    text_value: Mapped[str | None] = mapped_column(String(TEXT_VALUE_LENGTH))


class Host(Base):
    """A machine that measured runs."""

    __tablename__ = "hosts"
    id: Mapped[int] = mapped_column(primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64), unique=True)
    cpu_model: Mapped[str] = mapped_column(String(190))
    cpu_count: Mapped[int]
    memory_bytes: Mapped[int] = mapped_column(BigInteger)
    kernel: Mapped[str] = mapped_column(String(190))
    os: Mapped[str] = mapped_column(String(190))


class Protocol(Base):
    """An evaluation protocol, and one row for measured metrics."""

    __tablename__ = "protocols"
    id: Mapped[int] = mapped_column(primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(32), unique=True)
    label: Mapped[str] = mapped_column(String(255))
    definition: Mapped[Any] = mapped_column(JsonText)


class Experiment(Base):
    """An experiment as its file describes it. Until it is ``complete``, its cells and runs are still being stored.

    ``repeats`` may have grown since. ``cells`` and ``runs`` are counts, or upper bounds until it is complete.
    ``cpu_model``: see :mod:`slamhive.store.same_cpu`.
    """

    __tablename__ = "experiments"
    id: Mapped[int] = mapped_column(primary_key=True)
    uid: Mapped[str] = mapped_column(String(32), unique=True)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH), unique=True)
    description: Mapped[str] = mapped_column(LongText)
    content_hash: Mapped[str] = mapped_column(String(64))
    source: Mapped[str] = mapped_column(LongText)
    state: Mapped[ExperimentState]
    executor: Mapped[str] = mapped_column(String(32))
    priority: Mapped[int]
    repeats: Mapped[int]
    cells: Mapped[int]
    runs: Mapped[int]
    complete: Mapped[bool]
    created_at: Mapped[datetime]
    cpu_model: Mapped[str | None] = mapped_column(String(190))


class ExperimentCell(Base):
    """One configuration of an experiment, with its value on each axis that applies to it."""

    __tablename__ = "experiment_cells"
    __table_args__ = ({**TABLE_OPTIONS, "sqlite_with_rowid": False},)
    experiment_id: Mapped[int] = mapped_column(ForeignKey("experiments.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    configuration_id: Mapped[int] = mapped_column(ForeignKey("configurations.id"), index=True)
    name: Mapped[str] = mapped_column(String(80))
    axis_values: Mapped[Any] = mapped_column(JsonText)


class Run(Base):
    """A run: request, place in the queue, and outcome. Folders are named after ids, so no id is used twice."""

    __tablename__ = "runs"
    __table_args__ = (
        Index("ix_runs_queue", "state", "held", "priority", "id"),
        Index("ix_runs_affinity", "state", "held", "priority", "affinity", "id"),
        Index("ix_runs_experiment_cells", "experiment_id", "cell", "state", "reason", "current_protocol_id"),
        Index("ix_runs_experiment_states", "experiment_id", "state", "reason", "current_protocol_id"),
        Index("ix_runs_current_protocol_id_state", "current_protocol_id", "state"),
        {**TABLE_OPTIONS, "sqlite_autoincrement": True},
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    uid: Mapped[str] = mapped_column(String(32), unique=True)
    configuration_id: Mapped[int] = mapped_column(ForeignKey("configurations.id"), index=True)
    algorithm_version_id: Mapped[int | None] = mapped_column(ForeignKey("algorithm_versions.id"), index=True)
    host_id: Mapped[int | None] = mapped_column(ForeignKey("hosts.id"))
    dataset_checksum: Mapped[str | None] = mapped_column(String(80))
    executor: Mapped[str] = mapped_column(String(32), index=True)
    state: Mapped[RunState]
    reason: Mapped[FailureReason | None] = mapped_column(index=True)
    detail: Mapped[str | None] = mapped_column(LongText)
    seed: Mapped[int] = mapped_column(BigInteger)
    priority: Mapped[int]
    evaluate: Mapped[bool]
    created_at: Mapped[datetime] = mapped_column(index=True)
    started_at: Mapped[datetime | None] = mapped_column(index=True)
    ended_at: Mapped[datetime | None] = mapped_column(index=True)
    exit_code: Mapped[int | None]
    poses: Mapped[int | None]
    cpu_cores: Mapped[float | None]
    memory_mb: Mapped[int | None]
    timeout_s: Mapped[float | None]
    attempt: Mapped[int]
    lease_owner: Mapped[str | None] = mapped_column(String(190))
    lease_expires_at: Mapped[datetime | None]
    handle: Mapped[Any | None] = mapped_column(JsonText)
    cancel_requested: Mapped[bool]
    retry_of: Mapped[int | None] = mapped_column(ForeignKey("runs.id"))
    protocol_override: Mapped[Any | None] = mapped_column(JsonText)
    current_protocol_id: Mapped[int | None] = mapped_column(ForeignKey("protocols.id"))
    experiment_id: Mapped[int | None] = mapped_column(ForeignKey("experiments.id"))
    cell: Mapped[int | None]
    held: Mapped[bool] = mapped_column(server_default=text("0"))
    affinity: Mapped[str] = mapped_column(String(32), server_default=text("''"))
    stop_when: Mapped[Any | None] = mapped_column(JsonText)
    disturbed_by: Mapped[str | None] = mapped_column(String(120), index=True)
    disturbance: Mapped[Any | None] = mapped_column(JsonText)
    repeat_disturbed: Mapped[int] = mapped_column(server_default=text("0"))
    trajectory: Mapped[TrajectoryKind | None]
    owner: Mapped[str | None] = mapped_column(String(NAME_LENGTH), index=True)


class RunNote(Base):
    """What somebody wrote about a run; the file in its folder is the truth."""

    __tablename__ = "run_notes"
    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"), primary_key=True, autoincrement=False)
    note: Mapped[str] = mapped_column(LongText)


class RunTag(Base):
    """One tag of a run."""

    __tablename__ = "run_tags"
    __table_args__ = (
        Index("ix_run_tags_tag", "tag", "run_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"), primary_key=True)
    tag: Mapped[str] = mapped_column(String(NAME_LENGTH), primary_key=True)


class DeletedRun(Base):
    """A run that was deleted, so that an experiment or the ledger does not queue it again."""

    __tablename__ = "deleted_runs"
    uid: Mapped[str] = mapped_column(String(32), primary_key=True)
    run_id: Mapped[int]
    deleted_at: Mapped[datetime]


class RunEvent(Base):
    """One move of a run."""

    __tablename__ = "run_events"
    id: Mapped[int] = mapped_column(primary_key=True)
    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"), index=True)
    at: Mapped[datetime]
    from_state: Mapped[RunState | None]
    to_state: Mapped[RunState]
    why: Mapped[str] = mapped_column(String(WHY_LENGTH))


class Evaluation(Base):
    """One evaluation of one run. ``open`` is 1 until it ends, then NULL: at most one is open."""

    __tablename__ = "evaluations"
    __table_args__ = (
        UniqueConstraint("run_id", "protocol_id", "open"),
        Index("ix_evaluations_queue", "state", "id"),
        TABLE_OPTIONS,
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"))
    protocol_id: Mapped[int] = mapped_column(ForeignKey("protocols.id"))
    open: Mapped[int | None] = mapped_column(SmallInteger)
    state: Mapped[EvaluationState]
    reason: Mapped[str | None] = mapped_column(LongText)
    artefacts: Mapped[Artefacts]
    engine: Mapped[str | None] = mapped_column(String(190))
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    ended_at: Mapped[datetime | None]
    attempt: Mapped[int]
    lease_owner: Mapped[str | None] = mapped_column(String(190))
    lease_expires_at: Mapped[datetime | None]


class Metric(Base):
    """A metric key and its number; rows appear when a metric is first stored."""

    __tablename__ = "metrics"
    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(String(NAME_LENGTH), unique=True)


class MetricValue(Base):
    """One metric of one run under one protocol, ordered by metric: searches read few metrics of many runs.

    ``is_current`` is 1 for measured metrics and for those of the run's current protocol, else 0; the second key serves
    "runs with metric between a and b". There is no reference to the protocol: it would cost an index of its own, and
    protocols are never deleted.
    """

    __tablename__ = "metric_values"
    __table_args__ = (
        Index("ix_metric_values_search", "metric_id", "is_current", "value", "run_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    metric_id: Mapped[int] = mapped_column(ForeignKey("metrics.id"), primary_key=True)
    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"), primary_key=True, index=True)
    protocol_id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    value: Mapped[float]
    is_current: Mapped[int] = mapped_column(SmallInteger)


class VariantOption(Base):
    """An option of the pre-processing steps of a configuration, where all its steps of a kind agree on it.

    ``name`` is ``KIND.OPTION``, and ``KIND.OPTION@SENSOR`` for each sensor.
    """

    __tablename__ = "variant_options"
    __table_args__ = (
        Index("ix_variant_options_number", "name", "number_value", "configuration_id"),
        Index("ix_variant_options_text", "name", "text_value", "configuration_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    configuration_id: Mapped[int] = mapped_column(ForeignKey("configurations.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(190), primary_key=True)
    number_value: Mapped[float | None]
    text_value: Mapped[str | None] = mapped_column(String(TEXT_VALUE_LENGTH))


class SavedSearch(Base):
    """A search with a name: filter, columns and order of the page of runs."""

    __tablename__ = "saved_searches"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH), unique=True)
    filter_text: Mapped[str] = mapped_column(LongText)
    shown_columns: Mapped[Any] = mapped_column(JsonText)
    sort: Mapped[str] = mapped_column(String(190))
    descending: Mapped[bool]
    grouped: Mapped[bool]
    created_at: Mapped[datetime]


class Analysis(Base):
    """An analysis in the list and the queue; its folder ``analyses/<token>`` is the truth."""

    __tablename__ = "analyses"
    __table_args__ = (Index("ix_analyses_queue", "state", "id"), TABLE_OPTIONS)
    id: Mapped[int] = mapped_column(primary_key=True)
    token: Mapped[str] = mapped_column(String(32), unique=True)
    name: Mapped[str] = mapped_column(String(200))
    state: Mapped[AnalysisState]
    listed: Mapped[bool]
    visitor: Mapped[bool]
    created_at: Mapped[datetime]
    content_hash: Mapped[str | None] = mapped_column(String(64), index=True)
    reason: Mapped[str | None] = mapped_column(LongText)
    size_bytes: Mapped[int | None] = mapped_column(BigInteger)
    ended_at: Mapped[datetime | None]
    attempt: Mapped[int]
    lease_owner: Mapped[str | None] = mapped_column(String(190))
    lease_expires_at: Mapped[datetime | None]
