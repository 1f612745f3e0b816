"""Runs keep further options in one column, so that a new option needs no migration."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")


def upgrade() -> None:
    """Add the column; stored runs have none of them."""
    op.add_column("runs", sa.Column("more_options", LONG_TEXT, nullable=True))


def downgrade() -> None:
    """Remove it."""
    op.drop_column("runs", "more_options")
