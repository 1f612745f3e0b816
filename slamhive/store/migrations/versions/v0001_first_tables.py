"""The first tables.

A migration stands still while the models move on, so it names its own column types and imports none of theirs.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

MOMENT = sa.DateTime().with_variant(mysql.DATETIME(fsp=6), "mysql")
LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
NUMBER: sa.types.TypeEngine[float] = sa.Double().with_variant(mysql.DOUBLE(asdecimal=False), "mysql")
WORD = sa.String(32)
NAME = sa.String(64)
LABEL = sa.String(190)

TABLES = (
    "algorithms",
    "algorithm_versions",
    "datasets",
    "parameters",
    "configurations",
    "configuration_values",
    "hosts",
    "protocols",
    "runs",
    "run_events",
    "evaluations",
    "metrics",
    "metric_values",
)


def upgrade() -> None:
    """Create everything, and the protocol row that measured metrics are filed under."""
    _table(
        "algorithms",
        *_id("algorithms"),
        _column("name", NAME),
        _column("package", NAME),
        _column("mode", NAME),
        _unique("algorithms", "name"),
    )
    _table(
        "algorithm_versions",
        *_id("algorithm_versions"),
        _column("algorithm_id", sa.Integer()),
        _column("identity", LABEL),
        _column("package_hash", sa.String(80)),
        _column("version", LABEL),
        _column("created_at", MOMENT),
        _refers("algorithm_versions", "algorithm_id", "algorithms"),
        _unique("algorithm_versions", "algorithm_id", "identity", "package_hash"),
    )
    _table(
        "datasets",
        *_id("datasets"),
        _column("name", NAME),
        _column("checksum", sa.String(80)),
        _column("duration_s", NUMBER),
        _column("folder", sa.String(1024)),
        _column("sensors", LONG_TEXT),
        _column("title", sa.String(255)),
        _column("registered_at", MOMENT),
        _unique("datasets", "name"),
    )
    _table(
        "hosts",
        *_id("hosts"),
        _column("fingerprint", NAME),
        _column("cpu_model", LABEL),
        _column("cpu_count", sa.Integer()),
        _column("memory_bytes", sa.BigInteger()),
        _column("kernel", LABEL),
        _column("os", LABEL),
        _unique("hosts", "fingerprint"),
    )
    _table(
        "parameters",
        *_id("parameters"),
        _column("scope", NAME),
        _column("key", LABEL),
        _column("type", sa.String(16)),
        _column("unit", WORD),
        _column("general", NAME, null=True),
        _unique("parameters", "scope", "key"),
    )
    op.create_index("ix_parameters_general", "parameters", ["general"])
    _table(
        "configurations",
        *_id("configurations"),
        _column("content_hash", NAME),
        _column("algorithm_id", sa.Integer()),
        _column("dataset_id", sa.Integer()),
        _column("playback_mode", WORD),
        _column("playback_rate", NUMBER),
        _column("created_at", MOMENT),
        _refers("configurations", "algorithm_id", "algorithms"),
        _refers("configurations", "dataset_id", "datasets"),
        _unique("configurations", "content_hash"),
    )
    op.create_index("ix_configurations_algorithm_id", "configurations", ["algorithm_id"])
    op.create_index("ix_configurations_dataset_id", "configurations", ["dataset_id"])
    table = "configuration_values"
    _table(
        table,
        _column("configuration_id", sa.Integer()),
        _column("parameter_id", sa.Integer()),
        _column("value", LONG_TEXT),
        _column("number_value", NUMBER, null=True),
        _column("text_value", LABEL, null=True),
        _refers(table, "configuration_id", "configurations"),
        _refers(table, "parameter_id", "parameters"),
        sa.PrimaryKeyConstraint("configuration_id", "parameter_id", name=f"pk_{table}"),
        sqlite_with_rowid=False,
    )
    op.create_index(f"ix_{table}_number", table, ["parameter_id", "number_value", "configuration_id"])
    op.create_index(f"ix_{table}_text", table, ["parameter_id", "text_value", "configuration_id"])
    _table(
        "protocols",
        *_id("protocols"),
        _column("fingerprint", WORD),
        _column("label", sa.String(255)),
        _column("definition", LONG_TEXT),
        _unique("protocols", "fingerprint"),
    )
    request = [
        _column("uid", WORD),
        _column("configuration_id", sa.Integer()),
        _column("executor", WORD),
        _column("seed", sa.BigInteger()),
        _column("priority", sa.Integer()),
        _column("evaluate", sa.Boolean()),
        _column("cpu_cores", NUMBER, null=True),
        _column("memory_mb", sa.Integer(), null=True),
        _column("timeout_s", NUMBER, null=True),
        _column("retry_of", sa.Integer(), null=True),
        _column("protocol_override", LONG_TEXT, null=True),
        _column("created_at", MOMENT),
    ]
    work = [
        _column("state", WORD),
        _column("attempt", sa.Integer()),
        _column("lease_owner", LABEL, null=True),
        _column("lease_expires_at", MOMENT, null=True),
        _column("handle", LONG_TEXT, null=True),
        _column("cancel_requested", sa.Boolean()),
    ]
    outcome = [
        _column("algorithm_version_id", sa.Integer(), null=True),
        _column("host_id", sa.Integer(), null=True),
        _column("dataset_checksum", sa.String(80), null=True),
        _column("reason", WORD, null=True),
        _column("detail", LONG_TEXT, null=True),
        _column("started_at", MOMENT, null=True),
        _column("ended_at", MOMENT, null=True),
        _column("exit_code", sa.Integer(), null=True),
        _column("poses", sa.Integer(), null=True),
        _column("current_protocol_id", sa.Integer(), null=True),
    ]
    _table(
        "runs",
        *_id("runs"),
        *request,
        *work,
        *outcome,
        _refers("runs", "configuration_id", "configurations"),
        _refers("runs", "algorithm_version_id", "algorithm_versions"),
        _refers("runs", "host_id", "hosts"),
        _refers("runs", "retry_of", "runs"),
        _refers("runs", "current_protocol_id", "protocols"),
        _unique("runs", "uid"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_runs_queue", "runs", ["state", "priority", "id"])
    op.create_index("ix_runs_created_at", "runs", ["created_at"])
    op.create_index("ix_runs_configuration_id", "runs", ["configuration_id"])
    _table(
        "run_events",
        *_id("run_events"),
        _column("run_id", sa.Integer()),
        _column("at", MOMENT),
        _column("from_state", WORD, null=True),
        _column("to_state", WORD),
        _column("why", sa.String(500)),
        _refers("run_events", "run_id", "runs"),
    )
    op.create_index("ix_run_events_run_id", "run_events", ["run_id"])
    _table(
        "evaluations",
        *_id("evaluations"),
        _column("run_id", sa.Integer()),
        _column("protocol_id", sa.Integer()),
        _column("open", sa.SmallInteger(), null=True),
        _column("state", WORD),
        _column("reason", LONG_TEXT, null=True),
        _column("artefacts", WORD),
        _column("engine", LABEL, null=True),
        _column("created_at", MOMENT),
        _column("started_at", MOMENT, null=True),
        _column("ended_at", MOMENT, null=True),
        _column("attempt", sa.Integer()),
        _column("lease_owner", LABEL, null=True),
        _column("lease_expires_at", MOMENT, null=True),
        _refers("evaluations", "run_id", "runs"),
        _refers("evaluations", "protocol_id", "protocols"),
        _unique("evaluations", "run_id", "protocol_id", "open"),
    )
    op.create_index("ix_evaluations_queue", "evaluations", ["state", "id"])
    _table("metrics", *_id("metrics"), _column("key", NAME), _unique("metrics", "key"))
    _table(
        "metric_values",
        _column("run_id", sa.Integer()),
        _column("metric_id", sa.Integer()),
        _column("protocol_id", sa.Integer()),
        _column("value", NUMBER),
        _refers("metric_values", "run_id", "runs"),
        _refers("metric_values", "metric_id", "metrics"),
        _refers("metric_values", "protocol_id", "protocols"),
        sa.PrimaryKeyConstraint("run_id", "metric_id", "protocol_id", name="pk_metric_values"),
        sqlite_with_rowid=False,
    )
    op.create_index("ix_metric_values_search", "metric_values", ["metric_id", "protocol_id", "value", "run_id"])
    protocols = sa.table("protocols", *(sa.column(name) for name in ("id", "fingerprint", "label", "definition")))
    op.bulk_insert(
        protocols, [{"id": 1, "fingerprint": "measured", "label": "measured while running", "definition": "{}"}]
    )


def downgrade() -> None:
    """Remove everything."""
    for name in reversed(TABLES):
        op.drop_table(name)


def _table(name: str, *content: sa.schema.SchemaItem, **options: Any) -> None:
    """A table with the naming rules and MySQL options that all of ours have."""
    op.create_table(
        name, *content, mysql_engine="InnoDB", mysql_charset="utf8mb4", mysql_collate="utf8mb4_bin", **options
    )


def _id(table: str) -> tuple[sa.Column[Any], sa.PrimaryKeyConstraint]:
    return sa.Column("id", sa.Integer(), nullable=False), sa.PrimaryKeyConstraint("id", name=f"pk_{table}")


def _column(name: str, kind: Any, *, null: bool = False) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=null)


def _unique(table: str, *columns: str) -> sa.UniqueConstraint:
    return sa.UniqueConstraint(*columns, name=f"uq_{table}_{'_'.join(columns)}")


def _refers(table: str, column: str, target: str) -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint([column], [f"{target}.id"], name=f"fk_{table}_{column}")
