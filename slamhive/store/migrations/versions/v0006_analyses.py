"""Analyses: their list and their queue.

A migration stands still while the models move on, so it names its own column types and imports none of theirs.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

MOMENT = sa.DateTime().with_variant(mysql.DATETIME(fsp=6), "mysql")
LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
ANALYSES = "analyses"


def upgrade() -> None:
    """Add the table; ``slamhive reindex`` fills it out of folders that are there already."""
    op.create_table(
        ANALYSES,
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("token", sa.String(32), nullable=False),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("state", sa.String(32), nullable=False),
        sa.Column("listed", sa.Boolean(), nullable=False),
        sa.Column("visitor", sa.Boolean(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.Column("content_hash", sa.String(64), nullable=True),
        sa.Column("reason", LONG_TEXT, nullable=True),
        sa.Column("size_bytes", sa.BigInteger(), nullable=True),
        sa.Column("ended_at", MOMENT, nullable=True),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("lease_owner", sa.String(190), nullable=True),
        sa.Column("lease_expires_at", MOMENT, nullable=True),
        sa.PrimaryKeyConstraint("id", name=f"pk_{ANALYSES}"),
        sa.UniqueConstraint("token", name=f"uq_{ANALYSES}_token"),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )
    op.create_index(f"ix_{ANALYSES}_queue", ANALYSES, ["state", "id"])
    op.create_index(f"ix_{ANALYSES}_content_hash", ANALYSES, ["content_hash"])


def downgrade() -> None:
    """Remove the table; nothing is lost, since the folders hold the analyses."""
    op.drop_table(ANALYSES)
