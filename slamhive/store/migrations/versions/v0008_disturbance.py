"""Disturbances of the machine of a run, and how often the run may be repeated for that."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
INDEX = "ix_runs_disturbed_by"


def upgrade() -> None:
    """Add three columns; of the runs there nothing is known."""
    op.add_column("runs", sa.Column("disturbed_by", sa.String(120), nullable=True))
    op.add_column("runs", sa.Column("disturbance", LONG_TEXT, nullable=True))
    op.add_column("runs", sa.Column("repeat_disturbed", sa.Integer(), nullable=False, server_default=sa.text("0")))
    op.create_index(INDEX, "runs", ["disturbed_by"])


def downgrade() -> None:
    """Remove them; the run folders keep what they said."""
    op.drop_index(INDEX, "runs")
    for name in ("repeat_disturbed", "disturbance", "disturbed_by"):
        op.drop_column("runs", name)
