"""Experiments, their cells and runs; runs that are held back.

A migration stands still while the models move on, so it names its own column types and imports none of theirs.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

from slamhive.base.errors import Conflict

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

MOMENT = sa.DateTime().with_variant(mysql.DATETIME(fsp=6), "mysql")
LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
OPTIONS: dict[str, Any] = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}

QUEUE = "ix_runs_queue"
AFFINITY = "ix_runs_affinity"
EXPERIMENT = "ix_runs_experiment"
REFERENCE = "fk_runs_experiment_id"
COLUMNS = ("cell", "held", "affinity", "stop_when")


def upgrade() -> None:
    """Add two tables and five columns; the runs there belong to no experiment and are not held."""
    op.create_table(
        "experiments",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("uid", sa.String(32), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("description", LONG_TEXT, nullable=False),
        sa.Column("content_hash", sa.String(64), nullable=False),
        sa.Column("source", LONG_TEXT, nullable=False),
        sa.Column("state", sa.String(32), nullable=False),
        sa.Column("executor", sa.String(32), nullable=False),
        sa.Column("priority", sa.Integer(), nullable=False),
        sa.Column("repeats", sa.Integer(), nullable=False),
        sa.Column("cells", sa.Integer(), nullable=False),
        sa.Column("runs", sa.Integer(), nullable=False),
        sa.Column("complete", sa.Boolean(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_experiments"),
        sa.UniqueConstraint("uid", name="uq_experiments_uid"),
        sa.UniqueConstraint("name", name="uq_experiments_name"),
        **OPTIONS,
    )
    cells = "experiment_cells"
    op.create_table(
        cells,
        sa.Column("experiment_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("configuration_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(80), nullable=False),
        sa.Column("axis_values", LONG_TEXT, nullable=False),
        sa.ForeignKeyConstraint(["experiment_id"], ["experiments.id"], name=f"fk_{cells}_experiment_id"),
        sa.ForeignKeyConstraint(["configuration_id"], ["configurations.id"], name=f"fk_{cells}_configuration_id"),
        sa.PrimaryKeyConstraint("experiment_id", "number", name=f"pk_{cells}"),
        sqlite_with_rowid=False,
        **OPTIONS,
    )
    op.create_index(f"ix_{cells}_configuration_id", cells, ["configuration_id"])
    op.add_column("runs", sa.Column("cell", sa.Integer(), nullable=True))
    op.add_column("runs", sa.Column("held", sa.Boolean(), nullable=False, server_default=sa.text("0")))
    op.add_column("runs", sa.Column("affinity", sa.String(32), nullable=False, server_default=sa.text("''")))
    op.add_column("runs", sa.Column("stop_when", LONG_TEXT, nullable=True))
    if op.get_bind().dialect.name == "sqlite":
        # SQLite can add no reference to a table that exists, unless it is written with the column.
        op.execute(
            f"ALTER TABLE runs ADD COLUMN experiment_id INTEGER CONSTRAINT {REFERENCE} REFERENCES experiments (id)"
        )
    else:
        op.add_column("runs", sa.Column("experiment_id", sa.Integer(), nullable=True))
        op.create_foreign_key(REFERENCE, "runs", "experiments", ["experiment_id"], ["id"])
    op.create_index(EXPERIMENT, "runs", ["experiment_id", "cell", "state", "reason"])
    op.drop_index(QUEUE, "runs")
    op.create_index(QUEUE, "runs", ["state", "held", "priority", "id"])
    op.create_index(AFFINITY, "runs", ["state", "held", "priority", "affinity", "id"])


def downgrade() -> None:
    """Remove them; raises Conflict where runs on hold would start, or experiments would be lost."""
    found = op.get_bind().execute(sa.text("SELECT count(*) FROM experiments")).scalar_one()
    if found:
        raise Conflict(
            f"{found} experiments are stored, which the older version does not know", "use a database of its own for it"
        )
    op.drop_index(AFFINITY, "runs")
    op.drop_index(QUEUE, "runs")
    op.create_index(QUEUE, "runs", ["state", "priority", "id"])
    if op.get_bind().dialect.name != "sqlite":
        op.drop_constraint(REFERENCE, "runs", type_="foreignkey")
    op.drop_index(EXPERIMENT, "runs")
    for name in ("experiment_id", *COLUMNS):
        op.drop_column("runs", name)
    op.drop_table("experiment_cells")
    op.drop_table("experiments")
