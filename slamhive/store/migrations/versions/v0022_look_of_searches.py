"""Saved searches keep how their list looks: pinned columns, colours and sparklines."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None

TABLE, FLAGS = "saved_searches", ("colours", "sparks")


def upgrade() -> None:
    """Add the columns; what is saved has none of it."""
    op.add_column(TABLE, sa.Column("pinned", sa.Integer(), nullable=False, server_default=sa.text("0")))
    for name in FLAGS:
        op.add_column(TABLE, sa.Column(name, sa.Boolean(), nullable=False, server_default=sa.text("0")))


def downgrade() -> None:
    """Remove them."""
    for name in (*FLAGS, "pinned"):
        op.drop_column(TABLE, name)
