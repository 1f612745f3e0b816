"""The trajectory that a run gives as its main one."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; runs of before do not state it."""
    op.add_column("runs", sa.Column("trajectory", sa.String(32), nullable=True))


def downgrade() -> None:
    """Remove it; the run folders keep what they said."""
    op.drop_column("runs", "trajectory")
