"""Configurations that ask for a version of a package, or start with a map."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

from slamhive.base.errors import Conflict

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
TABLE = "configurations"


def upgrade() -> None:
    """Add two columns; no configuration there asks for either."""
    op.add_column(TABLE, sa.Column("version", sa.Integer(), nullable=True))
    op.add_column(TABLE, sa.Column("map", LONG_TEXT, nullable=True))


def downgrade() -> None:
    """Remove them; raises Conflict where configurations would change their meaning."""
    rows = sa.table(TABLE, sa.column("version"), sa.column("map"))
    asked = sa.select(sa.func.count()).where(rows.c.version.is_not(None) | rows.c.map.is_not(None))
    count = op.get_bind().execute(asked).scalar_one()
    if count:
        raise Conflict(
            f"{count} configurations ask for a version or a map, which the older version cannot hold",
            "use a database of its own for it",
        )
    op.drop_column(TABLE, "map")
    op.drop_column(TABLE, "version")
