"""The index of the runs of a configuration also holds how they ended."""

from __future__ import annotations

from alembic import op

revision = "0028"
down_revision = "0027"
branch_labels = None
depends_on = None

BEFORE, AFTER = "ix_runs_configuration_id", "ix_runs_configuration_outcome"


def upgrade() -> None:
    """Replace the index. MySQL needs one of them for the reference at any time, so the new one comes first."""
    op.create_index(AFTER, "runs", ["configuration_id", "state", "reason"])
    op.drop_index(BEFORE, "runs")


def downgrade() -> None:
    """Go back to the index of the configuration alone."""
    op.create_index(BEFORE, "runs", ["configuration_id"])
    op.drop_index(AFTER, "runs")
