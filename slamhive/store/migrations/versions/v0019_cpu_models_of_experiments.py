"""On which CPU model all runs of an experiment are measured."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; experiments that are stored already may go on as they began."""
    op.add_column("experiments", sa.Column("cpu_model", sa.String(190), nullable=True))


def downgrade() -> None:
    """Remove it."""
    op.drop_column("experiments", "cpu_model")
