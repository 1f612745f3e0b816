"""Store the variant of a configuration: the pre-processing of its dataset."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

from slamhive.base.errors import Conflict

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")


def upgrade() -> None:
    """Add the column; the configurations there are use their datasets as they are (NULL)."""
    op.add_column("configurations", sa.Column("variant", LONG_TEXT, nullable=True))


def downgrade() -> None:
    """Remove the column; raises Conflict if that would falsify runs."""
    configurations = sa.table("configurations", sa.column("variant"))
    count = sa.select(sa.func.count()).select_from(configurations).where(configurations.c.variant.is_not(None))
    found = op.get_bind().execute(count).scalar_one()
    if found:
        raise Conflict(
            f"{found} configurations use variants of their datasets, which the older version does not know",
            "use a database of its own for it",
        )
    op.drop_column("configurations", "variant")
