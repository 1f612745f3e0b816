"""Experiments may have a question, for which they choose their runs, and its conclusion."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")


def upgrade() -> None:
    """Add the columns; stored experiments have no question."""
    op.add_column("experiments", sa.Column("question", sa.String(32), nullable=True))
    op.add_column("experiments", sa.Column("conclusion", LONG_TEXT, nullable=True))


def downgrade() -> None:
    """Remove them."""
    op.drop_column("experiments", "conclusion")
    op.drop_column("experiments", "question")
