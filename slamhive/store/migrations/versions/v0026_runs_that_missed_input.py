"""Judge runs again: one that missed too much of its input has failed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from slamhive.store.metrics import VerdictRepository

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None

MISSED_INPUT = 5


def upgrade() -> None:
    """Derive all verdicts by the present rule."""
    VerdictRepository(op.get_bind()).renew_all()


def downgrade() -> None:
    """Remove the verdicts that earlier versions do not know; they derive their own when a repeat is evaluated."""
    metrics = sa.table("metrics", sa.column("id"), sa.column("key"))
    values = sa.table("metric_values", sa.column("metric_id"), sa.column("value"))
    verdicts = sa.select(metrics.c.id).where(metrics.c.key == "verdict")
    op.execute(sa.delete(values).where(values.c.metric_id.in_(verdicts), values.c.value == MISSED_INPUT))
