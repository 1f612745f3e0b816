"""Sensors that users chose for a configuration."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")


def upgrade() -> None:
    """Add the column; configurations of today follow the rule."""
    op.add_column("configurations", sa.Column("sensors", LONG_TEXT, nullable=True))


def downgrade() -> None:
    """Remove it."""
    op.drop_column("configurations", "sensors")
