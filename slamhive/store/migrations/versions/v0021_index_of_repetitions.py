"""An index of the runs that repeat others: without it, deleting a run reads all runs on SQLite."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None

INDEX = "ix_runs_retry_of"
IMPLIED = "fk_runs_retry_of"
"""MySQL makes it for the reference, and drops it by itself while nobody has made it on purpose."""


def upgrade() -> None:
    """Make the index."""
    _replace_index(IMPLIED, INDEX)


def downgrade() -> None:
    """Remove it."""
    _replace_index(INDEX, IMPLIED)


def _replace_index(old: str, new: str) -> None:
    connection = op.get_bind()
    if new == INDEX or connection.dialect.name == "mysql":
        op.create_index(new, "runs", ["retry_of"])
    if old in {index["name"] for index in sa.inspect(connection).get_indexes("runs")}:
        op.drop_index(old, "runs")
