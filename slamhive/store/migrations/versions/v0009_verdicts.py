"""Derive verdicts on runs that were evaluated before verdicts existed."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from slamhive.store.metrics import VerdictRepository

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

DERIVED = ("verdict", "ate.over_repeats", "ate.repeats_limit")


def upgrade() -> None:
    """Judge them by the metrics that they have."""
    VerdictRepository(op.get_bind()).renew_all()


def downgrade() -> None:
    """Remove the verdicts and what they rest on."""
    metrics = sa.table("metrics", sa.column("id"), sa.column("key"))
    values = sa.table("metric_values", sa.column("metric_id"))
    chosen = sa.select(metrics.c.id).where(metrics.c.key.in_(DERIVED))
    op.execute(sa.delete(values).where(values.c.metric_id.in_(chosen)))
    op.execute(sa.delete(metrics).where(metrics.c.key.in_(DERIVED)))
