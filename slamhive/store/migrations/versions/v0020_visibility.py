"""Owner and visibility of runs, experiments and analyses."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

_OWNED = ("experiments", "analyses")


def upgrade() -> None:
    """Add the columns; everybody who is signed in goes on seeing what is there."""
    for table in (*_OWNED, "runs"):
        audience = sa.Column("audience", sa.String(80), nullable=False, server_default=sa.text("'team'"))
        op.add_column(table, sa.Column("visibility", sa.String(32), nullable=True))
        op.add_column(table, audience)
    for table in _OWNED:
        op.add_column(table, sa.Column("owner", sa.String(64), nullable=True))
        op.create_index(f"ix_{table}_audience", table, ["audience"])
    op.create_index("ix_runs_audience_state", "runs", ["audience", "state"])


def downgrade() -> None:
    """Remove them."""
    op.drop_index("ix_runs_audience_state", "runs")
    for table in _OWNED:
        op.drop_index(f"ix_{table}_audience", table)
        op.drop_column(table, "owner")
    for table in (*_OWNED, "runs"):
        op.drop_column(table, "audience")
        op.drop_column(table, "visibility")
