"""Runs have a factor by which they are slowed down."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None

NUMBER: sa.types.TypeEngine[float] = sa.Double().with_variant(mysql.DOUBLE(asdecimal=False), "mysql")


def upgrade() -> None:
    """Add the column; the runs there were not slowed down."""
    op.add_column("runs", sa.Column("slow_down", NUMBER, nullable=False, server_default=sa.text("1")))


def downgrade() -> None:
    """Remove it; the run folders keep what they said."""
    op.drop_column("runs", "slow_down")
