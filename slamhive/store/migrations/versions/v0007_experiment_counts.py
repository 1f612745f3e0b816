"""An index that counts the runs of an experiment by state and reason without reading its cells."""

from __future__ import annotations

from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

COUNTS = "ix_runs_experiment_counts"


def upgrade() -> None:
    """Add it."""
    op.create_index(COUNTS, "runs", ["experiment_id", "state", "reason"])


def downgrade() -> None:
    """Remove it; the reference to the experiment keeps the index over its cells."""
    op.drop_index(COUNTS, "runs")
