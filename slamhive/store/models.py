"""The tables. Nothing outside the store sees these classes; :mod:`slamhive.store.records` is what comes out."""

from __future__ import annotations

from sqlalchemy import BigInteger, Boolean, ForeignKey, Index, Integer, SmallInteger, String, UniqueConstraint, text

from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.question import ExperimentQuestion
from slamhive.domain.run import FailureReason, RunState
from slamhive.evaluation.job import Artefacts
from slamhive.store.records import AnalysisState, EvaluationState, ExperimentState
from slamhive.store.tables import (
    TABLE_OPTIONS,
    JsonText,
    LongText,
    Number,
    TableBase,
    UtcDateTime,
    column,
    enum_column,
    optional,
)

MEASURED_PROTOCOL_ID = 1
"""The row of ``protocols`` for metrics that need no protocol (CPU, memory, poses)."""

NAME_LENGTH = 64
AUDIENCE_LENGTH = 80
TEXT_VALUE_LENGTH = 190
WHY_LENGTH = 500


class AlgorithmRow(TableBase):
    """One mode of one package."""

    __tablename__ = "algorithms"
    id = column(Integer, primary_key=True)
    name = column(String(NAME_LENGTH), unique=True)
    package = column(String(NAME_LENGTH))
    mode = column(String(NAME_LENGTH))


class AlgorithmVersionRow(TableBase):
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
    id = column(Integer, primary_key=True)
    package = column(String(NAME_LENGTH))
    number = column(Integer)
    identity = column(String(190))
    package_hash = column(String(80))
    version = column(String(190))
    created_at = column(UtcDateTime)
    removed_at = optional(UtcDateTime)


class DatasetRow(TableBase):
    """A registered dataset."""

    __tablename__ = "datasets"
    id = column(Integer, primary_key=True)
    name = column(String(NAME_LENGTH), unique=True)
    checksum = column(String(80))
    duration_s = column(Number)
    folder = column(String(1024))
    sensors = column(JsonText)
    title = column(String(255))
    registered_at = column(UtcDateTime)


class ParameterRow(TableBase):
    """A parameter of a package (``scope``), under its own key and the name shared across packages (``general``).

    Type and unit say what the stored values mean. If they are edited, the parameter gets another row.
    """

    __tablename__ = "parameters"
    __table_args__ = (UniqueConstraint("scope", "key", "type", "unit"), TABLE_OPTIONS)
    id = column(Integer, primary_key=True)
    scope = column(String(NAME_LENGTH))
    key = column(String(190))
    type = column(String(16))
    unit = column(String(32))
    general = optional(String(NAME_LENGTH), index=True)


class ConfigurationRow(TableBase):
    """A configuration; equal content is one row. ``variant`` is NULL where the dataset is used unchanged.

    ``sensors`` is NULL where the rule assigns them.
    ``version``: of the package, if one was asked for. ``map``: the map that the algorithm starts with, if any.
    """

    __tablename__ = "configurations"
    id = column(Integer, primary_key=True)
    content_hash = column(String(64), unique=True)
    algorithm_id = column(Integer, ForeignKey("algorithms.id"), index=True)
    dataset_id = column(Integer, ForeignKey("datasets.id"), index=True)
    playback_mode = column(enum_column(PlaybackMode))
    playback_rate = column(Number)
    variant = optional(JsonText)
    sensors = optional(JsonText)
    version = optional(Integer)
    map = optional(JsonText)
    created_at = column(UtcDateTime)


class ConfigurationValueRow(TableBase):
    """The value of one parameter: exactly (``value``), and in the two columns that searches read."""

    __tablename__ = "configuration_values"
    __table_args__ = (
        Index("ix_configuration_values_number", "parameter_id", "number_value", "configuration_id"),
        Index("ix_configuration_values_text", "parameter_id", "text_value", "configuration_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    configuration_id = column(Integer, ForeignKey("configurations.id"), primary_key=True)
    parameter_id = column(Integer, ForeignKey("parameters.id"), primary_key=True)
    value = column(JsonText)
    number_value = optional(Number)
    text_value = optional(String(TEXT_VALUE_LENGTH))


class HostRow(TableBase):
    """A machine that measured runs."""

    __tablename__ = "hosts"
    id = column(Integer, primary_key=True)
    fingerprint = column(String(64), unique=True)
    cpu_model = column(String(190))
    cpu_count = column(Integer)
    memory_bytes = column(BigInteger)
    kernel = column(String(190))
    os = column(String(190))


class ProtocolRow(TableBase):
    """An evaluation protocol, and one row for measured metrics."""

    __tablename__ = "protocols"
    id = column(Integer, primary_key=True)
    fingerprint = column(String(32), unique=True)
    label = column(String(255))
    definition = column(JsonText)


class ExperimentRow(TableBase):
    """An experiment as its file describes it. Until it is ``complete``, its cells and runs are still being stored.

    ``repeats`` may have grown since. ``cells`` and ``runs`` are counts, or upper bounds until it is complete.
    ``cpu_model``: see :mod:`slamhive.store.durations`. One with a ``question`` chooses its runs until it has a
    ``conclusion``, a sentence.
    """

    __tablename__ = "experiments"
    id = column(Integer, primary_key=True)
    uid = column(String(32), unique=True)
    name = column(String(NAME_LENGTH), unique=True)
    description = column(LongText)
    content_hash = column(String(64))
    source = column(LongText)
    state = column(enum_column(ExperimentState))
    executor = column(String(32))
    priority = column(Integer)
    repeats = column(Integer)
    cells = column(Integer)
    runs = column(Integer)
    complete = column(Boolean)
    created_at = column(UtcDateTime)
    cpu_model = optional(String(190))
    question = optional(enum_column(ExperimentQuestion))
    conclusion = optional(LongText)
    owner = optional(String(NAME_LENGTH))
    visibility = optional(enum_column(Visibility))
    audience = column(String(AUDIENCE_LENGTH), server_default=text("'team'"), index=True)
    """See :meth:`slamhive.domain.accounts.Sharing.audience`."""


class ExperimentCellRow(TableBase):
    """One configuration of an experiment, with its value on each axis that applies to it."""

    __tablename__ = "experiment_cells"
    __table_args__ = ({**TABLE_OPTIONS, "sqlite_with_rowid": False},)
    experiment_id = column(Integer, ForeignKey("experiments.id"), primary_key=True)
    number = column(Integer, primary_key=True, autoincrement=False)
    configuration_id = column(Integer, ForeignKey("configurations.id"), index=True)
    name = column(String(80))
    axis_values = column(JsonText)


class RunRow(TableBase):
    """A run: request, place in the queue, and outcome. Folders are named after ids, so no id is used twice."""

    __tablename__ = "runs"
    __table_args__ = (
        # Groups of repeats and how many of them failed are read from the index alone.
        Index("ix_runs_configuration_outcome", "configuration_id", "state", "reason"),
        Index("ix_runs_queue", "state", "held", "priority", "id"),
        Index("ix_runs_affinity", "state", "held", "priority", "affinity", "id"),
        Index("ix_runs_experiment_cells", "experiment_id", "cell", "state", "reason", "current_protocol_id"),
        Index("ix_runs_experiment_states", "experiment_id", "state", "reason", "current_protocol_id"),
        Index("ix_runs_current_protocol_id_state", "current_protocol_id", "state"),
        Index("ix_runs_audience_state", "audience", "state"),
        {**TABLE_OPTIONS, "sqlite_autoincrement": True},
    )
    id = column(Integer, primary_key=True)
    uid = column(String(32), unique=True)
    configuration_id = column(Integer, ForeignKey("configurations.id"))
    algorithm_version_id = optional(Integer, ForeignKey("algorithm_versions.id"), index=True)
    host_id = optional(Integer, ForeignKey("hosts.id"))
    dataset_checksum = optional(String(80))
    executor = column(String(32), index=True)
    state = column(enum_column(RunState))
    reason = optional(enum_column(FailureReason), index=True)
    detail = optional(LongText)
    seed = column(BigInteger)
    priority = column(Integer)
    evaluate = column(Boolean)
    created_at = column(UtcDateTime, index=True)
    started_at = optional(UtcDateTime, index=True)
    ended_at = optional(UtcDateTime, index=True)
    exit_code = optional(Integer)
    poses = optional(Integer)
    cpu_cores = optional(Number)
    memory_mb = optional(Integer)
    timeout_s = optional(Number)
    slow_down = column(Number, server_default=text("1"))
    attempt = column(Integer)
    lease_owner = optional(String(190))
    lease_expires_at = optional(UtcDateTime)
    handle = optional(JsonText)
    cancel_requested = column(Boolean)
    retry_of = optional(Integer, ForeignKey("runs.id"), index=True)
    protocol_override = optional(JsonText)
    current_protocol_id = optional(Integer, ForeignKey("protocols.id"))
    experiment_id = optional(Integer, ForeignKey("experiments.id"))
    cell = optional(Integer)
    held = column(Boolean, server_default=text("0"))
    affinity = column(String(32), server_default=text("''"))
    stop_when = optional(JsonText)
    disturbed_by = optional(String(120), index=True)
    disturbance = optional(JsonText)
    repeat_disturbed = column(Integer, server_default=text("0"))
    more_options = optional(JsonText)
    """Options of a run that have no column of their own, those at their defaults left out."""
    trajectory = optional(enum_column(TrajectoryKind))
    owner = optional(String(NAME_LENGTH), index=True)
    visibility = optional(enum_column(Visibility))
    audience = column(String(AUDIENCE_LENGTH), server_default=text("'team'"))
    """See :meth:`slamhive.domain.accounts.Sharing.audience`."""


class RunNoteRow(TableBase):
    """The note on a run; the file in its folder is the truth."""

    __tablename__ = "run_notes"
    run_id = column(Integer, ForeignKey("runs.id"), primary_key=True, autoincrement=False)
    note = column(LongText)


class RunTagRow(TableBase):
    """One tag of a run."""

    __tablename__ = "run_tags"
    __table_args__ = (
        Index("ix_run_tags_tag", "tag", "run_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    run_id = column(Integer, ForeignKey("runs.id"), primary_key=True)
    tag = column(String(NAME_LENGTH), primary_key=True)


class DeletedRunRow(TableBase):
    """A run that was deleted, so that an experiment or the ledger does not queue it again."""

    __tablename__ = "deleted_runs"
    uid = column(String(32), primary_key=True)
    run_id = column(Integer)
    deleted_at = column(UtcDateTime)


class RunEventRow(TableBase):
    """One move of a run."""

    __tablename__ = "run_events"
    id = column(Integer, primary_key=True)
    run_id = column(Integer, ForeignKey("runs.id"), index=True)
    at = column(UtcDateTime)
    from_state = optional(enum_column(RunState))
    to_state = column(enum_column(RunState))
    why = column(String(WHY_LENGTH))


class EvaluationRow(TableBase):
    """One evaluation of one run. ``open`` is 1 until it ends, then NULL: at most one is open.

    ``makes_current``: its success makes its protocol the current one of the run.
    """

    __tablename__ = "evaluations"
    __table_args__ = (
        UniqueConstraint("run_id", "protocol_id", "open"),
        Index("ix_evaluations_queue", "state", "id"),
        TABLE_OPTIONS,
    )
    id = column(Integer, primary_key=True)
    run_id = column(Integer, ForeignKey("runs.id"))
    protocol_id = column(Integer, ForeignKey("protocols.id"))
    open = optional(SmallInteger)
    state = column(enum_column(EvaluationState))
    reason = optional(LongText)
    artefacts = column(enum_column(Artefacts))
    engine = optional(String(190))
    created_at = column(UtcDateTime)
    started_at = optional(UtcDateTime)
    ended_at = optional(UtcDateTime)
    attempt = column(Integer)
    lease_owner = optional(String(190))
    lease_expires_at = optional(UtcDateTime)
    makes_current = column(Boolean, server_default=text("0"))


class MetricRow(TableBase):
    """A metric key and its number; rows appear when a metric is first stored."""

    __tablename__ = "metrics"
    id = column(Integer, primary_key=True)
    key = column(String(NAME_LENGTH), unique=True)


class MetricValueRow(TableBase):
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
    metric_id = column(Integer, ForeignKey("metrics.id"), primary_key=True)
    run_id = column(Integer, ForeignKey("runs.id"), primary_key=True, index=True)
    protocol_id = column(Integer, primary_key=True, autoincrement=False)
    value = column(Number)
    is_current = column(SmallInteger)


class VariantOptionRow(TableBase):
    """An option of the pre-processing steps of a configuration, where all its steps of a kind agree on it.

    ``name`` is ``KIND.OPTION``, and ``KIND.OPTION@SENSOR`` for each sensor.
    """

    __tablename__ = "variant_options"
    __table_args__ = (
        Index("ix_variant_options_number", "name", "number_value", "configuration_id"),
        Index("ix_variant_options_text", "name", "text_value", "configuration_id"),
        {**TABLE_OPTIONS, "sqlite_with_rowid": False},
    )
    configuration_id = column(Integer, ForeignKey("configurations.id"), primary_key=True)
    name = column(String(190), primary_key=True)
    number_value = optional(Number)
    text_value = optional(String(TEXT_VALUE_LENGTH))


class SavedSearchRow(TableBase):
    """A search with a name: filter, columns and order of the page of runs."""

    __tablename__ = "saved_searches"
    id = column(Integer, primary_key=True)
    name = column(String(NAME_LENGTH), unique=True)
    filter_text = column(LongText)
    shown_columns = column(JsonText)
    sort = column(String(190))
    descending = column(Boolean)
    grouped = column(Boolean)
    pinned = column(Integer, server_default=text("0"))
    colours = column(Boolean, server_default=text("0"))
    sparks = column(Boolean, server_default=text("0"))
    created_at = column(UtcDateTime)


class AnalysisRow(TableBase):
    """An analysis in the list and the queue; its folder ``analyses/<token>`` is the truth."""

    __tablename__ = "analyses"
    __table_args__ = (Index("ix_analyses_queue", "state", "id"), TABLE_OPTIONS)
    id = column(Integer, primary_key=True)
    token = column(String(32), unique=True)
    name = column(String(200))
    state = column(enum_column(AnalysisState))
    listed = column(Boolean)
    visitor = column(Boolean)
    created_at = column(UtcDateTime)
    content_hash = optional(String(64), index=True)
    reason = optional(LongText)
    size_bytes = optional(BigInteger)
    ended_at = optional(UtcDateTime)
    attempt = column(Integer)
    lease_owner = optional(String(190))
    lease_expires_at = optional(UtcDateTime)
    owner = optional(String(NAME_LENGTH))
    visibility = optional(enum_column(Visibility))
    audience = column(String(AUDIENCE_LENGTH), server_default=text("'team'"), index=True)
    """See :meth:`slamhive.domain.accounts.Sharing.audience`."""
