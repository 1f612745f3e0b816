"""Evaluations may make their protocol the current one of their run."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None

TABLE, NAME = "evaluations", "makes_current"


def upgrade() -> None:
    """Add the column; no stored evaluation does."""
    op.add_column(TABLE, sa.Column(NAME, sa.Boolean(), nullable=False, server_default=sa.text("0")))


def downgrade() -> None:
    """Remove it."""
    op.drop_column(TABLE, NAME)
