"""The account that asked for a run."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

INDEX = "ix_runs_owner"


def upgrade() -> None:
    """Add the column; of earlier runs nobody is known."""
    op.add_column("runs", sa.Column("owner", sa.String(64), nullable=True))
    op.create_index(INDEX, "runs", ["owner"])


def downgrade() -> None:
    """Remove it."""
    op.drop_index(INDEX, "runs")
    op.drop_column("runs", "owner")
